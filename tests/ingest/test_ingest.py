import json

import numpy as np
import pytest
from raising import raises

import gsmap.formats
from gsmap.errors import ConfigError, InputError, NotFoundError, NotPinholesError
from gsmap.formats import cameras_json, write
from gsmap.ingest import find_captures, read_captures, take_capture, validate
from gsmap.types import Cameras, Gaussians


def box(n: int = 4000, seed: int = 0) -> Gaussians:
    """The inside walls of a room of 4 x 6 x 3 around the origin."""
    rng = np.random.default_rng(seed)
    half = np.array([2, 3, 1.5])
    points = rng.uniform(-half, half, size=(n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.sign(points[np.arange(n), axis]) * half[axis]
    return Gaussians(
        points, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -3.5), np.full(n, 2.0), rng.normal(size=(n, 1, 3))
    )


def looking(n: int = 4) -> Cameras:
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, 0, 3] = np.linspace(-1, 1, n)
    return Cameras(pose, np.tile([50.0, 50, 32, 24], (n, 1)), np.tile([64, 48], (n, 1)))


def replaced(g: Gaussians, **arrays: np.ndarray) -> Gaussians:
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    return Gaussians(**({n: getattr(g, n) for n in names} | arrays))


# -- finding


def test_cameras_of_its_own_name(tmp_path):
    write(tmp_path / "monday.ply", box())
    write(tmp_path / "tuesday.ply", box(seed=1))
    cameras_json.write(tmp_path / "monday.cameras.json", looking(4))
    cameras_json.write(tmp_path / "cameras.json", looking(7))
    a, b = read_captures(tmp_path)
    assert (a.name, len(a.cameras), a.cameras.synthesised) == ("monday", 4, False)
    assert (b.name, b.cameras.synthesised) == ("tuesday", True)
    assert any("cameras.json was not used" in note for note in b.notes)
    assert any("synthesised" in note for note in b.notes)
    assert a.source == str(tmp_path / "monday.ply")


def test_shared_cameras_of_a_single_file(tmp_path):
    write(tmp_path / "monday.ply", box())
    cameras_json.write(tmp_path / "cameras.json", looking(7))
    (capture,) = read_captures(tmp_path / "monday.ply")
    assert len(capture.cameras) == 7
    assert capture.notes == ()


def test_gaussian_splatting_output(tmp_path):
    out = tmp_path / "kitchen"
    for iteration, n in ((7000, 100), (30000, 300)):
        folder = out / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        write(folder / "point_cloud.ply", box(n))
    (out / "input.ply").write_bytes(b"ply\n")
    cameras_json.write(out / "cameras.json", looking())
    last = out / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    for given in (out, last, tmp_path):
        (capture,) = read_captures(given)
        assert (capture.name, len(capture.gaussians), len(capture.cameras)) == ("kitchen", 300, 4)
    (earlier,) = read_captures(out / "point_cloud" / "iteration_7000" / "point_cloud.ply")
    assert (earlier.name, len(earlier.gaussians), len(earlier.cameras)) == ("kitchen", 100, 4)


def test_gsplat_output(tmp_path):
    out = tmp_path / "garden"
    (out / "ply").mkdir(parents=True)
    (out / "ckpts").mkdir()
    (out / "ckpts" / "ckpt_29999_rank0.pt").touch()
    for step, n in ((6999, 100), (29999, 300)):
        write(out / "ply" / f"point_cloud_{step}.ply", box(n))
    (capture,) = read_captures(out)
    assert (capture.name, len(capture.gaussians), capture.cameras.synthesised) == ("garden", 300, True)


def test_nerfstudio_export(tmp_path):
    out = tmp_path / "poster"
    out.mkdir()
    write(out / "splat.ply", box())
    frames = []
    for i, pose in enumerate(looking().T_frame_camera):
        saved = pose @ np.diag([1.0, -1, -1, 1])
        saved[:3, 3] /= 0.5
        frames.append({"file_path": f"{i}.png", "transform_matrix": saved.tolist()})
    content = {"fl_x": 50, "fl_y": 50, "w": 64, "h": 48, "frames": frames}
    (out / "transforms.json").write_text(json.dumps(content))
    (out / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 0.5}))
    (capture,) = read_captures(out)
    assert capture.name == "poster"
    np.testing.assert_allclose(capture.cameras.T_frame_camera, looking().T_frame_camera, atol=1e-12)


def test_colmap_beside_the_file(tmp_path):
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "sparse" / "0" / "images.txt").write_text("# x\n1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    write(tmp_path / "hall.ply", box())
    (capture,) = read_captures(tmp_path)
    assert capture.cameras.names == ("a.jpg",)


def test_tiles_are_one_scene(tmp_path):
    out = tmp_path / "town"
    out.mkdir()
    write(out / "tileset.json", box(500))
    (capture,) = read_captures(out)
    assert (capture.name, len(capture.gaussians)) == ("town", 500)


def test_cameras_may_lie_elsewhere(tmp_path):
    (tmp_path / "a").mkdir()
    write(tmp_path / "a" / "hall.ply", box())
    cameras_json.write(tmp_path / "views.json", looking(5))
    (capture,) = read_captures(tmp_path / "a" / "hall.ply", cameras=tmp_path / "views.json", name="the hall")
    assert (len(capture.cameras), capture.name) == (5, "the hall")


def test_what_is_no_capture(tmp_path):
    with raises(NotFoundError, code="file_not_found"):
        read_captures(tmp_path / "none.ply")
    with raises(InputError, code="no_captures"):
        read_captures(tmp_path)
    (tmp_path / "a.xyz").touch()
    with raises(InputError, code="no_captures"):
        read_captures(tmp_path / "a.xyz")
    (tmp_path / "ckpt_29999_rank0.pt").touch()
    for given, code in ((tmp_path / "ckpt_29999_rank0.pt", "wrong_file_type"), (tmp_path, "no_captures")):
        with raises(InputError, code=code):
            read_captures(given)


@pytest.mark.parametrize(
    ("files", "newest"),
    [
        (
            ("nerfstudio_models/step-000002000.ckpt", "nerfstudio_models/step-000029999.ckpt", "config.yml"),
            "29999.ckpt",
        ),
        (("ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_29999_rank0.pt", "cfg.yml"), "ckpt_29999_rank0.pt"),
        (("ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_6999_rank1.pt"), None),
        (("chkpnt7000.pth", "chkpnt30000.pth"), "chkpnt30000.pth"),
        (("ckpts/ckpt_6999_rank0.pt", "a.ply"), "a.ply"),
        (("encoder.pt",), None),
    ],
)
def test_the_newest_checkpoint_of_a_trainer_where_there_is_nothing_else(tmp_path, files, newest):
    for name in files:
        (tmp_path / "room" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "room" / name).touch()
    if newest is None:
        with raises(InputError, code="no_captures"):
            find_captures([tmp_path / "room"])
        return
    (found,) = find_captures([tmp_path / "room"])
    assert found.path.name.endswith(newest)
    assert found.name == ("a" if newest == "a.ply" else "room")


@pytest.mark.parametrize("name", ["tileset.json", "lod-meta.json", "meta.json", "a.lcc", "a.ksplat"])
def test_a_folder_of_every_kind_is_one_capture(tmp_path, name):
    folder = tmp_path / "room"
    folder.mkdir()
    if name.endswith(".json"):
        write(folder / name, box())
    else:
        (folder / name).touch()
    (found,) = find_captures([folder])
    assert found.path == folder / name
    assert found.name == ("room" if name.endswith(".json") else "a")


def test_a_meta_json_of_something_else_is_no_capture(tmp_path):
    write(tmp_path / "a.ply", box())
    (tmp_path / "meta.json").write_text("{}")
    (found,) = find_captures([tmp_path])
    assert found.path.name == "a.ply"


def test_options(tmp_path):
    write(tmp_path / "a.ply", box())
    write(tmp_path / "b.ply", box())
    for wrong in ({"name": "x"}, {"cameras": tmp_path}):
        with raises(ConfigError, code="many_captures"):
            read_captures(tmp_path, **wrong)
    with raises(ConfigError, code="invalid_date"):
        read_captures(tmp_path / "a.ply", captured_at="yesterday")
    with raises(ConfigError, code="invalid_choice", match="auto, known, unknown, got 'metres'"):
        read_captures(tmp_path / "a.ply", scale_policy="metres")
    (capture,) = read_captures(tmp_path / "a.ply", captured_at="2026-05-31T14:00:00", scale_policy="known")
    assert capture.captured_at == "2026-05-31T14:00:00+00:00"
    assert capture.scale_policy == "known"
    (capture,) = read_captures(tmp_path / "a.ply", captured_at="2026-05-31T14:00+02:00")
    assert capture.captured_at == "2026-05-31T14:00:00+02:00"


def nerfstudio_capture(folder, frames: list[dict]) -> None:
    """Frames in the middle of the room, looking along z; each may have another lens."""
    write(folder / "splat.ply", box())
    pose = np.diag([1.0, -1, -1, 1]).tolist()
    frames = [{"file_path": f"{i}.jpg", "transform_matrix": pose} | frame for i, frame in enumerate(frames)]
    content = {"w": 64, "h": 48, "fl_x": 50, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def test_lenses_that_are_no_pinholes_are_noted_one_by_one(tmp_path):
    nerfstudio_capture(tmp_path, [{}, {"k1": -0.1}, {"camera_model": "EQUIRECTANGULAR"}, {"camera_model": "VR180_L"}])
    (capture,) = read_captures(tmp_path)
    assert capture.cameras.names[:3] == ("0.jpg", "1.jpg", "2.jpg#front")
    assert list(capture.cameras.photo_rows) == ["0.jpg", "1.jpg", "2.jpg"]
    assert sum("OPENCV" in note and " px" in note for note in capture.notes) == 1
    assert sum("EQUIRECTANGULAR" in note and "faces" in note for note in capture.notes) == 1
    assert sum("VR180_L" in note and "left out" in note for note in capture.notes) == 1


def test_a_capture_of_unknown_lenses_alone_is_ingested_without_its_cameras(tmp_path):
    nerfstudio_capture(tmp_path, [{"camera_model": "VR180_L"}] * 2)
    (capture,) = read_captures(tmp_path)
    assert capture.cameras.synthesised
    assert any("VR180_L" in note and "2 of 2" in note for note in capture.notes)
    with pytest.raises(NotPinholesError):  # the person asked for just these
        read_captures(tmp_path / "splat.ply", cameras=tmp_path / "transforms.json")


def test_house_finds_its_cameras(shared_data):
    found = find_captures([shared_data / "house"])
    assert [f.name for f in found] == ["c0", "c1", "c2", "c3", "c5"]
    assert [f.cameras.name for f in found] == [f"{f.name}.cameras.json" for f in found]


# -- validation


def test_a_sound_capture_passes():
    assert validate(box(), looking()) == ()


VALID = {("logit_opacities", np.inf), ("logit_opacities", -np.inf), ("log_scales", -np.inf)}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        (name, value)
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh")
        for value in (np.nan, np.inf, -np.inf)
        if (name, value) not in VALID
    ],
)
def test_nan_and_infinity_are_refused_with_their_row(name, value):
    array = getattr(box(), name).copy()
    array.reshape(len(array), -1)[17, -1] = value
    with raises(InputError, code="invalid_gaussians", match=rf"a\.ply.*{name}.*row 17"):
        validate(replaced(box(), **{name: array}), where="a.ply")
    array.reshape(len(array), -1)[40, -1] = value
    with raises(InputError, code="invalid_gaussians", match="row 17"):
        validate(replaced(box(), **{name: array}))


@pytest.mark.parametrize("suffix", [".ply", "memory", ".spz", ".sog", ".glb", ".splat", ".compressed.ply"])
def test_infinities_that_are_values_are_clamped_at_every_door(tmp_path, suffix):
    """An opacity of 1 has an infinite logit, a flat Gaussian a logarithm of minus infinity."""
    logits, log_scales = box().logit_opacities.copy(), box().log_scales.copy()
    logits[3], logits[4], log_scales[5, 0], log_scales[6] = np.inf, -np.inf, -np.inf, -np.inf
    given = replaced(box(), logit_opacities=logits, log_scales=log_scales)
    assert len(validate(given)) == 1
    if suffix == "memory":
        capture = take_capture(given, looking(), name="a")
    else:
        write(tmp_path / f"a{suffix}", given)
        cameras_json.write(tmp_path / "a.cameras.json", looking())
        assert validate(gsmap.formats.stream(tmp_path / f"a{suffix}")) is not None
        (capture,) = read_captures(tmp_path / f"a{suffix}")
    for got in (capture.gaussians, Gaussians.concatenate(list(capture.content.chunks()))):
        assert np.isfinite(got.logit_opacities).all()
        assert np.isfinite(got.log_scales).all()
        if suffix in (".ply", "memory"):  # others store in another order, and fewer bits
            np.testing.assert_allclose(got.opacities[[3, 4]], [1, 0], atol=1e-6)
            assert (got.scales[6] < 1e-8).all()
            sound = np.delete(np.arange(len(got)), [3, 4, 5, 6])
            np.testing.assert_array_equal(got.logit_opacities[sound], logits[sound])
            np.testing.assert_array_equal(got.log_scales[sound], log_scales[sound])
            assert any("infinite" in note for note in capture.notes)
    for name in ("log_scales", "logit_opacities"):
        assert all(np.isfinite(column).all() for column in capture.content.columns(name))


def test_stray_gaussians_far_away_are_noted():
    means = box().means.copy()
    assert not validate(replaced(box(), means=means))
    means[17, 1] = 1e7
    assert any("--clean" in note for note in validate(replaced(box(), means=means)))


def test_absurd_values_are_refused_with_their_row():
    scales = box().log_scales.copy()
    scales[3, 1] = np.log(1e6)
    with raises(InputError, code="invalid_gaussians", match="row 3"):
        validate(replaced(box(), log_scales=scales))
    scales[3, 1] = np.log(100)  # a far background is no mistake
    validate(replaced(box(), log_scales=scales))
    quats = box().quats.copy()
    quats[5] = 0
    with raises(InputError, code="invalid_gaussians", match="row 5"):
        validate(replaced(box(), quats=quats))
    with raises(InputError, code="no_gaussians"):
        validate(Gaussians.empty())


def test_large_finite_numbers_do_not_overflow_the_check():
    means = box().means.copy()
    means[0] = 3e38
    means[1] = 3e38
    validate(replaced(box(), means=means))


def test_cameras_of_impossible_images_are_refused():
    c = looking()
    sizes = c.sizes_px.copy()
    sizes[2] = 2_000_000_000
    with raises(InputError, code="invalid_camera"):
        validate(box(), Cameras(c.T_frame_camera, c.intrinsics_px, sizes))


def test_cameras_of_another_scene_are_refused():
    c = looking()
    away = c.T_frame_camera.copy()
    away[:, 2, 3] = 50  # behind the room, looking on
    with raises(InputError, code="cameras_see_nothing"):
        validate(box(), Cameras(away, c.intrinsics_px, c.sizes_px))
    away[1:, 2, 3] = 0
    assert validate(box(), Cameras(away, c.intrinsics_px, c.sizes_px)) == ("1 of 4 cameras see no Gaussian",)
    with raises(InputError, code="no_cameras"):
        validate(box(), c[:0])


def test_bad_file_is_refused_by_name(tmp_path):
    means = box().means.copy()
    means[9] = np.nan
    write(tmp_path / "bad.ply", replaced(box(), means=means))
    with raises(InputError, code="invalid_gaussians", match="row 9"):
        read_captures(tmp_path / "bad.ply")
