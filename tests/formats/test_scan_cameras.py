"""Cameras of Metashape, OPF, Polycam, Record3D and Stray Scanner, against the formulas of their manuals."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap import formats
from gsmap.errors import InputError, NotPinholesError
from gsmap.formats import read_cameras
from gsmap.geometry.camera_models import project_with
from gsmap.ingest import read_captures
from gsmap.ingest.capture_search import find_captures
from gsmap.types import Cameras, Gaussians

POINTS = np.random.default_rng(5).uniform([-1, -0.7, 1.5], [1, 0.7, 3], (40, 3))  # in right-down-front camera axes
POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("XYZ", [20, -35, 140], degrees=True).as_matrix()
POSE[:3, 3] = [3.0, -2.0, 10.0]
RIGHT_UP_BACK = np.diag([1.0, -1, -1, 1])


def pixels(cameras: Cameras, row: int = 0) -> np.ndarray:
    """Pixels of `POINTS` in the photo of a camera."""
    lens = cameras.lenses[row] if cameras.lenses else None
    if lens is not None:
        return project_with(lens.model, POINTS @ lens.R_photo_camera.T)
    fx, fy, cx, cy = cameras.intrinsics_px[row]
    return POINTS[:, :2] / POINTS[:, 2:] * [fx, fy] + [cx, cy]


def metashape(sensor: str = "frame", values: str = "", component: str = "", camera: str = "") -> str:
    numbers = " ".join(f"{value:.17g}" for value in POSE.ravel())
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
 <sensors next_id="1"><sensor id="0" label="FC6310" type="{sensor}">
  <resolution width="640" height="480"/>
  <calibration type="{sensor}" class="initial"><resolution width="640" height="480"/><f>1</f></calibration>
  <calibration type="{sensor}" class="adjusted"><resolution width="640" height="480"/><f>500</f>{values}</calibration>
 </sensor></sensors>
 <components next_id="1"><component id="0" label="Component 1">{component}</component></components>
 <cameras next_id="3"><group id="0" label="flight"><camera id="0" sensor_id="0" component_id="0" label="a.jpg">
   <transform>{numbers}</transform></camera></group>
  <camera id="1" sensor_id="0" label="unaligned.jpg"/>{camera}</cameras>
</chunk></document>"""


def test_metashape_frame_lens_and_pose(tmp_path: Path) -> None:
    values = {"cx": 7.5, "cy": -4.25, "b1": 3.5, "k1": -0.1, "k2": 0.05, "k3": -0.01, "p1": 0.002, "p2": -0.003}
    text = metashape(values="".join(f"<{name}>{value}</{name}>" for name, value in values.items()))
    (tmp_path / "cameras.xml").write_text(text)
    cameras = read_cameras(tmp_path)
    assert cameras.names == ("a.jpg",)
    np.testing.assert_allclose(cameras.T_frame_camera[0], POSE, atol=1e-12)
    # Metashape's manual, "Camera models", frame cameras
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    r2 = x**2 + y**2
    radial = 1 - 0.1 * r2 + 0.05 * r2**2 - 0.01 * r2**3
    u = x * radial + 0.002 * (r2 + 2 * x**2) + 2 * -0.003 * x * y
    v = y * radial + -0.003 * (r2 + 2 * y**2) + 2 * 0.002 * x * y
    expected = np.c_[320 + 7.5 + u * 500 + u * 3.5, 240 - 4.25 + v * 500]
    np.testing.assert_allclose(pixels(cameras), expected, atol=1e-6)


def test_metashape_components_and_other_lenses(tmp_path: Path) -> None:
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    numbers = " ".join(map(str, turn.ravel()))
    component = f"<transform><rotation>{numbers}</rotation><translation>1 2 3</translation><scale>2</scale></transform>"
    path = tmp_path / "site.xml"
    path.write_text(metashape(component=component))
    cameras = read_cameras(path)
    np.testing.assert_allclose(cameras.centers[0], turn @ POSE[:3, 3] * 2 + [1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(cameras.T_frame_camera[0, :3, :3], turn @ POSE[:3, :3], atol=1e-9)
    path.write_text(metashape("fisheye", "<k1>0.01</k1><k4>0.002</k4>"))
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    r = np.hypot(x, y)
    theta = np.arctan(r)
    scale = theta * (1 + 0.01 * theta**2 + 0.002 * theta**8) / r
    np.testing.assert_allclose(
        pixels(read_cameras(path)), np.c_[320 + x * scale * 500, 240 + y * scale * 500], atol=1e-6
    )
    path.write_text(metashape("spherical"))
    assert len(read_cameras(path)) == 6


@pytest.mark.parametrize(
    ("sensor", "values"), [("frame", "<k4>0.1</k4>"), ("frame", "<b2>1</b2>"), ("fisheye", "<p1>0.1</p1>"), ("rpc", "")]
)
def test_metashape_lenses_that_colmap_lacks_are_named(tmp_path: Path, sensor: str, values: str) -> None:
    (tmp_path / "cameras.xml").write_text(metashape(sensor, values))
    with raises(NotPinholesError, code="not_pinholes", match=sensor):
        read_cameras(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<document/>",
        "<document><chunk/></document>",
        metashape()[:700],
        '<!DOCTYPE d [<!ENTITY a "b">]>' + metashape().partition("?>")[2],
        metashape(component="<transform><scale>1</scale></transform>").replace(
            "<components", '<reference>GEOGCS["WGS 84"]</reference><components'
        ),
        metashape().replace('width="640"', 'width="x"'),
        metashape().replace("<f>500</f>", "<f>0</f>"),
        metashape(component="<transform><rotation>-1 0 0 0 1 0 0 0 1</rotation></transform>"),
    ],
    ids=("empty", "no chunk", "no cameras", "cut", "entities", "Earth-centred", "size", "focal length", "mirrored"),
)
def test_damaged_metashape_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "cameras.xml").write_text(text)
    with raises(InputError, code=("invalid_cameras", "no_cameras"), match="cameras.xml"):
        read_cameras(tmp_path / "cameras.xml")


def test_entities_in_another_encoding_are_refused(tmp_path: Path) -> None:
    text = '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE d [<!ENTITY a "b">]><d>&a;</d>'
    (tmp_path / "cameras.xml").write_bytes(text.encode("utf-16"))
    with raises(InputError, code="invalid_cameras"):
        read_cameras(tmp_path)


def opf(folder: Path, internals: dict[str, Any] | None = None, uri: str = "calibrated.json") -> Path:
    """The parts of a project as opf-spec lays them out."""
    internals = internals or {
        "type": "perspective",
        "principal_point_px": [322.0, 238.5],
        "focal_length_px": 510.0,
        "radial_distortion": [-0.1, 0.05, -0.01],
        "tangential_distortion": [0.002, -0.003],
    }
    angles = Rotation.from_matrix((POSE @ RIGHT_UP_BACK)[:3, :3]).as_euler("XYZ", degrees=True).tolist()
    camera = {"id": 7, "sensor_id": 1, "position": POSE[:3, 3].tolist(), "orientation_deg": angles}
    parts = {
        "calibrated-cameras": {"sensors": [{"id": 1, "internals": internals}], "cameras": [camera]},
        "input-cameras": {"sensors": [{"id": 1, "image_size_px": [640, 480]}], "captures": []},
        "camera-list": {"cameras": [{"id": 7, "uri": "file:///c:/data/my%20images/DJI_1.jpg"}]},
    }
    items = []
    for kind, content in parts.items():
        place = uri if kind == "calibrated-cameras" else f"{kind}.json"
        items.append({"type": kind, "resources": [{"uri": place, "format": f"application/opf-{kind}+json"}]})
        (folder / Path(place).name).write_text(json.dumps(content))
    (folder / "project.opf").write_text(json.dumps({"format": "application/opf-project+json", "items": items}))
    return folder / "project.opf"


def test_opf(tmp_path: Path) -> None:
    opf(tmp_path)
    cameras = read_cameras(tmp_path)
    assert cameras.names == ("DJI_1.jpg",)
    np.testing.assert_allclose(cameras.T_frame_camera[0], POSE, atol=1e-9)
    # Pix4D's knowledge base, article 202559089, perspective lens
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    r2 = x**2 + y**2
    radial = 1 - 0.1 * r2 + 0.05 * r2**2 - 0.01 * r2**3
    u = x * radial + 2 * 0.002 * x * y + -0.003 * (r2 + 2 * x**2)
    v = y * radial + 2 * -0.003 * x * y + 0.002 * (r2 + 2 * y**2)
    np.testing.assert_allclose(pixels(cameras), np.c_[u, v] * 510 + [322.0, 238.5], atol=1e-6)


def test_a_panorama_of_opf_faces_along_the_axes_of_its_camera(tmp_path: Path) -> None:
    cameras = read_cameras(opf(tmp_path, {"type": "spherical", "principal_point_px": [320.0, 240.0]}))
    assert len(cameras) == 6
    assert cameras.names[0] == "DJI_1.jpg#front"
    np.testing.assert_allclose(cameras.T_frame_camera[0], POSE, atol=1e-9)


def test_opf_names_nothing_outside_its_folder(tmp_path: Path) -> None:
    (tmp_path / "project").mkdir()
    for uri in ("../calibrated.json", "file:///etc/passwd", "/etc/passwd"):
        with raises(InputError, code="invalid_cameras"):
            read_cameras(opf(tmp_path / "project", uri=uri))
    project = opf(tmp_path, {"type": "fisheye"})
    with raises(NotPinholesError, code="not_pinholes", match="OPF fisheye"):
        read_cameras(project)
    content = json.loads(project.read_text())
    content["items"].pop(0)
    project.write_text(json.dumps(content))
    with raises(InputError, code="no_cameras", match="calibrated"):
        read_cameras(project)


def test_polycam(tmp_path: Path) -> None:
    folder = tmp_path / "keyframes" / "corrected_cameras"
    folder.mkdir(parents=True)
    arkit = POSE @ RIGHT_UP_BACK
    one = {f"t_{row}{column}": arkit[row, column] for row in range(3) for column in range(4)}
    lens = {"fx": 700.0, "fy": 701.0, "cx": 510.0, "cy": 380.0, "width": 1024, "height": 768}
    (folder / "123.json").write_text(json.dumps(one | lens | {"blur_score": 90.0}))
    (tmp_path / "keyframes" / "cameras").mkdir()
    cameras = read_cameras(tmp_path)
    assert (cameras.names, cameras.sizes_px.tolist()) == (("123.jpg",), [[1024, 768]])
    np.testing.assert_allclose(cameras.T_frame_camera[0], POSE, atol=1e-12)
    assert cameras.intrinsics_px[0].tolist() == [700, 701, 510, 380]


def test_a_folder_called_cameras_is_read_for_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras" / "cameras.xml").write_text(metashape())
    assert read_cameras(tmp_path / "cameras").names == ("a.jpg",)


def test_record3d(tmp_path: Path) -> None:
    quat = Rotation.from_matrix((POSE @ RIGHT_UP_BACK)[:3, :3]).as_quat()
    content = {"w": 720, "h": 960, "K": [710, 0, 0, 0, 711, 0, 361, 482, 1], "poses": [[*quat, *POSE[:3, 3]]] * 2}
    (tmp_path / "metadata.json").write_text(json.dumps(content))
    cameras = read_cameras(tmp_path)
    assert (cameras.names, cameras.sizes_px.tolist()) == (("0.jpg", "1.jpg"), [[720, 960]] * 2)
    np.testing.assert_allclose(cameras.T_frame_camera[1], POSE, atol=1e-9)
    assert cameras.intrinsics_px[0].tolist() == [710, 711, 361, 482]


def mp4(width: int, height: int) -> bytes:
    """A video: pictures that hold the name of a header, and headers of sound, which has no size, and of a picture."""

    def box(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I4s", 8 + len(content), kind) + content

    heads = [box(b"tkhd", b"\0" * 76 + struct.pack(">II", w << 16, h << 16)) for w, h in ((0, 0), (width, height))]
    return box(b"ftyp", b"mp42") + box(b"mdat", b"tkhd" * 30) + box(b"moov", b"".join(heads))


def test_stray_scanner(tmp_path: Path) -> None:
    quat = Rotation.from_matrix(POSE[:3, :3]).as_quat()
    row = ", ".join(map(str, ["0.5", "000000", *POSE[:3, 3], *quat]))
    (tmp_path / "odometry.csv").write_text(f"timestamp, frame, x, y, z, qx, qy, qz, qw\n{row}\n")
    (tmp_path / "camera_matrix.csv").write_text("1400.0, 0.0, 958.0\n0.0, 1401.0, 722.0\n0.0, 0.0, 1.0\n")
    with raises(InputError, code="invalid_cameras", match=r"rgb\.mp4"):
        read_cameras(tmp_path)
    for damaged in (b"", mp4(1920, 1440)[:-90], b"tkhd", mp4(0, 0), b"\xff\xff\xff\xffmoov\xff\xff\xff\xfftkhd"):
        (tmp_path / "rgb.mp4").write_bytes(damaged)
        with raises(InputError, code="invalid_cameras", match=r"rgb\.mp4"):
            read_cameras(tmp_path)
    (tmp_path / "rgb.mp4").write_bytes(mp4(1920, 1440))
    cameras = read_cameras(tmp_path)
    assert (cameras.names, cameras.sizes_px.tolist()) == (("000000",), [[1920, 1440]])
    np.testing.assert_allclose(cameras.T_frame_camera[0], POSE, atol=1e-9)
    assert cameras.intrinsics_px[0].tolist() == [1400, 1401, 958, 722]


def test_captures_are_found_with_them(tmp_path: Path) -> None:
    splat = Gaussians(np.eye(3), np.tile([1.0, 0, 0, 0], (3, 1)), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 1, 3)))
    for name, make in {"site": lambda place: (place / "cameras.xml").write_text(metashape()), "drone": opf}.items():
        (tmp_path / name).mkdir()
        formats.write(tmp_path / name / "scene.ply", splat)
        make(tmp_path / name)
    found = {files.cameras.name for files in find_captures([tmp_path]) if files.cameras}
    assert found == {"cameras.xml", "project.opf"}


def test_what_only_lies_beside_a_splat_does_not_end_its_ingest(tmp_path: Path) -> None:
    splat = Gaussians(np.eye(3), np.tile([1.0, 0, 0, 0], (3, 1)), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 1, 3)))
    far = metashape(component="<transform><translation>4e6 0 0</translation></transform>")
    foreign = {
        "book.opf": "<package/>",
        "cameras.xml": "<rss/>",
        "metadata.json": '{"poses": [[1]], "K": 1, "w": 1, "h": 1}',
    }
    for number, (name, text) in enumerate([*foreign.items(), ("cameras.xml", far)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        formats.write(folder / "hall.ply", splat)
        (folder / name).write_text(text)
        (capture,) = read_captures([folder])
        assert capture.cameras.synthesised
        assert any(name in note for note in capture.notes)
        with raises(InputError, code=("not_json", "no_cameras", "invalid_cameras", "cameras_see_nothing")):
            read_captures([folder / "hall.ply"], cameras=folder / name)
