import gzip
import http.client
import json
import urllib.error
import urllib.request

import numpy as np
import pytest
from headless import Page

from gsmap.errors import ConfigError, InputError
from gsmap.evaluate.images import psnr
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Cameras, Gaussians, NodeLayer, Scene, SceneGraph, ScenePose, Sim3
from gsmap.view import ViewEdge, ViewMap, ViewScene, ViewServer


def blob(seed: int, n: int = 400) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(0, 0.4, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(-5, -3, (n, 3)),
        rng.normal(0.5, 2, n),
        rng.uniform(-1.7, 1.7, (n, 1, 3)),
    )


def entry(name: str, g: Gaussians, pose: ScenePose | None, **more) -> ViewScene:
    bounds = np.stack([g.means.min(0), g.means.max(0)]).astype(float)
    return ViewScene(Scene(name, name, len(g), g.sh_degree, 0, bounds), pose, lambda: g, **more)


def turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


POSE_A = Sim3(turn(0.3), np.array([0.0, 0, 0]))
POSE_B = Sim3(turn(-1.0), np.array([1.5, 0.2, 0.1]), 1.3)


@pytest.fixture
def view() -> ViewMap:
    layer = NodeLayer(
        np.zeros((3, 3)), np.ones((3, 1)), [0] * 3, [1] * 3, np.zeros((3, 2, 3)), np.ones((3, 1)), [0] * 3, "m"
    )
    graph = SceneGraph("b", {"objects": layer})
    cameras = Cameras(np.eye(4)[None], np.array([[100.0, 100, 50, 40]]), np.array([[100, 80]]))
    scenes = [
        entry("a", blob(1), ScenePose("a", POSE_A, 0, "placed")),
        entry("b", blob(2), ScenePose("b", POSE_B, 0, "tentative"), graph=lambda: graph, cameras=lambda: cameras),
        entry("far <b>away</b>", blob(3), None),
    ]
    edge = ViewEdge("a", "b", "accepted", used=True, num_inliers=21, overlap=0.4)
    return ViewMap("a map", scenes, [edge, ViewEdge("a", "gone", "no_match")])


def get(server: ViewServer, path: str, **headers: str) -> http.client.HTTPResponse:
    where = f"http://127.0.0.1:{server.port}/{path}?token={server.token}"
    return urllib.request.urlopen(urllib.request.Request(where, headers=headers), timeout=10)


def test_summary_tells_where_everything_is(view):
    said = json.loads(json.dumps(view.summary(), allow_nan=False))
    assert [s["component"] for s in said["scenes"]] == [0, 0, 3]
    assert [s["status"] for s in said["scenes"]] == ["placed", "tentative", "not placed"]
    np.testing.assert_allclose(said["scenes"][1]["S_map_scene"], POSE_B.matrix())
    low = view.scenes[1].scene.bounds[0]
    np.testing.assert_allclose(said["scenes"][1]["corners"][0], POSE_B.apply(low))
    assert [(e["target"], e["source"], e["used"]) for e in said["edges"]] == [(0, 1, True)]


def test_splats_are_in_the_map_frame(view):
    rows = np.frombuffer(view.splats(1), "<f4").reshape(-1, 10)
    g = view.scenes[1].gaussians()
    g = transform_gaussians(g[g.opacities > 1 / 255], POSE_B)
    np.testing.assert_allclose(rows[:, :3], g.means, atol=1e-6)
    scales = np.exp(g.log_scales.astype(float))
    np.testing.assert_allclose(rows[:, [3, 6, 8]].sum(1), (scales**2).sum(1), rtol=1e-4)  # the trace
    rgba = np.ascontiguousarray(rows[:, 9:]).view("u1")
    np.testing.assert_allclose(rgba[:, 3] / 255, g.opacities, atol=0.5 / 255 + 1e-6)


def test_fog_and_nan_are_left_out_and_large_scenes_are_merged(view):
    g = blob(1)
    g.log_scales[0] = 3
    g.means[1] = np.nan
    g.logit_opacities[2:] = 5
    shown = entry("a", blob(1), None)
    shown = ViewScene(shown.scene, None, lambda: g)
    assert len(ViewMap("m", [shown]).splats(0)) == 40 * 398
    big = blob(4, 5000)
    assert 40 * 300 < len(ViewMap("m", [entry("a", big, None)], max_splats=1000).splats(0)) <= 40 * 1000
    assert ViewMap("m", [ViewScene(shown.scene, None, Gaussians.empty)]).splats(0) == b""


def test_extras_are_in_the_map_frame(view):
    extras = view.extras(1)
    np.testing.assert_allclose(extras["layers"]["objects"], np.tile(POSE_B.translation, (3, 1)))
    eye, *rim = np.array(extras["cameras"][0])
    np.testing.assert_allclose(eye, POSE_B.translation)
    np.testing.assert_allclose(rim[0], POSE_B.apply(np.array([-0.5, -0.4, 1]) * 0.1 / 1.3), atol=1e-9)
    assert view.extras(0) == {"layers": {}, "cameras": []}


def test_server_answers_this_machine_only(view):
    with ViewServer(view).start() as server:
        assert server.url.startswith("http://127.0.0.1:")
        assert json.load(get(server, "map.json"))["title"] == "a map"
        zipped = get(server, "map.json", **{"Accept-Encoding": "gzip"})
        assert json.loads(gzip.decompress(zipped.read()))["title"] == "a map"
        assert b"new Renderer" in get(server, "viewer.js").read()
        for path in ("scenes/9/splats", "scenes/-1/splats", "scenes/0/secrets", "../server.py", "page/viewer.js", "x"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(server, path)
        # A site that points its own name at this machine gets nothing.
        with pytest.raises(urllib.error.HTTPError, match="403"):
            get(server, "map.json", Host="evil.example")


def test_what_a_scene_cannot_load_is_said(view):
    def broken():
        raise InputError("scene a is damaged: run gsmap check")

    view.scenes[0] = ViewScene(view.scenes[0].scene, view.scenes[0].pose, broken)
    with ViewServer(view).start() as server, pytest.raises(urllib.error.HTTPError, match="500") as caught:
        get(server, "scenes/0/splats")
    assert "gsmap check" in json.load(caught.value)["error"]


def test_port_in_use_is_named(view):
    with ViewServer(view) as server, pytest.raises(ConfigError, match="--port"):
        ViewServer(view, port=server.port)
    with pytest.raises(ConfigError, match="--port"):
        ViewServer(view, port=99999)


EYE, TARGET, FOV = np.array([0.6, -3.0, 0.8]), np.array([0.6, 0.1, 0.0]), 1.0


def camera(width: int, height: int) -> Cameras:
    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = EYE
    focal = 0.5 * max(width, height) / np.tan(FOV / 2)
    return Cameras(pose[None], np.array([[focal, focal, width / 2, height / 2]]), np.array([[width, height]]))


def test_browser_shows_the_picture_that_gsmap_renders(view, tmp_path):
    """Two placed scenes in headless Chromium, against gsmap's own renderer from the same camera."""
    pytest.importorskip("torch")
    from gsmap.render import render

    where = "&".join(
        [f"eye={','.join(map(str, EYE))}", f"target={','.join(map(str, TARGET))}", f"fov={FOV}", "plain=1"]
    )
    with ViewServer(view).start() as server, Page(f"{server.url}#{where}", tmp_path / "profile") as page:
        page.wait("window.gsmap && window.gsmap.phase !== 'loading'")
        assert page.value("window.gsmap.error") is None
        page.wait("window.gsmap.sorted > 0")
        frames = page.value("window.gsmap.frames")
        page.value("new Promise(done => setTimeout(done, 500))")
        assert frames > 0
        shown = page.picture()
        assert page.failures() == []
    height, width = shown.shape[:2]
    both = [transform_gaussians(view.scenes[i].gaussians(), pose) for i, pose in ((0, POSE_A), (1, POSE_B))]
    truth = render(Gaussians.concatenate(both), camera(width, height), depth=False, dominant_id=False).colour[0]
    assert truth.std() > 0.05
    assert psnr(shown, np.clip(truth, 0, 1)) > 48


def test_browser_lists_scenes_components_and_edges(view, tmp_path):
    with ViewServer(view).start() as server, Page(server.url, tmp_path / "profile", 900, 600) as page:
        page.wait("window.gsmap && window.gsmap.phase !== 'loading'")
        assert page.value("document.querySelector('#status').textContent").startswith("3 scenes, 1,1")
        assert page.value(
            "[...document.querySelectorAll('#scenes li:not([hidden]) button')].map(b => b.textContent)"
        ) == [
            "a",
            "b",
        ]
        assert page.value("document.querySelector('#component').options.length") == 2
        assert page.value("document.querySelector('#edges li:not([hidden]) .detail').textContent") == "21 accepted"
        before = page.picture()
        page.value("document.querySelector('#scenes input').click()")
        page.value("new Promise(done => setTimeout(done, 700))")
        assert np.abs(page.picture()[:, 300:] - before[:, 300:]).max() > 0.2  # scene a is gone
        page.value("document.querySelector('#layer-objects').click()")
        page.value("document.querySelector('#component').value = '3'")
        page.value("document.querySelector('#component').dispatchEvent(new Event('change'))")
        names = page.value("[...document.querySelectorAll('#scenes li:not([hidden]) button')].map(b => b.innerHTML)")
        assert names == ["far &lt;b&gt;away&lt;/b&gt;"]  # text, never markup
        assert page.failures() == []


def test_empty_map_says_what_to_do(tmp_path):
    with ViewServer(ViewMap("empty", [])).start() as server, Page(server.url, tmp_path / "profile") as page:
        page.wait("window.gsmap && window.gsmap.phase === 'ready'")
        assert "gsmap ingest" in page.value("document.querySelector('#status').textContent")
