"""Photos of other lenses are localized without distortion, and panoramas by their faces."""

import numpy as np
import pytest
from PIL import Image
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap.errors import ConfigError, InputError
from gsmap.geometry.camera_models import camera_model, pinhole_views, rays_of
from gsmap.localize import combine_faces, read_photo
from gsmap.localize.photos import Lens, make_photo
from gsmap.map.localization.photo_localization import parse_lens
from gsmap.types.localization import LocalizationResult, Photo


def photo_of_rays(name: str, size: tuple[int, int], params: tuple[float, ...]) -> np.ndarray:
    """A photo whose colours are the directions."""
    model = camera_model(name, *size, params)
    grid = np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), -1).reshape(-1, 2)
    colours = 127.5 * (1 + np.nan_to_num(rays_of(model, grid)))
    return colours.round().astype(np.uint8).reshape(size[1], size[0], 3)


def colours_are_rays(photo: Photo, turn: np.ndarray) -> bool:
    fx, fy, cx, cy = photo.intrinsics_px
    width, height = photo.size_px
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ turn.T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    known = np.ones((height, width), bool) if photo.known is None else photo.known
    return known.mean() > 0.9 and np.quantile(np.abs(photo.rgb - 127.5 * (1 + rays))[known], 0.999) < 4


def test_a_photo_is_undistorted_by_its_model():
    lens = parse_lens("opencv,300,310,165,118,-0.15,0.02,0.001,-0.001", None)
    photo = make_photo(photo_of_rays("OPENCV", (320, 240), lens.model[1]), None, lens)
    assert (photo.lens, photo.faces, photo.focal_sigma) == ("OPENCV", (), 0.0)
    assert photo.intrinsics_px.tolist() == [300, 310, 165, 118]
    assert colours_are_rays(photo, np.eye(3))


@pytest.mark.parametrize("said", ["option", "metadata"])
def test_a_panorama_consists_of_six_faces(tmp_path, said):
    rgb = photo_of_rays("EQUIRECTANGULAR", (640, 320), (640.0, 320.0))
    xmp = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    more = {"xmp": xmp} if said == "metadata" else {}
    Image.fromarray(rgb).save(tmp_path / "a.jpg", quality=100, subsampling=0, **more)
    lens = Lens() if said == "metadata" else parse_lens("EQUIRECTANGULAR", None)
    photo = read_photo(tmp_path / "a.jpg", lens)
    assert (photo.lens, len(photo.faces)) == ("EQUIRECTANGULAR", 6)
    assert all(colours_are_rays(face, turn) for face, turn in photo.faces)
    assert said == "option" or len(read_photo(tmp_path / "a.jpg", parse_lens(None, "auto")).faces) == 6
    # What is specified counts more than what the metadata say.
    assert not read_photo(tmp_path / "a.jpg", Lens(focal_px=300.0)).faces


def test_masked_pixels_stay_masked_without_distortion():
    lens = parse_lens("EQUIRECTANGULAR", None)
    known = np.ones((160, 320), bool)
    known[:, :160] = False  # the left half
    photo = make_photo(photo_of_rays("EQUIRECTANGULAR", (320, 160), (320.0, 160.0)), None, lens, known=known)
    share = [1.0 if face.known is None else face.known.mean() for face, _ in photo.faces]
    np.testing.assert_allclose(share, [0.5, 1, 0.5, 0, 0.5, 0.5], atol=0.03)


def test_wrong_models_and_panoramas_are_refused():
    for wrong in ("NO_SUCH_MODEL,1,2,3", "OPENCV,1,2,3", "OPENCV", "EUCM,1,2,3,4,x"):
        with raises(ConfigError, code="invalid_intrinsics"):
            parse_lens(wrong, None)
    with raises(InputError, code="size_mismatch"):
        make_photo(np.zeros((100, 300, 3), np.uint8), None, parse_lens("EQUIRECTANGULAR", None))


def placed(face: str, pose: np.ndarray, probability: float = 0.9, component: int = 0) -> LocalizationResult:
    covariance = np.diag([1e-6] * 3 + [1e-4, 1e-4, 4e-4])
    return LocalizationResult("", pose, covariance, component, ("s",), probability, np.full(4, 100.0), name=face)


def test_faces_that_agree_place_their_photo():
    rng = np.random.default_rng(0)
    views = pinhole_views(camera_model("EQUIRECTANGULAR", 640, 320, (640.0, 320.0)), np.eye(4), "p")
    blank = Photo(np.zeros((2, 2, 3), np.uint8), np.ones(4))
    photo = Photo(blank.rgb, np.ones(4), name="p", faces=tuple((blank, lens.R_photo_camera) for lens in views.lenses))
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = Rotation.from_rotvec([0.3, -2, 1]).as_matrix(), (1, 2, 3)
    refused = LocalizationResult("nothing in the map looks like it", probability=0.1, name="f")

    def seen(row: int, shift: float = 0.0) -> LocalizationResult:
        pose = truth.copy()
        pose[:3, :3] = truth[:3, :3] @ views.lenses[row].R_photo_camera
        pose[:3, 3] += pose[:3, :3] @ (rng.normal(size=3) * [0.01, 0.01, 0.02]) + shift
        return placed(views.names[row], pose)

    found = combine_faces(photo, [seen(0), seen(1), refused, seen(3), refused, refused])
    assert found.is_placed
    assert found.probability == pytest.approx(0.999)
    np.testing.assert_allclose(found.T_map_camera[:3, 3], truth[:3, 3], atol=0.03)
    np.testing.assert_allclose(found.T_map_camera[:3, :3], truth[:3, :3], atol=0.01)
    assert np.sqrt(np.diag(found.covariance)[3:]).max() < 0.02
    # One of four lies elsewhere: the majority counts; of two, none does.
    outvoted = combine_faces(photo, [seen(0), seen(1), seen(2), seen(3, 2.0), refused, refused])
    np.testing.assert_allclose(outvoted.T_map_camera[:3, 3], truth[:3, 3], atol=0.03)
    torn = combine_faces(photo, [seen(0), refused, refused, seen(3, 2.0), refused, refused])
    assert (torn.is_placed, torn.reason_code, torn.T_map_camera) == (False, "ambiguous", None)
    none = combine_faces(photo, [refused] * 6)
    assert (none.is_placed, none.reason) == (False, refused.reason)
