"""The whole of it: a real map, its real server, the real page with its 3D view, and a person who reviews."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from hands import Hands
from headless import Page
from stage_site import pose, room

import gsmap
from gsmap.map import create
from gsmap.map.map import Map
from gsmap.types import Cameras, Sim3
from gsmap.view import ViewServer

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "gsmap" / "view" / "page"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page as it is now: what was built of these very sources, else built anew beside them."""
    sources = [*PAGE.glob("src/**/*.ts"), *PAGE.glob("*.html"), *PAGE.glob("*.css"), PAGE / "package-lock.json"]
    done = ROOT / "gsmap" / "view" / "built" / "page.js"
    if done.is_file() and done.stat().st_mtime > max(path.stat().st_mtime for path in sources):
        return done.parent
    if not shutil.which("node") or not (PAGE / "node_modules" / "esbuild").is_dir():
        pytest.skip("needs Node.js and the page's packages: tools/build_page.sh")
    out = tmp_path_factory.mktemp("built")
    subprocess.run(["node", "build.mjs", str(out)], cwd=PAGE, check=True)
    return out


def capture_cameras(count: int = 3) -> Cameras:
    """Looking along +z from the far wall of the room, +x right and +y down."""
    poses = np.repeat(np.eye(4)[None], count, axis=0)
    poses[:, :3, 3] = [[x, -1.2, -1.2] for x in np.linspace(-1, 1, count)]
    return Cameras(poses, np.tile([90.0, 90, 64, 48], (count, 1)), np.tile([128, 96], (count, 1)))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rooms in a row, tied by two edges that a person measured; solved once."""
    folder = tmp_path_factory.mktemp("whole") / "site.gsmap"
    sigmas = np.array([0.01] * 3 + [0.02] * 3 + [0.01])
    with create(folder) as m:
        for k, name in enumerate(("hall", "kitchen", "cellar")):
            m.ingest(
                room(k, 1500), cameras=capture_cameras(), name=name, captured_at=f"2025-0{k + 1}-10", scale="known"
            )
        for a, b in (("hall", "kitchen"), ("kitchen", "cellar")):
            m.add_edge(f"{a}:{b}", Sim3.from_matrix(pose(1.5)), sigmas)
        m.optimize()
    return folder


@pytest.fixture
def opened(
    made: Path, built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Map, ViewServer, Hands]]:
    """A copy of the map, served, with its page open and at rest."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("gsmap.view.server.built_page", lambda: built)
    shutil.copytree(made, tmp_path / "site.gsmap")
    with (
        gsmap.open(tmp_path / "site.gsmap") as m,
        m.view().start() as server,
        Page(server.url, tmp_path / "browser", 1000, 640) as page,
    ):
        hands = Hands(page)
        hands.wait("globalThis.gsmap?.settled && find('gs-scene-list', null)", 60)
        yield m, server, hands
        assert page.failures() == []


def edge_of(m: Map, a: str, b: str):
    return next(row for row in m.edge_rows() if {row.target_name, row.source_name} == {a, b})


def test_a_person_looks_reviews_undoes_and_optimizes(opened):
    m, _, hands = opened
    assert hands.value("document.title") == "site.gsmap · gsmap"
    assert hands.value("gsmap.error") is None
    hands.wait("gsmap.splats > 3000")
    picture = hands.page.picture()[:, 400:900]
    assert picture.std() > 0.05, "rooms are drawn, not a ground"
    # Pick, by a click in the 3D view.
    hands.click_at(650, 400)
    hands.says(" m", "gs-place")
    hands.press("Escape")
    # Reject an edge, with a reason.
    hands.press("2")
    hands.click("button", "All")
    hands.click("button.choose", "cellar")
    hands.wait("findAll('img').length >= 2 && findAll('img').every((e) => e.naturalWidth)", 60)
    hands.press("n")
    hands.type("another door")
    hands.press("Escape", "r")
    hands.says("Rejected: ")
    row = edge_of(m, "kitchen", "cellar")
    assert (row.status, row.review) == ("rejected", "reject")
    hands.says("The poses are older", "gs-review")
    hands.says("another door", "gs-edge")
    # Take it back; then vouch for it, and solve.
    hands.press("u")
    hands.says("Undone: ")
    assert edge_of(m, "kitchen", "cellar").review is None
    hands.wait("find('#confirm:not(:disabled)', null)")
    hands.press("c")
    hands.says("Confirmed: ")
    before = m.pose_graph()
    hands.press("o")
    hands.says("Optimized", timeout_s=60)
    assert edge_of(m, "kitchen", "cellar").review == "confirm"
    assert m.pose_graph() is not before
    hands.press("1")
    hands.says("revision 2", "gs-look")


def test_a_scene_that_is_moved_by_hand_is_a_prior_and_no_longer(opened):
    m, _, hands = opened
    hands.click("button.choose", "cellar")
    hands.click("button", "Move by hand")
    hands.click("button", "Save as prior")
    hands.says("pose, 0.1 m, 3°", "gs-scene", 30)
    (prior,) = m.store.priors.list()
    np.testing.assert_allclose(prior.sigmas[:3], np.radians(3))
    hands.wait("find('button', 'Remove the prior')")
    hands.click("button", "Remove the prior")
    hands.says("Removed: ")
    assert m.store.priors.list() == []


def test_captures_are_dated_and_compared_from_the_page(opened):
    m, _, hands = opened
    m.edit("cellar", captured_at="none")
    hands.press("3")
    hands.wait("find('input[type=date]', null)", 30)
    hands.value(
        "(() => { const e = find('input[type=date]', null); e.value = '2025-03-10';"
        " e.dispatchEvent(new Event('change')); })()"
    )
    hands.wait("!find('input[type=date]', null) && find('button:not(:disabled)', 'Compare them now')", 30)
    assert next(scene for scene in m.store.scenes.list() if scene.name == "cellar").captured_at.startswith("2025-03-10")
    hands.click("button", "Compare them now")
    hands.wait("!find('button', 'Compare them now')", 120)
    assert m.store.changes.current()


def test_time_split_and_clip_are_drawn_and_come_back_by_the_address(opened):
    _, server, hands = opened
    whole = hands.value("gsmap.splats")
    hands.press("3")
    hands.value("find('#until', null).focus()")
    hands.press("Home")
    hands.wait(f"gsmap.settled && gsmap.splats < {whole}")
    hands.says("Until 10 Jan 2025", "gs-time")
    hands.press("v", "x")
    hands.wait("gsmap.settled")
    hands.value("new Promise((rest) => setTimeout(rest, 500))")
    address = hands.value("location.hash")
    assert "until=2025-01-10" in address
    assert "split=" in address
    assert "clip=" in address
    assert "at=" in address
    hands.go("about:blank")
    hands.go(server.url.split("?")[0] + address)
    hands.wait("globalThis.gsmap?.settled && find('gs-time', null)", 60)
    hands.says("Until 10 Jan 2025", "gs-time")
    assert hands.value("location.hash") == address


def test_the_page_as_files_shows_the_same_without_a_server(made, built, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("gsmap.map.page.export.built_page", lambda: built)
    with gsmap.open(made) as m:
        m.write_site(tmp_path / "site")
        m.write_page(tmp_path / "one.html")
    quiet = type("Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, directory=tmp_path / "site")) as http:
        threading.Thread(target=http.serve_forever, daemon=True).start()
        for url in (f"http://127.0.0.1:{http.server_port}/", (tmp_path / "one.html").as_uri()):
            with Page(url, tmp_path / f"browser-{url[:4]}", 1000, 640) as page:
                hands = Hands(page)
                hands.wait("globalThis.gsmap?.settled && find('gs-scene-list', null)", 60)
                assert hands.value("gsmap.error") is None
                hands.press("2")
                hands.says("This page only shows the map", "gs-review")
                hands.click("button", "All")
                hands.press("j")
                hands.says("Evidence", "gs-edge")
                hands.press("3", "v", "x", "h")
                hands.wait("gsmap.settled")
                hands.value("new Promise((rest) => setTimeout(rest, 400))")
                assert "split=" in hands.value("location.hash")
                assert page.failures() == []
        http.shutdown()


def test_a_page_that_only_shows(made, built, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("gsmap.view.server.built_page", lambda: built)
    with (
        gsmap.open(made) as m,
        m.view(read_only=True).start() as server,
        Page(server.url, tmp_path / "browser", 390, 844) as page,
    ):
        hands = Hands(page)
        hands.resize(390, 844, mobile=True)
        hands.wait("globalThis.gsmap?.settled && find('gs-scene-list', null)", 60)
        hands.press("2")
        hands.says("This page only shows the map", "gs-review")
        said = json.loads(hands.value("fetch('map.json').then((answer) => answer.text())"))
        assert said["actions"] is False
        assert page.failures() == []
