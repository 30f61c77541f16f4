"""What gsmap writes, opened by viewers that others wrote, against what gsmap renders from the same camera.

They come from npm: ``npm install --prefix ~/.cache/gsmap/validators @sparkjsdev/spark three playcanvas babylonjs
babylonjs-loaders``.
"""

from __future__ import annotations

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
    package = {"spark": "@sparkjsdev/spark", "playcanvas": "playcanvas", "babylon": "babylonjs-loaders"}[viewer]
    if not (NPM / package).is_dir():
        pytest.skip(f"needs {package} in {NPM.parent}: see the top of this file")
    M = axes_matrix(axes, "RDF")
    query = {"file": f"/file/{name}", "fov": FOV_DEG}
    query |= {k: ",".join(map(str, M @ v)) for k, v in (("eye", EYE), ("target", TARGET), ("up", UP))}
    with Page(f"{url}/page/{viewer}.html?{urlencode(query)}", profile, SIZE, SIZE) as page:
        page.wait("window.done === true || window.failure !== undefined")
        assert page.value("window.failure || null") is None
        return page.picture()


@pytest.mark.parametrize(
    ("viewer", "name", "axes", "degree"),
    [
        ("playcanvas", "a.glb", "LUF", 3),
        ("babylon", "a.glb", "LUF", 3),
        ("playcanvas", "a.compressed.ply", "RDF", 3),
        ("playcanvas", "a.ply", "RDF", 3),
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
    tiles3d.write_content(tmp_path / "a.glb", g)
    # y up from the z up that is stored: (x, z, -y).
    picture = shown(viewer, served, "a.glb", "RFU", tmp_path / "profile")
    assert psnr(picture, truth(g)) > 25
