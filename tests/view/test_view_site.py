"""The page as files: a folder under any address of any web server, and one file."""

from __future__ import annotations

import base64
import functools
import http.server
import json
import re
import threading
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from headless import Page
from raising import raises
from view_room import A, B, C, MadeDoors, blob, page_folder

from gsmap.errors import GsmapError, InputError, NotFoundError
from gsmap.formats import spz
from gsmap.markup import tag
from gsmap.view import Params
from gsmap.view.built import built_page
from gsmap.view.levels import Levels
from gsmap.view.site import write_page, write_site
from gsmap.view.tree_cache import TreeCache
from gsmap.view.trees import TreeParams

PARAMS = Params(workers=1)
TREE = TreeParams(leaf_gaussians=200, root_gaussians=32)


@pytest.fixture
def page_source(tmp_path):
    found = MadeDoors()
    found.gaussians[A] = blob(1, 3000)
    folder = tmp_path / "export" / "component_000"
    (folder / "levels").mkdir(parents=True)
    (folder / "tileset.json").write_text("{}")
    (folder / "levels" / "x.glb").write_bytes(b"glTF")
    (folder / "note.txt").write_text("of no use to a page")
    found.merged_folder = folder
    change = {"id": "c3", "kind": "moved", "component": 0, "box": [[0.0, 0, 0], [1, 1, 1]], "before": 0, "after": 1}
    change |= {"at": None, "confidence": 0.9, "status": "open", "note": ""}
    change["pictures"] = ["changes/c3-before.jpg", "changes/c3-after.jpg"]
    found.view = replace(found.view, merged=frozenset([0]), changes=[change], has_objects=True)
    found.change_pictures = lambda name: (np.zeros((4, 6, 3), np.uint8),) * 2
    return found


@pytest.fixture
def levels(page_source, tmp_path):
    found = Levels(page_source, TreeCache(tmp_path / "cache", 1 << 30), 1, TREE)
    yield found
    found.close()


def silent(fraction: float, text: str) -> None:
    assert 0 <= fraction <= 1


def site(page_source, levels, tmp_path, params=PARAMS) -> Path:
    out = tmp_path / "site"
    out.mkdir()
    written = write_site(out, page_source, levels, params, page_folder(tmp_path), silent)
    assert written.num_bytes == sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return out


def addresses(said: object):
    """All addresses that JSON of the page names."""
    for text in re.findall(r'"([a-z]+/[^"]+|[a-z]+\.json)"', json.dumps(said)):
        if "/" in text or text == "graph.json":
            yield text


def test_every_address_is_a_file_and_none_is_of_this_machine(page_source, levels, tmp_path):
    out = site(page_source, levels, tmp_path)
    said = json.loads((out / "map.json").read_bytes())
    assert said["actions"] is False
    assert said["history"] is None
    assert [c["overview"]["pending"] for c in said["components"]] == [0, 0]
    named = list(addresses(said))
    assert len(named) > 12
    for address in named:
        assert (out / address).is_file(), address
    for entry in said["scenes"]:
        tileset = json.loads((out / entry["tileset"]).read_bytes())
        for uri in re.findall(r"tiles/[^\"]+\.glb", json.dumps(tileset)):
            assert (out / entry["tileset"]).parent.joinpath(uri).is_file()
    detail = json.loads((out / f"edges/{A}-{B}.json").read_bytes())
    assert [view["camera"] for view in detail["views"]] == ["one", "two"]
    for view in detail["views"]:
        assert (out / view["difference"]).read_bytes()[:2] == b"\xff\xd8"
    assert said["changes"][0]["pictures"] == ["changes/c3-before.jpg", "changes/c3-after.jpg"]
    overview = said["components"][0]["overview"]
    assert len(spz.unpack("o", (out / overview["uri"]).read_bytes())) == sum(overview["counts"])
    assert not (out / "merged" / "0" / "note.txt").exists()
    for path in out.rglob("*"):
        if path.is_file():
            assert str(tmp_path).encode() not in path.read_bytes()
    html = (out / "index.html").read_text()
    assert "script-src 'self' 'wasm-unsafe-eval'" in unescape(html)


def test_pictures_of_a_static_page_are_bounded(page_source, levels, tmp_path):
    out = site(page_source, levels, tmp_path, replace(PARAMS, site_pairs=0, site_changes=0))
    assert page_source.drawn == 0
    assert json.loads((out / f"edges/{A}-{B}.json").read_bytes())["views"] == []
    assert json.loads((out / "map.json").read_bytes())["changes"][0]["pictures"] is None


def test_objects_have_pictures_where_a_scene_shows_them(page_source, levels, tmp_path):
    def draw(name):
        if name == "o2":
            raise NotFoundError("no scene shows o2")
        return np.zeros((4, 6, 3), np.uint8)

    objects = [{"id": name, "picture": f"objects/{name}.jpg"} for name in ("o1", "o2")]
    page_source.graph = lambda: {"objects": objects, "relations": [], "rooms": []}
    page_source.object_picture = draw
    out = site(page_source, levels, tmp_path)
    said = json.loads((out / "graph.json").read_bytes())["objects"]
    assert [one["picture"] for one in said] == ["objects/o1.jpg", None]
    assert [path.name for path in (out / "objects").iterdir()] == ["o1.jpg"]
    assert (out / "objects" / "o1.jpg").read_bytes()[:2] == b"\xff\xd8"


def test_a_scene_that_cannot_be_read_is_left_out_and_named(page_source, levels, tmp_path):
    real = page_source.source

    def source(scene):
        if scene == C:
            raise InputError("it is damaged")
        return real(scene)

    page_source.source = source
    out = tmp_path / "site"
    out.mkdir()
    written = write_site(out, page_source, levels, PARAMS, page_folder(tmp_path), silent)
    assert written.num_scenes == 2
    assert any("far" in note and "damaged" in note for note in written.notes)
    assert json.loads((out / "map.json").read_bytes())["components"][1]["overview"] is None


# --- one file --------------------------------------------------------------------------------------------------------


def inside(path: Path) -> dict[str, bytes]:
    found = re.search(r'<script id="gsmap-files" type="application/json">(.*?)</script>', path.read_text(), re.S)
    return {name: base64.b64decode(text) for name, text in json.loads(found[1]).items()}


def test_one_file_holds_as_much_of_every_tree_as_fits(page_source, levels, tmp_path):
    path, page = tmp_path / "map.html", page_folder(tmp_path)
    write_page(path, page_source, levels, PARAMS, page, 10_000_000, silent, mark=tag("meta", name="x", content="y"))
    whole = inside(path)
    small_path = tmp_path / "small.html"
    write_page(small_path, page_source, levels, PARAMS, page, 30_000, silent)
    small = inside(small_path)

    def glbs(files):
        return sum(len(data) for name, data in files.items() if name.endswith(".glb"))

    tree = levels.read(page_source.view.scenes[0], Path)
    assert sum(f"scenes/{page_source.view.scenes[0].key}" in name for name in whole) == 1 + len(
        list(tree.rglob("*.glb"))
    )
    assert glbs(small) <= 30_000 < glbs(whole)
    for files in (whole, small):
        for entry in page_source.view.scenes:
            tileset = json.loads(files[f"scenes/{entry.key}/tileset.json"])
            uris = re.findall(r"tiles/[^\"]+\.glb", json.dumps(tileset))
            assert uris
            assert all(f"scenes/{entry.key}/{uri}" in files for uri in uris)
        assert json.loads(files["map.json"])["components"][0]["merged"] is None
    assert path.read_text().startswith('<!doctype html><html><head><meta name="x" content="y">')
    (page / "index.html").write_text("<!doctype html><head></head><body></body>")
    with raises(GsmapError, code="page_not_built"):
        write_page(path, page_source, levels, PARAMS, page, 1000, silent)


def test_nothing_in_a_name_ends_the_script_it_stands_in(page_source, levels, tmp_path):
    view = page_source.view
    scene = replace(view.scenes[0].scene, name="</script><script>window.bad = 1</script><!--")
    page_source.view = replace(view, scenes=[replace(view.scenes[0], scene=scene), *view.scenes[1:]], title="</script>")
    path, page = tmp_path / "map.html", page_folder(tmp_path)
    (page / "page.js").write_text(
        'fetch("map.json").then((a) => a.json()).then((m) => { window.told = m; }); "</script>";'
    )
    write_page(path, page_source, levels, PARAMS, page, 100_000, silent)
    with Page(f"file://{path}", tmp_path / "profile") as browser:
        browser.wait("window.told")
        assert browser.value("window.told.scenes[0].name") == scene.name
        assert browser.value("window.bad") is None
        assert browser.value("fetch('https://example.org/x').then((a) => a.status)") == 404
        assert browser.failures() == []


@pytest.fixture(scope="module")
def built():
    try:
        return built_page()
    except GsmapError as error:
        pytest.skip(str(error))


def shows(browser: Page) -> dict:
    browser.wait("window.gsmap && window.gsmap.phase === 'ready' && window.gsmap.splats > 0")
    browser.wait("window.gsmap.settled")
    return json.loads(browser.value("JSON.stringify(window.gsmap)"))


def test_the_page_opens_from_a_sub_path_of_a_plain_web_server(page_source, levels, tmp_path, built):
    out = tmp_path / "www" / "maps" / "house"
    out.mkdir(parents=True)
    page_source.view = replace(page_source.view, merged=frozenset())
    write_site(out, page_source, levels, PARAMS, built, silent)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(tmp_path / "www"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with Page(f"http://127.0.0.1:{server.server_port}/maps/house/", tmp_path / "profile") as browser:
            assert shows(browser)["error"] is None
            assert browser.failures() == []
        server.shutdown()


def test_the_page_opens_from_one_file(page_source, levels, tmp_path, built):
    path = tmp_path / "a map.html"
    write_page(path, page_source, levels, PARAMS, built, 2_000_000, silent)
    with Page(path.as_uri(), tmp_path / "profile") as browser:
        assert shows(browser)["error"] is None
        assert browser.failures() == []
