import json
import struct

import numpy as np
import pycolmap
import pytest
from raising import raises
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsmap.errors import InputError, NotFoundError, NotPinholesError
from gsmap.formats import cameras_json, read_cameras
from gsmap.types import Cameras

FLIP = np.diag([1.0, -1, -1, 1])


def some(n: int = 6) -> Cameras:
    rng = np.random.default_rng(2)
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, :3, :3] = Rotation.random(n, random_state=3).as_matrix()
    pose[:, :3, 3] = rng.normal(size=(n, 3))
    intrinsics = np.tile([500.0, 510, 322, 238], (n, 1))
    return Cameras(pose, intrinsics, np.tile([640, 480], (n, 1)), tuple(f"img_{i}.jpg" for i in range(n)))


def assert_close(a: Cameras, b: Cameras, atol: float = 1e-9) -> None:
    assert a.names == b.names
    np.testing.assert_allclose(a.T_frame_camera, b.T_frame_camera, atol=atol)
    np.testing.assert_allclose(a.intrinsics_px, b.intrinsics_px, atol=1e-9)
    np.testing.assert_array_equal(a.sizes_px, b.sizes_px)


def test_inria_round_trip(tmp_path):
    cameras_json.write(tmp_path / "cameras.json", some())
    assert_close(read_cameras(tmp_path / "cameras.json"), some())


def test_inria_real(shared_data):
    cameras = read_cameras(shared_data / "house" / "c0.cameras.json")
    assert len(cameras) == 90
    assert cameras.intrinsics_px[0].tolist() == [280, 280, 240, 180]


def write_colmap(folder, cameras: Cameras, *, text: bool, model: str = "PINHOLE") -> None:
    out = pycolmap.Reconstruction()
    fx, fy, cx, cy = cameras.intrinsics_px[0]
    params = {"PINHOLE": [fx, fy, cx, cy], "OPENCV": [fx, fy, cx, cy, 0.01, 0, 0, 0]}[model]
    width, height = cameras.sizes_px[0].tolist()
    camera = pycolmap.Camera(camera_id=7, model=model, width=width, height=height, params=params)
    out.add_camera_with_trivial_rig(camera)
    for i in reversed(range(len(cameras))):
        image = pycolmap.Image(name=cameras.names[i], camera_id=7, image_id=i + 1)
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cameras.T_camera_frame[i, :3]))
    folder.mkdir(parents=True)
    out.write_text(str(folder)) if text else out.write_binary(str(folder))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("files", [3, 5])
def test_colmap(tmp_path, text, files):
    folder = tmp_path / "sparse" / "0"
    write_colmap(folder, some(), text=text, model="OPENCV" if text else "PINHOLE")
    if files == 3:
        for path in [*folder.glob("rigs.*"), *folder.glob("frames.*")]:
            path.unlink()
    for given in (folder, tmp_path, tmp_path / "sparse"):
        assert_close(read_cameras(given), some(), 1e-6)


def test_damaged_colmap_is_refused(tmp_path):
    write_colmap(tmp_path / "whole", some(), text=False)
    files = {n: (tmp_path / "whole" / n).read_bytes() for n in ("cameras.bin", "images.bin")}
    cases = [(name, data[:size]) for name, data in files.items() for size in range(0, len(data), 7)]
    cases += [("images.bin", b"\xff" * 64), ("cameras.bin", b"\x01" + b"\0" * 11 + b"\xff" * 100)]
    cases += [("images.bin", b"\0" * 8), ("cameras.bin", b"\0" * 8)]
    for i, (name, data) in enumerate(cases):
        folder = tmp_path / str(i)
        folder.mkdir()
        for other, content in files.items():
            (folder / other).write_bytes(data if other == name else content)
        with raises(InputError, code=("file_truncated", "no_cameras", "file_damaged"), match=str(folder)):
            read_cameras(folder)


@pytest.mark.parametrize(
    "line", ["1 PINHOLE 640 480 500", "1 NONSENSE 640 480 1 2 3 4", "1 PINHOLE", "x PINHOLE 1 1 1"]
)
def test_damaged_colmap_text_is_refused(tmp_path, line):
    write_colmap(tmp_path / "model", some(), text=True)
    (tmp_path / "model" / "cameras.txt").write_text(line + "\n")
    with raises(InputError, code="file_truncated"):
        read_cameras(tmp_path / "model")


def test_nerfstudio_opengl(tmp_path):
    c = some()
    frames = [
        {"file_path": n, "transform_matrix": (p @ FLIP).tolist()}
        for n, p in zip(c.names, c.T_frame_camera, strict=True)
    ]
    content = {"fl_x": 500, "fl_y": 510, "cx": 322, "cy": 238, "w": 640, "h": 480, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_close(read_cameras(tmp_path / "transforms.json"), c)
    assert_close(read_cameras(tmp_path), c)


def test_nerfstudio_dataparser_frame(tmp_path):
    """Original coordinates -> (applied) -> transforms.json -> (orient, scale) -> training frame."""
    c = some()
    rng = np.random.default_rng(5)
    applied, orient = np.eye(4), np.eye(4)
    applied[:3, :3], orient[:3, :3] = Rotation.random(2, random_state=1).as_matrix()
    orient[:3, 3] = rng.normal(size=3)
    scale, applied_scale = 0.37, 2.5
    saved = np.linalg.inv(orient) @ c.T_frame_camera
    saved[:, :3, 3] = (np.linalg.inv(orient) @ np.c_[c.centers / scale, np.ones(len(c))].T).T[:, :3]
    frames = [
        {"file_path": n, "transform_matrix": (p @ FLIP).tolist(), "w": 640, "h": 480, "fl_x": 500, "fl_y": 510}
        | {"cx": 322, "cy": 238}
        for n, p in zip(c.names, saved, strict=True)
    ]
    content = {"frames": frames, "applied_transform": applied[:3].tolist(), "applied_scale": applied_scale}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    change = {"transform": (orient @ applied)[:3].tolist(), "scale": scale * applied_scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(change))
    assert_close(read_cameras(tmp_path / "transforms.json"), c)


def test_blender_angle_and_image_size(tmp_path):
    from PIL import Image

    Image.new("RGB", (80, 60)).save(tmp_path / "r_0.png")
    frames = [{"file_path": "./r_0", "transform_matrix": np.eye(4).tolist()}]
    content = {"camera_angle_x": np.pi / 2, "cx": None, "cy": None, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    cameras = read_cameras(tmp_path)
    assert cameras.sizes_px[0].tolist() == [80, 60]
    np.testing.assert_allclose(cameras.intrinsics_px[0], [40, 40, 40, 30])


BAD = {
    "not json": ("{", "not_json", "line 1 column 2"),
    "deep": ("[" * 100_000, "not_json", r"c\.json"),
    "empty list": ("[]", "no_cameras", "the list is empty"),
    "number": ("3", "invalid_cameras", r"c\.json"),
    "no frames": ("{}", "invalid_cameras", "'frames'"),
    "empty frames": ('{"frames": []}', "no_cameras", "list of frames is empty"),
    "strings": ('["a"]', "invalid_cameras", r"c\.json"),
    "lacks": ('[{"rotation": [[1,0,0],[0,1,0],[0,0,1]]}]', "invalid_cameras", "'position'"),
    "nan": (
        '[{"rotation": [[1,0,0],[0,1,0],[0,0,NaN]], "position": [0,0,0], "width": 1, "height": 1, "fx": 1, "fy": 1}]',
        "invalid_cameras",
        "camera 0 holds NaN",
    ),
    "mirrored": (
        '[{"rotation": [[1,0,0],[0,1,0],[0,0,-1]], "position": [0,0,0], "width": 1, "height": 1, "fx": 1, "fy": 1}]',
        "invalid_cameras",
        "camera 0 .*rigid",
    ),
    "mirrored frame": (
        '{"w": 4, "h": 4, "fl_x": 4, "frames": [{"file_path": "a", "transform_matrix": '
        "[[-2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}]}",
        "invalid_cameras",
        "camera a .*rigid",
    ),
    "no focal": (
        '{"w": 4, "h": 4, "frames": [{"file_path": "a", "transform_matrix": '
        "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}",
        "incomplete_camera",
        "frame a .*focal",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files(tmp_path, case):
    text, code, match = BAD[case]
    (tmp_path / "c.json").write_text(text)
    with raises(InputError, code=code, match=match) as caught:
        read_cameras(tmp_path / "c.json")
    assert "c.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing(tmp_path):
    with pytest.raises(NotFoundError):
        read_cameras(tmp_path / "none.json")
    with raises(InputError, code="no_cameras"):
        read_cameras(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_a_camera_without_a_focal_length_is_a_panorama(tmp_path, text):
    """pycolmap ends the process when it is asked for the focal length of one."""
    folder = tmp_path / "sparse"
    write_colmap(folder, some(), text=text)
    if text:
        (folder / "cameras.txt").write_text("7 EQUIRECTANGULAR 640 320 640 320\n")
    else:
        (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 7, 17, 640, 320, 640, 320))
    assert len(read_cameras(folder)) == 6 * len(some())


SIZE = (800, 600)
LENSES = {
    "SIMPLE_RADIAL": [700, 400, 300, -0.12],
    "OPENCV": [700, 710, 410, 290, -0.15, 0.05, 0.001, -0.002],
    "FULL_OPENCV": [700, 710, 410, 290, -0.15, 0.05, 0.001, -0.002, 0.01, 0.02, 0.0, 0.0],
    "OPENCV_FISHEYE": [900, 900, 400, 300, 0.02, 0.0, 0.0, 0.0],
    "EUCM": [900, 900, 400, 300, 0.3, 1.0],
}
WIDE = {
    "OPENCV_FISHEYE": [300, 300, 400, 300, 0.0, 0.0, 0.0, 0.0],  # 95 degrees from the axis at a corner
    "SIMPLE_FISHEYE": [400, 400, 300],  # 72 degrees
    "EUCM": [400, 400, 400, 300, 0.6, 1.1],
    "SIMPLE_RADIAL": [300, 400, 300, -0.9],  # a corner is no pixel of any ray
    "EQUIRECTANGULAR": [800, 600],
}


def write_text_model(folder, models: list[tuple[str, list[float]]]) -> Cameras:
    """Cameras in a circle, the i-th with the i-th model."""
    cameras = some(len(models))
    folder.mkdir(parents=True)
    params = [f"{i + 1} {model} 800 600 {' '.join(map(str, values))}" for i, (model, values) in enumerate(models)]
    (folder / "cameras.txt").write_text("\n".join(params) + "\n")
    lines = []
    for i, T in enumerate(cameras.T_camera_frame):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines += [f"{i + 1} {w} {x} {y} {z} {' '.join(map(str, T[:3, 3]))} {i + 1} {cameras.names[i]}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return cameras


def shift_at_corners(model: str, params: list[float]) -> float:
    """How far the pinhole projects the ray of a corner from it, the ray being solved for by forward projection."""
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params)
    f = np.array([camera.focal_length_x, camera.focal_length_y])
    c = np.array([camera.principal_point_x, camera.principal_point_y])
    found = []
    for corner in np.array([[0, 0], [800, 0], [0, 600], [800, 600]], float):
        ray = least_squares(lambda uv, at=corner: camera.img_from_cam(np.array([*uv, 1.0])) - at, (corner - c) / f).x
        found.append(np.linalg.norm(ray * f + c - corner))
    return float(max(found))


@pytest.mark.parametrize("model", LENSES)
def test_distortion_is_noted_with_its_pixels_at_a_corner(tmp_path, model):
    want = write_text_model(tmp_path / "sparse", [(model, LENSES[model]), ("PINHOLE", [700, 700, 400, 300])])
    cameras = read_cameras(tmp_path / "sparse")
    np.testing.assert_allclose(cameras.T_frame_camera, want.T_frame_camera, atol=1e-9)
    (note,) = cameras.notes
    assert f"1 of 2 cameras have distortion ({model})" in note
    assert f"{shift_at_corners(model, LENSES[model]):.3g} px" in note


@pytest.mark.parametrize("model", WIDE)
def test_what_no_pinhole_stands_for_is_seen_by_faces(tmp_path, model):
    pinhole = ("PINHOLE", [700, 700, 400, 300])
    want = write_text_model(tmp_path / "sparse", [pinhole, (model, WIDE[model]), pinhole])
    cameras = read_cameras(tmp_path / "sparse")
    assert (cameras.names[0], cameras.names[-1]) == (want.names[0], want.names[2])
    np.testing.assert_allclose(cameras.T_frame_camera[[0, -1]], want.T_frame_camera[[0, 2]], atol=1e-9)
    rows = cameras.photo_rows[want.names[1]]
    assert 1 <= len(rows) <= 6
    np.testing.assert_allclose(cameras.centers[rows], np.tile(want.centers[1], (len(rows), 1)), atol=1e-9)
    np.testing.assert_allclose(cameras.T_frame_camera[rows[0]], want.T_frame_camera[1], atol=1e-9)
    assert cameras.intrinsics_px[rows, 0] == pytest.approx(cameras.sizes_px[rows, 0] / 2)
    (note,) = cameras.notes
    assert f"1 of 3 cameras are too wide for one pinhole ({model})" in note


def transforms(path, shared: dict, frames: list[dict]) -> None:
    frames = [
        {"file_path": f"{i}.jpg", "transform_matrix": np.eye(4).tolist()} | frame for i, frame in enumerate(frames)
    ]
    path.write_text(json.dumps({"w": 800, "h": 600, "fl_x": 700, "cx": 400, "cy": 300} | shared | {"frames": frames}))


@pytest.mark.parametrize(
    ("shared", "model", "params"),
    [
        ({"k1": -0.12}, "SIMPLE_RADIAL", [700, 400, 300, -0.12]),
        ({"camera_model": "SIMPLE_RADIAL", "k1": -0.12}, "SIMPLE_RADIAL", [700, 400, 300, -0.12]),
        (
            {"camera_model": "OPENCV", "k1": -0.1, "k2": 0.05, "k3": 0.02, "p1": 1e-3, "p2": -2e-3},
            "FULL_OPENCV",
            [700, 700, 400, 300, -0.1, 0.05, 1e-3, -2e-3, 0.02, 0, 0, 0],
        ),
        ({"is_fisheye": True, "fl_x": 900, "k1": 0.02}, "OPENCV_FISHEYE", [900, 900, 400, 300, 0.02, 0, 0, 0]),
    ],
)
def test_distortion_of_transforms_is_noted(tmp_path, shared, model, params):
    transforms(tmp_path / "t.json", shared, [{}, {}])
    (note,) = read_cameras(tmp_path / "t.json").notes
    assert note.startswith("2 of 2 cameras")
    assert f"{shift_at_corners(model, params):.3g} px" in note


@pytest.mark.parametrize("lens", [{"camera_model": "VR180_L"}, {"k1": 0.1, "k4": 0.1}, {"camera_model": "FISHEYE624"}])
def test_transforms_of_unknown_lenses_are_left_out_by_frame(tmp_path, lens):
    transforms(tmp_path / "t.json", {}, [{}, lens, {}])
    cameras = read_cameras(tmp_path / "t.json")
    assert cameras.names == ("0.jpg", "2.jpg")
    assert len(cameras.notes) == 1
    transforms(tmp_path / "t.json", lens, [{}])
    with raises(NotPinholesError, code="not_pinholes"):
        read_cameras(tmp_path / "t.json")


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        ({"camera_model": "EQUIRECTANGULAR", "fl_x": None, "h": 400}, "EQUIRECTANGULAR"),
        ({"camera_model": "FISHEYE", "fl_x": 300}, "OPENCV_FISHEYE"),
        (
            {"camera_model": "FISHEYE624", "fl_x": 300, "distortion_params": [0.01] + [0] * 11},
            "RAD_TAN_THIN_PRISM_FISHEYE",
        ),
    ],
)
def test_panoramas_and_wide_lenses_of_transforms_have_faces(tmp_path, lens, model):
    transforms(tmp_path / "t.json", lens, [{}])
    cameras = read_cameras(tmp_path / "t.json")
    assert cameras.names[0] == "0.jpg#front"
    assert {one.model.name for one in cameras.lenses} == {model}


def test_undistorted_cameras_have_no_note(tmp_path):
    transforms(tmp_path / "t.json", {"camera_model": "OPENCV", "k1": 0.0, "p1": 0}, [{}])
    assert not read_cameras(tmp_path / "t.json").notes
    write_text_model(tmp_path / "sparse", [("OPENCV", [700, 700, 400, 300, 0, 0, 0, 0]), ("SIMPLE_PINHOLE", [7, 4, 3])])
    assert not read_cameras(tmp_path / "sparse").notes
