"""What gsmap writes, opened by viewers that others wrote, against what gsmap renders from the same camera.

They come from npm: ``npm install --prefix ~/.cache/gsmap/validators @sparkjsdev/spark three 3d-tiles-renderer
playcanvas babylonjs babylonjs-loaders cesium``.
"""

from __future__ import annotations

import json
import os
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from headless import Page

from gsmap import formats
from gsmap.evaluate.images import psnr
from gsmap.formats import tiles3d
from gsmap.formats.axes import axes_matrix
from gsmap.types import Cameras, Gaussians

PAGES = Path(__file__).parent / "viewers"
NPM = Path(os.environ.get("NPM_VALIDATORS", Path.home() / ".cache" / "gsmap" / "validators")) / "node_modules"
PACKAGES = {"spark": "@sparkjsdev/spark", "babylon": "babylonjs-loaders", "three_tiles": "3d-tiles-renderer"}
SIZE, FOV_DEG = 256, 45.0
EYE, TARGET = np.array([1.0, -0.8, -3.2]), np.array([0.1, 0.0, 0.2])
UP = np.array([0.0, -1.0, 0.0])  # right-down-front

pytestmark = pytest.mark.slow


class Files(SimpleHTTPRequestHandler):
    def translate_path(self, path: str) -> str:
        path = path.split("?", 1)[0]
        root, _, rest = path.lstrip("/").partition("/")
        folder = {"npm": NPM, "page": PAGES, "file": Path(self.directory)}.get(root, Path("/nonexistent"))
        return str(folder / rest)

    def log_message(self, *_: object) -> None: ...


@pytest.fixture
def served(tmp_path):
    Files.extensions_map = {**SimpleHTTPRequestHandler.extensions_map, ".mjs": "text/javascript"}
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()


def thing(degree: int) -> Gaussians:
    """No symmetry, long thin ellipsoids, and colours that change with the direction."""
    rng = np.random.default_rng(5)
    n = 250
    sh = np.concatenate([rng.uniform(-1, 1.5, (n, 1, 3)), rng.normal(0, 0.3, (n, 15, 3))], axis=1)
    return Gaussians(
        rng.normal(0, [0.6, 0.35, 0.45], (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform([-4.5, -3.5, -2.2], [-4, -2.8, -1.4], (n, 3)),
        rng.uniform(0, 4, n),
        sh[:, : (degree + 1) ** 2],
    )


def truth(g: Gaussians) -> np.ndarray:
    from gsmap.render import render

    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = EYE
    focal = SIZE / 2 / np.tan(np.radians(FOV_DEG) / 2)
    camera = Cameras(pose[None], np.array([[focal, focal, SIZE / 2, SIZE / 2]]), np.array([[SIZE, SIZE]]))
    return np.clip(render(g, camera, depth=False, dominant_id=False).colour[0], 0, 1)


def shown(viewer: str, url: str, name: str, axes: str, profile: Path) -> np.ndarray:
    """The picture that a viewer makes of a file whose own axes are ``axes``, from the one camera of this module."""
    M = axes_matrix(axes, "RDF")
    seen = {"eye": M @ EYE, "target": M @ TARGET, "up": M @ UP}
    return drawn(viewer, url, name, seen, FOV_DEG, (SIZE, SIZE), profile)


def drawn(
    viewer: str,
    url: str,
    name: str,
    seen: dict[str, np.ndarray],
    fov_deg: float,
    size: tuple[int, int],
    profile: Path,
    **more: object,
) -> np.ndarray:
    """The picture that a viewer makes of a file.

    Args:
        seen: ``eye``, ``target`` and ``up`` (3,) in the viewer's world.
        fov_deg: of the picture's height.
        size: width and height.
        more: what else the viewer's page is told.
    """
    package = PACKAGES.get(viewer, viewer)
    if not (NPM / package).is_dir():
        pytest.skip(f"needs {package} in {NPM.parent}: see the top of this file")
    query = {"file": f"/file/{name}", "fov": fov_deg} | more
    query |= {k: ",".join(map(repr, v.tolist())) for k, v in seen.items()}
    with Page(f"{url}/page/{viewer}.html?{urlencode(query)}", profile, *size) as page:
        page.wait("window.done === true || window.failure !== undefined", timeout_s=240)
        assert page.value("window.failure || null") is None
        return page.picture()


@pytest.mark.parametrize(
    ("viewer", "name", "axes", "degree"),
    [
        ("playcanvas", "a.glb", "LUF", 3),
        ("babylon", "a.glb", "LUF", 3),
        ("three", "a.glb", "LUF", 3),
        ("playcanvas", "a.compressed.ply", "RDF", 3),
        ("playcanvas", "a.ply", "RDF", 3),
        ("playcanvas", "a.sog", "RDF", 3),
        ("playcanvas", "s/meta.json", "RDF", 3),
        ("playcanvas", "s/lod-meta.json", "RDF", 3),
        ("spark", "a.sog", "RDF", 3),
        ("spark", "a.ply", "RDF", 3),
        ("spark", "a.compressed.ply", "RDF", 0),
        ("spark", "a.spz", "RUB", 3),
        ("spark", "a.splat", "RDF", 0),
    ],
)
def test_same_picture(viewer, name, axes, degree, served, tmp_path):
    g = thing(degree)
    formats.write(tmp_path / name, g)
    picture = shown(viewer, served, name, axes, tmp_path / "profile")
    decibels = psnr(picture, truth(g))
    assert decibels > 25
    if degree:  # the viewer draws them, and turned wrongly they would show
        assert decibels > psnr(picture, truth(replace(g, sh=g.sh[:, :1]))) + 5


@pytest.mark.parametrize("viewer", ["playcanvas", "babylon"])
def test_same_picture_of_a_3d_tiles_content(viewer, served, tmp_path):
    """Its node lays right-down-front on its side: what 3D Tiles stands up again, the camera does here."""
    g = thing(0)
    tiles3d.write_content(tmp_path / "a.glb", g, compressed=False)
    # y up from the z up that is stored: (x, z, -y).
    picture = shown(viewer, served, "a.glb", "RFU", tmp_path / "profile")
    assert psnr(picture, truth(g)) > 25


def on_earth() -> np.ndarray:
    """(4, 4) from right-down-front to earth-centred axes, upright on the ellipsoid (WGS 84) at 9 E 48 N."""
    longitude, latitude = np.radians([9.0, 48.0])
    e2 = 6.69437999014e-3
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([east, -up, np.cross(up, east)], axis=1)
    T[:3, 3] = 6378137.0 / np.sqrt(1 - e2 * np.sin(latitude) ** 2) * up * [1, 1, 1 - e2]
    return T


@pytest.mark.parametrize("degree", [0, 3])
def test_cesium_draws_a_tileset_on_the_earth(degree, served, tmp_path):
    """Packed, in several tiles, and turned by the root: degree 3 shows whether SH are turned with it."""
    g, T = thing(degree), on_earth()
    formats.write(tmp_path / "site" / "tileset.json", g, transform=T, max_per_tile=100)
    seen = {"eye": T[:3, :3] @ EYE + T[:3, 3], "target": T[:3, :3] @ TARGET + T[:3, 3], "up": T[:3, :3] @ UP}
    picture = drawn("cesium", served, "site/tileset.json", seen, FOV_DEG, (SIZE, SIZE), tmp_path / "profile")
    decibels = psnr(picture, truth(g))
    assert decibels > 25
    if degree:
        assert decibels > psnr(picture, truth(replace(g, sh=g.sh[:, :1]))) + 5


@pytest.mark.parametrize(("viewer", "least"), [("cesium", 35), ("three_tiles", 35), ("three", 28)])
def test_a_real_capture(viewer, least, served, tmp_path, shared_data):
    """What a 3D Tiles export looks like; three.js' own loader of one GLB lowers opacities as if every capture were
    trained antialiased."""
    from gsmap.render import render

    g = formats.read(shared_data / "house" / "c0.ply")
    cameras = formats.read_cameras(shared_data / "house" / "c0.cameras.json")
    if viewer == "cesium":
        name, T = "site/tileset.json", on_earth()
        formats.write(tmp_path / name, g, transform=T, max_per_tile=len(g))
    elif viewer == "three_tiles":
        name, T = "site/tileset.json", np.eye(4)
        T[:3, :3] = axes_matrix("RFU", "RDF")
        formats.write(tmp_path / name, g, transform=T, max_per_tile=60_000)
    else:
        name, T = "a.glb", np.eye(4)
        T[:3, :3] = axes_matrix("LUF", "RDF")
        formats.write(tmp_path / name, g)
    for k in (30, 60):
        pose, (width, height) = T @ cameras.T_frame_camera[k], cameras.sizes_px[k].tolist()
        seen = {"eye": pose[:3, 3], "target": pose[:3, 3] + pose[:3, 2], "up": -pose[:3, 1]}
        fov_deg = 2 * np.degrees(np.arctan(height / 2 / cameras.intrinsics_px[k, 1]))
        picture = drawn(viewer, served, name, seen, fov_deg, (width, height), tmp_path / f"profile{k}")
        ours = np.clip(render(g, cameras[k], depth=False, dominant_id=False).colour[0], 0, 1)
        assert psnr(picture, ours) > least


@pytest.mark.parametrize(
    ("coarsest", "kernel", "least"), [(0, "", 35), (1, "", 30), (0, "gaussian", 39), (1, "gaussian", 36)]
)
def test_playcanvas_streams_a_real_capture(coarsest, kernel, least, served, tmp_path, shared_data):
    """The finest and the coarsest level of a streamed SOG, each at the distance that it is for.

    PlayCanvas ends a Gaussian at 2.8 standard deviations and takes off what it has there: 2 % of an opacity, more where
    many lie over each other (35.4 and 32.8 dB when written). With its kernel made the Gaussian that was trained,
    nothing is left but rounding (41.4 and 37.3): the file is right.
    """
    from gsmap.formats import sog
    from gsmap.render import render

    g = formats.read(shared_data / "house" / "c0.ply")
    formats.write(tmp_path / "s" / "lod-meta.json", g, max_per_leaf=60_000)
    meta = json.loads((tmp_path / "s" / "lod-meta.json").read_text())
    level = meta["lodLevels"] - 1 if coarsest else 0
    if coarsest:  # one file, the root's
        (file,) = {leaf["lods"][str(level)]["file"] for leaf in leaves(meta["tree"]) if str(level) in leaf["lods"]}
        g = sog.read(tmp_path / "s" / meta["filenames"][file])
    camera = formats.read_cameras(shared_data / "house" / "c0.cameras.json")[30].resized(480 >> level)
    pose, (width, height) = camera.T_frame_camera[0], camera.sizes_px[0].tolist()
    seen = {"eye": pose[:3, 3], "target": pose[:3, 3] + pose[:3, 2], "up": -pose[:3, 1]}
    fov_deg = 2 * np.degrees(np.arctan(height / 2 / camera.intrinsics_px[0, 1]))
    place = "s/lod-meta.json", seen, fov_deg, (width, height), tmp_path / "profile"
    picture = drawn("playcanvas", served, *place, lod=level, kernel=kernel)
    assert psnr(picture, np.clip(render(g, camera, depth=False, dominant_id=False).colour[0], 0, 1)) > least


def leaves(node: dict) -> list[dict]:
    return [leaf for child in node.get("children", ()) for leaf in leaves(child)] or [node]
