import zipfile

import numpy as np
import pytest
from formats_cases import angles_rad, colours_along, covariances, directions, random_gaussians
from raising import raises

from gsmap import formats
from gsmap.errors import InputError, MissingDependencyError
from gsmap.formats.axes import axes_matrix
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Sim3

Usd = pytest.importorskip("pxr.Usd")

SUFFIXES = [".usda", ".usdc", ".usdz"]


def same(ours, theirs, atol: float = 1e-5) -> None:
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-4)
    assert angles_rad(ours, theirs).max() < max(1e-4, 5 * atol)
    np.testing.assert_allclose(theirs.log_scales, ours.log_scales, atol=max(1e-4, atol))
    np.testing.assert_allclose(theirs.opacities, ours.opacities, atol=atol)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=max(1e-5, atol))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("degree", [0, 3])
def test_what_is_written_is_read_back(tmp_path, suffix, degree):
    g = random_gaussians(40, degree)
    formats.write(tmp_path / f"a{suffix}", g)
    same(g, formats.read(tmp_path / f"a{suffix}"))
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


def test_half_floats(tmp_path):
    g = random_gaussians(40, 1)
    formats.write(tmp_path / "a.usdc", g, half=True)
    same(g, formats.read(tmp_path / "a.usdc"), atol=6e-3)


def test_it_is_what_the_schema_wants(tmp_path):
    """By USD itself: y up, in the type's own attributes, bounds around the splats."""
    from pxr import Gf, UsdGeom, UsdVol

    g = random_gaussians(30, 2)
    formats.write(tmp_path / "a.usda", g)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    prim = stage.GetDefaultPrim()
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
    M = axes_matrix("RUB", "RDF")
    positions = np.array(prim.GetAttribute("positions").Get())
    np.testing.assert_allclose(positions, g.means @ M.T, atol=1e-5)
    quats = prim.GetAttribute("orientations").Get()
    axes = [np.array(Gf.Matrix3d(Gf.Quatd(quat))).T for quat in quats]
    scales = np.array(prim.GetAttribute("scales").Get())
    found = np.array([A @ np.diag(s**2) @ A.T for A, s in zip(axes, scales, strict=True)])
    np.testing.assert_allclose(found, M @ covariances(g) @ M.T, rtol=1e-3, atol=1e-6)
    low, high = np.array(prim.GetAttribute("extent").Get())
    assert (positions >= low).all()
    assert (positions <= high).all()
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    sh = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()).reshape(30, 9, 3)
    d = directions()
    turned = type(g)(positions, g.quats, g.log_scales, g.logit_opacities, sh)
    np.testing.assert_allclose(colours_along(turned, d @ M.T), colours_along(g, d), atol=1e-4)


def test_transforms_and_the_up_axis_of_a_stage(tmp_path):
    from pxr import Gf, UsdGeom

    g = random_gaussians(20, 3)
    formats.write(tmp_path / "a.usda", g)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    S = Sim3(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]), 2.0)
    UsdGeom.Xformable(stage.GetDefaultPrim()).AddTransformOp().Set(Gf.Matrix4d(S.matrix().T.tolist()))
    stage.GetRootLayer().Export(str(tmp_path / "b.usda"))
    T = np.eye(4)
    T[:3, :3] = axes_matrix("RDF", "RUB")
    turn = Sim3(T[:3, :3], np.zeros(3))
    same(transform_gaussians(g, turn @ S @ turn.inverse()), formats.read(tmp_path / "b.usda"), atol=1e-4)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.Xformable(stage.GetDefaultPrim()).ClearXformOpOrder()
    stage.GetRootLayer().Export(str(tmp_path / "c.usda"))
    M = axes_matrix("RDF", "RFU") @ axes_matrix("RUB", "RDF")
    np.testing.assert_allclose(formats.read(tmp_path / "c.usda").means, g.means @ M.T, atol=1e-4)


def test_another_writer(tmp_path):
    """NVIDIA's usd-convert-gsplat leaves SH as they are when it turns a capture, so without them."""
    theirs = pytest.importorskip("usd_convert_gsplat.usd_writer")
    g = random_gaussians(50, 0)
    formats.write(tmp_path / "a.ply", g)
    theirs.convertPlyUSD(str(tmp_path / "a.ply"), str(tmp_path / "b.usda"), rotation_degrees=(180.0, 0.0, 0.0))
    back = formats.read(tmp_path / "b.usda")
    np.testing.assert_allclose(back.means, g.means, atol=1e-4)
    np.testing.assert_allclose(covariances(back), covariances(g), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(back.opacities, g.opacities, atol=1e-5)
    np.testing.assert_allclose(back.sh, g.sh, atol=1e-5)


def edited(tmp_path, change):
    formats.write(tmp_path / "a.usda", random_gaussians(5, 1))
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    change(stage, stage.GetDefaultPrim())
    stage.GetRootLayer().Export(str(tmp_path / "b.usda"))
    return tmp_path / "b.usda"


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda s, p: s.RemovePrim(p.GetPath()), "not_gaussians"),
        (lambda s, p: p.GetAttribute("positions").Clear(), "missing_attribute"),
        (lambda s, p: p.GetAttribute("radiance:sphericalHarmonicsDegree").Set(7), "unsupported_sh_degree"),
        (lambda s, p: p.GetReferences().AddReference("/etc/passwd"), "unsupported_feature"),
        (lambda s, p: s.GetRootLayer().subLayerPaths.append("other.usda"), "unsupported_feature"),
    ],
)
def test_what_is_not_read_is_named(tmp_path, change, code):
    with raises(InputError, code=code):
        formats.read(edited(tmp_path, change))


def test_arrays_that_are_too_short_are_left_out_as_the_schema_says(tmp_path):
    from pxr import Vt

    path = edited(tmp_path, lambda s, p: p.GetAttribute("opacities").Set(Vt.FloatArray([0.1])))
    np.testing.assert_allclose(formats.read(path).opacities, 1, atol=1e-5)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damage_is_an_input_error(tmp_path, suffix):
    formats.write(tmp_path / f"a{suffix}", random_gaussians(5, 1))
    data = (tmp_path / f"a{suffix}").read_bytes()
    for size in (0, 10, len(data) // 2):
        (tmp_path / f"a{suffix}").write_bytes(data[:size])
        with pytest.raises(InputError):
            formats.read(tmp_path / f"a{suffix}")
    (tmp_path / f"a{suffix}").write_bytes(b"hello" * 100)
    with raises(InputError, code=("reader_failed", "unsupported_feature")):
        formats.read(tmp_path / f"a{suffix}")


def test_a_package_is_stored_not_compressed(tmp_path):
    formats.write(tmp_path / "a.usdz", random_gaussians(5, 1))
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        (entry,) = archive.infolist()
        assert entry.compress_type == zipfile.ZIP_STORED
        assert (entry.header_offset + 30 + len(entry.filename) + len(entry.extra)) % 64 == 0


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with raises(MissingDependencyError, code="missing_dependency"):
        formats.write(tmp_path / "a.usda", random_gaussians(5, 1))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_usds_own_validators_find_nothing(tmp_path, suffix):
    validation = pytest.importorskip("pxr.UsdValidation")
    formats.write(tmp_path / f"a{suffix}", random_gaussians(5, 1))
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []
