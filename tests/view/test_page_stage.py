"""The 3D view of the page in headless Chromium: it draws what gsmap renders, and loads no more than it must."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from headless import Page
from stage_site import Served, bundle, pose, room, site

from gsmap import formats
from gsmap.evaluate.images import psnr
from gsmap.formats import tiles3d
from gsmap.geometry.transforms import transform_gaussians
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, Sim3

WIDTH, HEIGHT = 240, 180
DARK = np.array([0x0D, 0x10, 0x14]) / 255
KEYS = {"ArrowLeft": 37, "ArrowRight": 39, "w": 87, "e": 69, "-": 189}


def cameras(
    eyes: np.ndarray, targets: np.ndarray, fx: float = 150.0, centre: tuple[float, float] = (120, 90)
) -> Cameras:
    """Upright ones, down being +y."""
    poses = []
    for eye, target in zip(eyes, targets, strict=True):
        forward = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        T[:3, 3] = eye
        poses.append(T)
    n = len(poses)
    return Cameras(np.array(poses), np.tile([fx, fx, *centre], (n, 1)).astype(float), np.tile([WIDTH, HEIGHT], (n, 1)))


INSIDE = cameras(
    np.array([[-1.2, -1.3, -0.8], [1.0, -1.0, 0.6], [0.2, -1.8, 0.9]]),
    np.array([[1.5, -1.0, 1.0], [-1.5, -1.4, -0.5], [-0.3, -0.4, -1.4]]),
)


class Seen:
    """The view of one site, at work."""

    def __init__(self, page: Page, served: Served) -> None:
        self.page, self.served = page, served

    def do(self, call: str) -> None:
        """Calls something of the stage and waits until all is drawn."""
        self.page.value(f"void gsmap.stage.{call}")
        self.settle()

    def settle(self) -> None:
        self.page.wait("gsmap.state.settled", 60)

    def state(self) -> dict:
        return self.page.value("gsmap.state")

    def show(self, change: str = "") -> None:
        """Shows the site's map, after changing it."""
        self.page.value(
            f"fetch('map.json').then((r) => r.json()).then((map) => {{ {change}; gsmap.map = map;"
            " gsmap.stage.show(map, 0); })"
        )
        self.settle()

    def stand(self, camera: Cameras, k: int = 0) -> np.ndarray:
        """The picture from a camera."""
        pose_, K, size = (v[k].tolist() for v in (camera.T_frame_camera, camera.intrinsics_px, camera.sizes_px))
        self.do(f"standAtCamera({pose_}, {K}, {size})")
        return self.page.picture()

    def mouse(self, kind: str, x: float, y: float, **more: object) -> None:
        arguments = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1, **more}
        self.page._call("Input.dispatchMouseEvent", arguments)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.mouse("mousePressed", *start)
        for t in (0.3, 0.6, 1.0):
            x, y = (a + t * (b - a) for a, b in zip(start, end, strict=True))
            self.mouse("mouseMoved", x, y, buttons=1)
        self.mouse("mouseReleased", *end)
        self.settle()

    def click(self, x: float, y: float, count: int = 1) -> None:
        for k in range(1, count + 1):
            self.mouse("mousePressed", x, y, clickCount=k)
            self.mouse("mouseReleased", x, y, clickCount=k)
        self.settle()

    def key(self, name: str) -> None:
        text = {"text": name} if len(name) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            code = {"windowsVirtualKeyCode": KEYS[name], "key": name}
            self.page._call("Input.dispatchKeyEvent", {"type": kind, **code, **(text if kind == "keyDown" else {})})
        self.settle()


def opened(folder: Path, served: Served, budget: dict | None = None) -> Page:
    query = f"?budget={quote(json.dumps(budget))}" if budget else ""
    page = Page(f"{served.url}/view{query}", folder / "profile", WIDTH, HEIGHT)
    page.wait("!!window.gsmap?.picks", 30)
    # Pictures are compared; flights are not.
    page._call("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]})
    return page


SCENES = [(room(0, degree=3), pose(0)), (room(1), pose(5.0, 20, 1.2)), (room(2, degree=0), pose(10.0, -30))]


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Iterator[Seen]:
    """Three rooms beside each other, of SH degree 3, 1 and 0."""
    folder = tmp_path_factory.mktemp("site")
    bundle("stage.ts", folder / "stage.js")
    site(folder, SCENES)
    served = Served(folder)
    with opened(folder, served) as page:
        out = Seen(page, served)
        out.show()
        yield out
        assert page.failures() == []
        assert page.value("gsmap.errors") == []
    served.close()


@pytest.fixture(autouse=True)
def as_it_was(request) -> Iterator[None]:
    yield
    if "seen" in request.fixturenames:
        seen = request.getfixturevalue("seen")
        seen.page.value(
            "(() => { const s = gsmap.stage; s.setSplit(null); s.setClip(null); s.setCeiling(true); s.drag(null);"
            " s.setPoses(null); s.setVisible(new Set([0, 1, 2])); gsmap.picks.length = 0;"
            " for (const n of ['cameras', 'nodes', 'boxes', 'edges', 'ellipsoids', 'objects', 'rooms', 'photos'])"
            "   s.setOverlay(n, false); s.setChanges([]); s.setCorrespondences(null); s.setTheme(true); })()"
        )


def onto(camera: Cameras, point) -> tuple[float, float]:
    """Where a point is seen."""
    T, (fx, fy, cx, cy) = camera.T_camera_frame[0], camera.intrinsics_px[0]
    x, y, z = T[:3, :3] @ point + T[:3, 3]
    return float(fx * x / z + cx), float(fy * y / z + cy)


def rendered(*scenes: tuple[Gaussians, np.ndarray], camera: Cameras, background: np.ndarray = DARK) -> np.ndarray:
    g = Gaussians.concatenate([transform_gaussians(one, Sim3.from_matrix(S)) for one, S in scenes])
    return np.clip(render(g, camera, background=background.tolist(), depth=False, dominant_id=False).colour[0], 0, 1)


def padded(g: Gaussians) -> Gaussians:
    """With SH of degree 3, zero where there were none."""
    sh = np.zeros((len(g), 16, 3), np.float32)
    sh[:, : g.sh.shape[1]] = g.sh
    return Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, sh)


def held(g: Gaussians, folder: Path) -> Gaussians:
    """What a tree of them holds: its numbers have 8 bits."""
    formats.write(folder / "g.spz", g)
    return formats.read(folder / "g.spz")


@pytest.fixture(scope="module")
def every(tmp_path_factory) -> list[tuple[Gaussians, np.ndarray]]:
    return [(padded(held(g, tmp_path_factory.mktemp("held"))), S) for g, S in SCENES]


@pytest.mark.parametrize("k", range(3))
def test_the_picture_is_the_renderers(seen, every, k):
    picture = seen.stand(INSIDE, k)
    assert psnr(picture, rendered(*every, camera=INSIDE[k : k + 1])) > 40
    flat = [(Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, g.sh[:, :1]), S) for g, S in every]
    assert psnr(picture, rendered(*flat, camera=INSIDE[k : k + 1])) < 32  # SH are drawn


def test_a_turned_and_scaled_scene_has_its_sh_turned(seen, every):
    camera = cameras(np.array([[4.5, -1.4, 0.2]]), np.array([[6.5, -1.0, 0.9]]))
    assert psnr(seen.stand(camera), rendered(*every, camera=camera)) > 40


def test_a_principal_point_off_the_middle(seen, every):
    camera = cameras(np.array([[-1.2, -1.3, -0.8]]), np.array([[1.5, -1.0, 1.0]]), 170.0, (95.0, 110.0))
    assert psnr(seen.stand(camera), rendered(*every, camera=camera)) > 40


def test_nothing_runs_while_nothing_changes(seen):
    seen.settle()
    before = seen.state()["frames"]
    seen.page.value("new Promise((done) => setTimeout(done, 400))")
    assert seen.state()["frames"] == before


def test_what_is_loaded_is_not_loaded_again(seen, every):
    for k in range(3):
        seen.stand(INSIDE, k)
    before = len(seen.served.asked), seen.state()["bytesUploaded"]
    for k in range(3):
        seen.stand(INSIDE, k)
    seen.show()  # as after an action
    seen.stand(INSIDE)
    again = [path for path in seen.served.asked[before[0] :] if path.endswith(".glb")]
    assert again == []
    state = seen.state()
    assert state["bytesUploaded"] <= 2 * state["bytesReceived"]
    assert psnr(seen.stand(INSIDE), rendered(*every, camera=INSIDE[:1])) > 40


def test_hidden_scenes_are_not_drawn(seen, every):
    seen.do("setVisible(new Set([1]))")
    assert psnr(seen.stand(INSIDE), rendered(every[1], camera=INSIDE[:1])) > 40


def test_a_split_view_draws_each_side_its_own(seen, every):
    seen.do("setVisible(new Set([0]))")
    seen.do("setSplit({ at: 0.4, scenes: new Set([0, 1]), source: 'scenes' })")
    picture = seen.stand(INSIDE)
    column = round(0.4 * WIDTH)
    left, right = rendered(every[0], camera=INSIDE[:1]), rendered(*every[:2], camera=INSIDE[:1])
    assert psnr(picture[:, :column], left[:, :column]) > 38
    assert psnr(picture[:, column:], right[:, column:]) > 38


def test_a_clip_box_and_its_handles(seen, every):
    seen.do("setVisible(new Set([0]))")
    above = cameras(np.array([[0.01, -7.0, -0.5]]), np.array([[0, 0, 0]]), 170.0)
    seen.stand(above)
    seen.page.value("void gsmap.stage.setClip([[-2.5, -3, -2.5], [0, 1, 2.5]], (box) => { gsmap.clip = box; })")
    seen.settle()
    g, S = every[0]
    cut = rendered((g[g.means[:, 0] < 0], S), camera=above)
    picture = seen.page.picture()
    away = np.abs(picture - cut).max(2) < 0.2
    assert away[:, :115].mean() > 0.9  # but for the lines of the box and its handles
    assert np.abs(picture[:, 160:] - DARK).max() < 0.05
    # The handle of x's upper side, dragged to the right.
    at = onto(above, [0, -1, 0])
    seen.drag(at, (at[0] + 30, at[1]))
    assert 0.6 < seen.page.value("gsmap.clip[1][0]") < 1.2
    assert seen.page.value("gsmap.clip[0][0]") == -2.5


def test_a_dolls_house_has_no_ceiling(seen, every):
    seen.do("setVisible(new Set([0]))")
    above = cameras(np.array([[0.01, -7.0, -0.5]]), np.array([[0, 0, 0]]))
    whole = seen.stand(above)
    seen.do("setCeiling(false)")
    g, S = every[0]
    open_ = rendered((g[g.means[:, 1] > -1.5], S), camera=above)
    assert psnr(seen.page.picture(), open_) > psnr(whole, open_) + 5


def picks(seen: Seen) -> list[dict]:
    return seen.page.value("gsmap.picks")


def test_a_surface_is_picked_with_its_scene(seen):
    camera = cameras(np.array([[0.0, -1.2, 0.0]]), np.array([[0.3, -1.2, 1.4]]))
    seen.stand(camera)
    seen.click(120, 90)
    (found,) = picks(seen)
    assert found["scene"] == 0
    assert found["thing"] is None
    assert np.allclose(found["point"], [0.32, -1.2, 1.5], atol=0.08)


def test_an_edge_is_picked_by_its_line(seen):
    camera = cameras(np.array([[2.5, -5.0, -6.0]]), np.array([[2.5, -1.2, 0]]))
    seen.stand(camera)
    seen.do("setOverlay('edges', true)")
    a, b = (np.array(seen.page.value(f"gsmap.map.scenes[{i}].middle")) for i in (0, 1))
    x, y = onto(camera, (a + b) / 2)
    seen.click(x, y + 2)
    assert picks(seen)[0]["thing"] == {"kind": "edge", "index": 0}


@pytest.mark.parametrize("name", ["cameras", "nodes", "boxes", "edges", "ellipsoids"])
def test_overlays_are_drawn_and_go(seen, name):
    camera = cameras(np.array([[5, -4.0, -9.0]]), np.array([[5, -1.2, 0]]))
    plain = seen.stand(camera)
    seen.do(f"setOverlay('{name}', true)")
    assert np.abs(seen.page.picture() - plain).max() > 0.1
    seen.do(f"setOverlay('{name}', false)")
    assert np.abs(seen.page.picture() - plain).max() < 0.02


def test_changes_objects_photos_and_correspondences_are_drawn_and_picked(seen):
    camera = cameras(np.array([[0.0, -1.2, -0.9]]), np.array([[0, -1.2, 1]]))
    plain = seen.stand(camera)
    box = [[-0.3, -1.5, 0.5], [0.3, -0.9, 1.0]]
    change = {"id": "c1", "kind": "moved", "component": 0, "box": box, "older": 0, "newer": 1, "newer_at": None,
              "confidence": 1, "status": "open", "pictures": None}  # fmt: skip
    thing = {"id": "a", "name": "chair", "component": 0, "position": [0, -1.2, 0.7], "box": box, "first_seen": None,
             "last_seen": None, "there": True, "seen": 1, "room": "r1"}  # fmt: skip
    room = {"id": "r1", "component": 0, "outline": [box], "area_m2": 1, "page_source": []}
    photo = {"file": "p.jpg", "component": 0, "T_map_camera": pose(0.0).tolist(), "intrinsics_px": [1, 1, 0.5, 0.5],
             "size_px": [1, 1], "captured_at": None}  # fmt: skip
    photo["T_map_camera"][1][3], photo["T_map_camera"][2][3] = -1.2, 0.4
    for call in (
        f"setChanges([{json.dumps(change)}])",
        f"setGraph({{ objects: [{json.dumps(thing)}], relations: [], rooms: [] }})",
        f"setGraph({{ objects: [], relations: [], rooms: [{json.dumps(room)}] }})",
        f"setCorrespondences({{ correspondences: [[{box[0]}, {box[1]}]] }})",
    ):
        if "Graph" in call:
            seen.do("setOverlay('objects', true)")
            seen.do("setOverlay('rooms', true)")
        seen.do(call)
        assert np.abs(seen.page.picture() - plain).max() > 0.1
        nothing = "{ objects: [], relations: [], rooms: [] }"
        seen.page.value(
            f"(gsmap.stage.setChanges([]), gsmap.stage.setGraph({nothing}), gsmap.stage.setCorrespondences(null))"
        )
    seen.do("setOverlay('objects', false)")
    seen.do("setOverlay('rooms', false)")
    seen.show(f"map.photos = [{json.dumps(photo)}]")
    seen.stand(camera)
    seen.do("setOverlay('photos', true)")
    x = 120 + 150 * 0.2 / 1.7  # a corner of its frustum
    seen.click(x, 90 + 150 * 0.2 / 1.7)
    assert picks(seen)[0]["thing"] == {"kind": "photo", "index": 0}


def test_poses_of_an_old_revision(seen, every):
    moved = pose(0.3, 12)
    rows = [{"scene": 0, "component": 0, "status": "placed", "S_map_scene": moved.tolist()}]
    seen.do(f"setPoses({{ id: 1, scenes: {json.dumps(rows)} }})")
    assert psnr(seen.stand(INSIDE), rendered((every[0][0], moved), camera=INSIDE[:1])) > 40


def test_a_scene_is_dragged_by_its_gizmo(seen, every):
    seen.do("setVisible(new Set([0]))")
    seen.do("stand({ position: [0, -1.2, -6], target: [0, -1.2, 0] })")
    seen.page.value("void gsmap.stage.drag(0, (S) => { gsmap.dragged = S; })")
    seen.settle()
    start = 120 + 15, 90  # on the arrow along x, from the middle of the scene
    seen.mouse("mouseMoved", *start)
    seen.drag(start, (start[0] + 40, start[1]))
    S = np.array(seen.page.value("gsmap.dragged"))
    assert np.allclose(S[:3, :3], np.eye(3), atol=1e-6)
    assert S[0, 3] > 0.5
    assert abs(S[1, 3]) < 1e-6
    seen.do("drag(null)")
    assert psnr(seen.stand(INSIDE), rendered(every[0], camera=INSIDE[:1])) > 40


def test_keys_move_and_turn_the_viewer(seen):
    seen.do("stand({ position: [0, -1.2, -1], target: [0, -1.2, 1] })")
    seen.page.value("document.querySelector('canvas').focus()")
    at = lambda: np.array(seen.page.value("gsmap.stage.standpoint().position"))  # noqa: E731
    start = at()
    seen.key("w")
    ahead = at()
    assert ahead[2] > start[2] + 0.05
    seen.key("e")
    assert at()[1] < ahead[1] - 0.05
    here = at()
    seen.key("ArrowLeft")
    assert np.linalg.norm(at() - here) > 0.05


def test_a_double_click_flies_to_what_was_picked(seen):
    seen.do("stand({ position: [0, -1.2, -1], target: [0.4, -1.2, 1] })")
    seen.click(140, 70, count=2)
    after = seen.page.value("gsmap.stage.standpoint()")
    assert after["position"][2] > 0.1
    point = picks(seen)[0]["point"]
    assert np.allclose(after["target"], point, atol=0.05)


def test_two_fingers_come_closer(seen):
    seen.do("stand({ position: [0, -1.2, -1], target: [0, -1.2, 1] })")
    seen.page._call("Emulation.setTouchEmulationEnabled", {"enabled": True})
    touch = lambda kind, *xs: seen.page._call(  # noqa: E731
        "Input.dispatchTouchEvent",
        {"type": kind, "touchPoints": [{"x": x, "y": 90, "id": i} for i, x in enumerate(xs)]},
    )
    touch("touchStart", 110, 130)
    for d in (20, 35, 50):
        touch("touchMove", 120 - d, 120 + d)
    touch("touchEnd")
    seen.settle()
    seen.page._call("Emulation.setTouchEmulationEnabled", {"enabled": False})
    after = seen.page.value("gsmap.stage.standpoint()")
    assert after["position"][2] > -0.8


def test_it_tells_where_the_viewer_came_to_rest(seen):
    seen.page.value("gsmap.moves.length = 0")
    seen.do("stand({ position: [1, -1.2, -1], target: [0, -1.2, 1] }, true)")
    seen.page.wait("gsmap.moves.length > 0", 5)
    assert np.allclose(seen.page.value("gsmap.moves.at(-1).position"), [1, -1.2, -1], atol=1e-3)


def test_light_and_dark(seen):
    out = cameras(np.array([[0, -40.0, -0.1]]), np.array([[0, -80.0, -0.2]]))
    assert np.allclose(seen.stand(out), DARK, atol=0.01)
    seen.do("setTheme(false)")
    assert seen.page.picture().min() > 0.9


# ---- loading --------------------------------------------------------------------------------------------------------


FOUR = [(room(i, 1600, 0), pose(5.0 * i)) for i in range(4)]


@pytest.fixture
def made(tmp_path) -> Iterator[tuple[Path, Served]]:
    bundle("stage.ts", tmp_path / "stage.js")
    site(tmp_path, FOUR, max_per_tile=200)
    served = Served(tmp_path)
    yield tmp_path, served
    served.close()


def test_the_budget_is_kept_and_near_things_are_finest(made):
    folder, served = made
    with opened(folder, served, {"splats": 2600}) as page:
        seen = Seen(page, served)
        seen.show()
        seen.stand(INSIDE)
        assert 1000 < seen.state()["splats"] <= 2600
        assert psnr(page.picture(), rendered(*FOUR, camera=INSIDE[:1])) > 23
        assert page.failures() == []


def test_memory_is_bounded_and_what_is_left_behind_is_loaded_again(made):
    folder, served = made
    with opened(folder, served, {"bytes": 80_000}) as page:
        seen = Seen(page, served)
        seen.show()
        for x in (0.0, 15.0, 0.0):
            camera = cameras(INSIDE.T_frame_camera[:1, :3, 3] + [x, 0, 0], np.array([[1.5 + x, -1.0, 1.0]]))
            picture = seen.stand(camera)
        tiles = [path for path in served.asked if path.endswith(".glb") and "scene0" in path]
        assert len(tiles) > len(set(tiles))  # dropped, and asked for again
        assert psnr(picture, rendered(*FOUR, camera=camera)) > 38


def test_the_overview_is_drawn_before_any_tree(made):
    folder, served = made
    served.slow_s["tileset.json"] = 1.5
    with opened(folder, served) as page:
        page.value("fetch('map.json').then((r) => r.json()).then((map) => gsmap.stage.show(map, 0))")
        page.wait("gsmap.state.splats > 0 && gsmap.state.bytesUploaded > 0", 10)
        assert not any(path.endswith(".glb") for path in served.asked)
        page.wait("gsmap.state.isShown", 10)  # sorted: the next picture has it
        page.value("new Promise((rest) => requestAnimationFrame(() => requestAnimationFrame(rest)))")
        assert page.picture().std() > 0.05


_FRAMED = (
    "const c = map.components[0]; c.overview.has_ceiling = true; const [l, h] = c.box;"
    "c.overview.frame = [...Array(8).keys()].map((k) =>"
    " [(k & 1 ? h : l)[0], k & 4 ? l[1] : h[1], (k & 2 ? h : l)[2]])"
)


def test_rooms_are_first_seen_from_above_without_ceilings_and_walked_into(made):
    """The whole of it as large as it fits; in, where one of the captures was made, level, towards the others."""
    folder, served = made
    with opened(folder, served) as page:
        seen = Seen(page, served)
        seen.show(_FRAMED)
        assert seen.state()["isAbove"]
        cut = page.picture()
        inside = [g[g.means[:, 1] > -1.5] for g, _ in FOUR]
        assert max(len(one) / len(g) for one, (g, _) in zip(inside, FOUR, strict=True)) < 1
        shown = page.value(
            "gsmap.map.components[0].overview.frame.map((p) => gsmap.stage.project([p[0], Math.max(p[1], -1.8), p[2]]))"
        )
        low, high = np.min(shown, axis=0), np.max(shown, axis=0)
        assert low.min() > -1
        assert (high <= [WIDTH + 1, HEIGHT + 1]).all()
        assert max(((high - low) / [WIDTH, HEIGHT]).tolist()) > 0.93
        seen.do("setCeiling(false)")
        assert psnr(page.picture(), cut) > 50, "from above ceilings are never drawn"
        seen.do("setCeiling(true)")
        assert page.value("gsmap.stage.walkIn()") is True
        seen.settle()
        assert not seen.state()["isAbove"]
        at = seen.page.value("gsmap.stage.standpoint()")
        assert np.allclose(at["position"], [-1, -1.2, 0], atol=1e-3) or np.allclose(
            at["position"], [1, -1.2, 0], atol=1e-3
        )
        assert abs(at["target"][1] - at["position"][1]) < 0.05
        seen.do("fit()")  # from then on, all of it
        assert seen.page.value("gsmap.stage.standpoint().position[1]") < -5


def test_the_overview_stays_until_a_new_one_is_there(made):
    folder, served = made
    served.slow_s["later.spz"] = 2.0
    (folder / "later.spz").write_bytes((folder / "overview.spz").read_bytes())
    away = cameras(np.array([[7.5, -30.0, -0.1]]), np.array([[7.5, 0.0, 0.0]]))
    with opened(folder, served, {"errorPx": 1e9}) as page:
        seen = Seen(page, served)
        seen.show()
        plain = seen.stand(away)
        assert plain.std() > 0.02
        turned = "map.components[0].overview.uri = 'later.spz'; map.scenes[0].S_map_scene[0][3] = 3"
        page.value(f"fetch('map.json').then((r) => r.json()).then((map) => {{ {turned}; gsmap.stage.show(map, 0); }})")
        page.value("new Promise((rest) => setTimeout(rest, 800))")
        assert psnr(page.picture()[:, 120:], plain[:, 120:]) > 40
        seen.settle()
        assert sum("later.spz" in path for path in served.asked) == 1
        assert page.value("gsmap.errors") == []


def test_trees_that_are_still_made_are_asked_for_again(made):
    folder, served = made
    for i in range(4):
        served.waiting[f"/scene{i}/tileset.json"] = 2
    with opened(folder, served) as page:
        seen = Seen(page, served)
        seen.show()
        seen.stand(INSIDE)
        assert sum(path.startswith("/scene0/tileset.json") for path in served.asked) == 3
        assert psnr(page.picture(), rendered(*FOUR, camera=INSIDE[:1])) > 38


def test_what_is_no_longer_wanted_is_not_waited_for(made):
    folder, served = made
    served.slow_s[".glb"] = 0.5
    with opened(folder, served, {"requests": 2}) as page:
        seen = Seen(page, served)
        page.value("fetch('map.json').then((r) => r.json()).then((map) => gsmap.stage.show(map, 0))")
        page.wait("gsmap.state.pending > 3", 10)
        asked = len(served.asked)
        away = cameras(np.array([[0, -40.0, -0.1]]), np.array([[0, -80.0, -0.2]]))
        seen.stand(away)
        assert len([p for p in served.asked[asked:] if p.endswith(".glb")]) <= 2
        assert page.value("gsmap.errors") == []


@pytest.mark.parametrize("compressed", [True, False])
def test_merged_tiles_with_a_tileset_of_its_own_within(tmp_path, compressed):
    bundle("stage.ts", tmp_path / "stage.js")
    made = site(tmp_path, [(room(0, 1500, 1), pose(0))])
    if not compressed:
        tiles3d.write(tmp_path / "scene0" / "tileset.json", room(0, 1500, 1), max_per_tile=600, compressed=False)
    inner = json.loads((tmp_path / "scene0" / "tileset.json").read_text())
    box = inner["root"]["boundingVolume"]
    shifted = np.eye(4)
    shifted[0, 3] = 0.2
    inner["root"]["transform"] = shifted.T.ravel().tolist()
    (tmp_path / "scene0" / "inner.json").write_text(json.dumps(inner))
    child = {"boundingVolume": box, "geometricError": 5.0, "content": {"uri": "scene0/inner.json"}}
    root = {"boundingVolume": box, "geometricError": 9.0, "refine": "REPLACE", "children": [child],
            "transform": np.diag([7.0, 7, 7, 1]).ravel().tolist()}  # fmt: skip
    (tmp_path / "merged.json").write_text(json.dumps({"asset": {"version": "1.1"}, "root": root}))
    made["components"][0]["merged"] = "merged.json"
    (tmp_path / "map.json").write_text(json.dumps(made))
    served = Served(tmp_path)
    with opened(tmp_path, served) as page:
        seen = Seen(page, served)
        seen.show()
        seen.do("setSource('merged')")
        assert psnr(seen.stand(INSIDE), rendered((room(0, 1500, 1), shifted), camera=INSIDE[:1])) > 40
        assert page.value("gsmap.errors") == []
    served.close()


@pytest.mark.slow
def test_the_house(tmp_path, shared_data):
    """As gsmap renders it, at five cameras: 40 dB is what the page promises."""
    g = formats.read(shared_data / "house" / "c0.ply")
    given = formats.read_cameras(shared_data / "house" / "c0.cameras.json")
    bundle("stage.ts", tmp_path / "stage.js")
    made = site(tmp_path, [(g, np.eye(4))], max_per_tile=40_000)
    up = -given.T_frame_camera[:, :3, 1].mean(0)
    made["components"][0]["up"] = up.tolist()
    (tmp_path / "map.json").write_text(json.dumps(made))
    served = Served(tmp_path)
    width, height = given.sizes_px[0].tolist()
    with Page(f"{served.url}/view", tmp_path / "profile", width, height) as page:
        page.wait("!!window.gsmap?.picks", 30)
        seen = Seen(page, served)
        seen.show()
        for k in (10, 30, 45, 60, 80):
            ours = rendered((g, np.eye(4)), camera=given[k : k + 1])
            assert psnr(seen.stand(given, k), ours) > 40
    served.close()
