import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap
from gsmap import formats
from gsmap.errors import ConfigError, GsmapError, NotFoundError
from gsmap.map import create
from gsmap.map.page.source import MapPageSource, cache_folder, content_key
from gsmap.types import Gaussians, Sim3
from gsmap.view.built import built_page
from gsmap.view.tree_cache import TreeCache
from gsmap.view.trees import TreeParams


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    """Levels of detail of tests are not kept among those of the person who runs them."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("GSMAP_CACHE", raising=False)


@pytest.fixture(autouse=True, scope="module")
def _built():
    try:
        built_page()
    except GsmapError as error:
        pytest.skip(str(error))


def hall(seed: int, n: int = 3000) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-3, 3, (n, 3)) * [1, 1, 0.4],
        rng.normal(size=(n, 4)),
        rng.uniform(-4, -3, (n, 3)),
        rng.normal(2, 1, n),
        rng.normal(0, 0.5, (n, 1, 3)),
    )


@pytest.fixture
def folder(tmp_path):
    """Two captures and what a person measured between them."""
    with create(tmp_path / "site.gsmap") as m:
        for i, name in enumerate(("hall", "yard")):
            formats.write(tmp_path / f"{name}.ply", hall(i))
            m.ingest(tmp_path / f"{name}.ply")
        m.add_edge("hall:yard", Sim3(np.eye(3), np.array([2.0, 0, 0])), np.full(7, 0.01), "by tape")
        m.optimize()
    return tmp_path / "site.gsmap"


class Browser:
    """Asks a server as the page does."""

    def __init__(self, server) -> None:
        self._server = server

    def ask(self, path: str, said: object = None):
        where = f"http://127.0.0.1:{self._server.port}"
        headers = {"Cookie": f"gsmap_view_{self._server.port}={self._server.token}"}
        data = None
        if said is not None:
            headers |= {"Origin": where, "Content-Type": "application/json"}
            data = json.dumps(said).encode()
        try:
            with urllib.request.urlopen(urllib.request.Request(f"{where}/{path}", data, headers), timeout=60) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()

    def told(self, path: str, said: object = None):
        for _ in range(200):
            status, data = self.ask(path, said)
            if status != 202:
                assert status == 200, data
                return json.loads(data)
            time.sleep(0.05)
        raise AssertionError(path)


def test_the_page_is_told_what_the_store_holds(folder):
    with gsmap.open(folder) as m, m.view().start() as server:
        page = Browser(server)
        said = page.told("map.json")
        assert [s["name"] for s in said["scenes"]] == ["hall", "yard"]
        assert (said["title"], said["actions"], said["revision"]) == ("site.gsmap", True, 1)
        assert said["counts"]["gaussians"] == 6000
        assert (said["stale"], said["scenes"][0]["tags"], said["scenes"][0]["prior"]) == (False, [], None)
        (edge,) = said["edges"]
        hall_, yard = said["scenes"]
        poses = [np.array(s["S_map_scene"]) for s in (hall_, yard)]
        assert edge["used"] in (True, "tentative")
        np.testing.assert_allclose(np.linalg.inv(poses[edge["target"]]) @ poses[edge["source"]], Sim3(
            np.eye(3), np.array([2.0, 0, 0]) * (1 if edge["target"] == 0 else -1)).matrix(), atol=1e-6)  # fmt: skip
        assert page.told(hall_["extras"]) == {"layers": {}, "cameras": []}
        detail = page.told(edge["detail"])
        assert detail["S_target_source"] is not None
        assert detail["steps"][0]["name"] == "retrieval"
        assert detail["events"]
        assert page.told(said["revisions"][0]["poses"])["scenes"][0]["status"]
        tileset = page.told(hall_["tileset"])
        uri = hall_["tileset"].rsplit("/", 1)[0] + "/" + tileset["root"]["content"]["uri"]
        assert page.ask(uri)[1][:4] == b"glTF"
        assert page.ask("changes/c1-before.jpg")[0] == 404
        assert page.ask(f"edges/{hall_['id']}-{'f' * 32}.json")[0] == 404
    assert list(cache_folder().glob(f"{hall_['id']}*.tree"))


def test_what_a_person_does_is_done_by_the_maps_own_doors(folder):
    with gsmap.open(folder) as m, m.view().start() as server:
        page = Browser(server)
        said = page.told("map.json")
        ids = [scene["id"] for scene in said["scenes"]]
        pair = f"{ids[0]}:{ids[1]}"
        after = page.told("actions/reject", {"what": pair, "note": "another hall"})["map"]
        assert (after["edges"][0]["review"], after["edges"][0]["note"]) == ("reject", "another hall")
        assert after["edges"][0]["status"] == "rejected"
        assert page.told("actions/withdraw", {"what": pair, "note": ""})["map"]["edges"][0]["review"] is None
        assert page.told("actions/confirm", {"what": pair, "note": ""})["map"]["edges"][0]["review"] == "confirm"
        assert m.show_pair("hall:yard").review == "confirm"
        after = page.told("actions/optimize", {})["map"]
        assert after["revision"] == 2
        assert [one["number"] for one in after["revisions"]] == [1, 2]
        assert not after["stale"]
        S = Sim3(np.eye(3), np.array([1.0, 2, 3]), 2.0)
        prior = {"scene": ids[1], "S_map_scene": S.matrix().tolist(), "sigma_m": 0.1, "sigma_deg": 2.0}
        after = page.told("actions/prior", prior)["map"]
        assert after["scenes"][1]["prior"] == "pose, 0.1 m, 2°"
        assert after["stale"]
        (kept,) = m.store.priors.list()
        np.testing.assert_allclose(kept.S_map_scene.matrix(), S.matrix())
        # Metres are the map's; the residual of a position is counted in the scene's unit.
        metres = m.metres()[0].metres_per_unit
        np.testing.assert_allclose(kept.sigmas, [np.radians(2.0)] * 3 + [0.1 / metres / 2.0] * 3 + [np.inf])
        page.told("actions/remove_prior", {"scene": ids[1]})
        assert list(m.store.priors.list()) == []
        # What was told before holds again, to the bit.
        number = after["scenes"][1]["prior_number"]
        after = page.told("actions/earlier_prior", {"scene": ids[1], "number": number})["map"]
        assert after["scenes"][1]["prior"] == "pose, 0.1 m, 2°"
        (again,) = m.store.priors.list()
        assert again.S_map_scene.matrix().tolist() == kept.S_map_scene.matrix().tolist()
        assert again.sigmas.tolist() == kept.sigmas.tolist()
        before = page.told("state.json")
        refused = [
            ("confirm", {"what": f"{ids[0]}:{'f' * 32}", "note": ""}, 404),
            ("confirm", {"what": "c12", "note": ""}, 404),
            ("confirm", {"what": 7}, 400),
            ("confirm", {"note": "of nothing"}, 400),
            ("confirm", {"what": pair, "note": "x" * 5000}, 400),
            ("prior", prior | {"scene": "f" * 32}, 404),
            ("prior", prior | {"sigma_m": 0}, 400),
            ("prior", prior | {"sigma_m": True}, 400),
            ("prior", prior | {"sigma_deg": "2"}, 400),
            ("prior", prior | {"S_map_scene": [[1, 2], [3, 4]]}, 400),
            ("prior", prior | {"S_map_scene": [["x"] * 4] * 4}, 400),
            ("prior", prior | {"S_map_scene": [[0] * 4] * 4}, 400),
            ("remove_prior", {}, 400),
            ("earlier_prior", {"scene": ids[0], "number": number}, 404),
            ("earlier_prior", {"scene": ids[1], "number": "1"}, 400),
            ("earlier_prior", {"scene": ids[1], "number": 10**4000}, 400),
            ("earlier_prior", {"scene": ids[1], "number": -1}, 400),
        ]
        for name, asked, expected in refused:
            status, body = page.ask(f"actions/{name}", asked)
            assert (name, asked, status) == (name, asked, expected), body
            assert json.loads(body)["error"]
        assert page.told("state.json") == before


def test_what_others_do_meanwhile_is_seen_with_the_next_request(folder):
    with gsmap.open(folder) as m, m.view().start() as server:
        page = Browser(server)
        first = page.told("map.json")
        program = (
            "import sys, gsmap\nwith gsmap.open(sys.argv[1]) as m: m.remove('yard'); m.edit('hall', name='atrium')"
        )
        subprocess.run([sys.executable, "-P", "-c", program, str(folder)], check=True, timeout=120)
        assert page.told("state.json")["state"] != first["state"]
        after = page.told("map.json")
        assert [s["name"] for s in after["scenes"]] == ["atrium"]
        assert page.ask(first["scenes"][1]["tileset"])[0] == 404
        assert page.ask(first["scenes"][1]["extras"])[0] == 404
        assert page.ask(first["edges"][0]["detail"])[0] == 404


def test_a_measurement_that_replaces_another_is_another_state(folder):
    with gsmap.open(folder) as m:
        page = MapPageSource(m.store, m.settings)
        states = []
        for x in (3.0, 4.0):
            m.add_edge("hall:yard", Sim3(np.eye(3), np.array([x, 0, 0])), np.full(7, 0.01), "by tape")
            states.append(page.state())
        assert states[0] != states[1]


def test_nothing_is_changed_where_a_map_is_only_looked_at(folder):
    with gsmap.open(folder) as m:
        with m.view(read_only=True).start() as server:
            page = Browser(server)
            said = page.told("map.json")
            assert said["actions"] is False
            pair = ":".join(scene["id"] for scene in said["scenes"])
            assert page.ask("actions/reject", {"what": pair, "note": ""})[0] == 403
        assert m.show_pair("hall:yard").review is None
        m.tag("then")
    with gsmap.open(f"{folder}@then") as m, m.view().start() as server:
        assert Browser(server).told("map.json")["actions"] is False


def test_a_thinned_scene_has_other_levels_of_detail(folder):
    with gsmap.open(folder) as m:
        scene = m.store.scenes.get("yard")
        tree = TreeParams()
        before = content_key(scene, tree)
        shown = np.ones(scene.num_gaussians, bool)
        shown[::2] = False
        after = m.store.scenes.thin("yard", shown)
        assert content_key(after, tree) != before
        assert content_key(after, tree).startswith(scene.id)
        # So do other settings of theirs: what was kept by those is not taken for it.
        assert content_key(scene, replace(tree, leaf_gaussians=tree.leaf_gaussians // 2)) != before
        source = MapPageSource(m.store, m.settings).source(scene.id)
        whole = m.store.scenes.gaussians(scene.id)
        assert source.num_gaussians == len(whole) == shown.sum()
        for name in ("means", "sh", "logit_opacities"):
            np.testing.assert_array_equal(np.concatenate(list(source.columns(name))), getattr(whole, name))


def test_a_purge_leaves_nothing_in_the_cache_nor_in_pages_that_were_written(folder, tmp_path):
    out, file = tmp_path / "www", tmp_path / "map.html"
    with gsmap.open(folder) as m:
        m.write_site(out)
        m.write_page(file)
        scene, other = (m.store.scenes.get(name).id for name in ("yard", "hall"))
        assert list(cache_folder().glob(f"{scene}*"))
        receipt = m.purge("yard")
        assert not list(cache_folder().glob(f"{scene}*"))
        assert list(cache_folder().glob(f"{other}*"))
        assert not out.exists()
        assert not file.exists()
        cleaned = json.dumps(receipt.to_json())
        assert all(str(place) in cleaned for place in (out, file, cache_folder()))


def test_a_site_replaces_its_own_and_nothing_else(folder, tmp_path):
    out = tmp_path / "www"
    with gsmap.open(folder) as m:
        report = m.write_site(out)
        assert (report.num_scenes, report.path) == (2, str(out))
        assert report.num_bytes == sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
        m.edit("hall", name="atrium")
        m.write_site(out)
        assert json.loads((out / "map.json").read_bytes())["scenes"][0]["name"] == "atrium"
        assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
        for held in ("things", "other"):
            (tmp_path / held).mkdir()
            (tmp_path / held / "x.txt").write_text("mine")
        (tmp_path / "other" / "gsmap-site.json").write_text(json.dumps({"version": 1, "map_id": "f" * 32}))
        (tmp_path / "a file").write_text("mine")
        (tmp_path / "link").symlink_to(out)
        for name in ("things", "other", "a file", "link"):
            with raises(ConfigError, code=("folder_not_empty", "not_a_folder")):
                m.write_site(tmp_path / name)
        assert (tmp_path / "things" / "x.txt").read_text() == "mine"
        with raises(NotFoundError, code="folder_not_found"):
            m.write_site(tmp_path / "new", tiles=tmp_path / "nowhere")
        assert not (tmp_path / "new").exists()


def keep_own(out):
    """What a person who hosts a page puts beside it."""
    own = {"CNAME": "map.example", ".git/HEAD": "ref", "scenes/notes.txt": "mine", "blog/index.html": "<p>"}
    for name, text in own.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    return own


def told(out):
    return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_files_of_others_beside_a_page_stay_when_it_is_written_again_and_purged(folder, tmp_path):
    out = tmp_path / "www"
    with gsmap.open(folder) as m:
        m.write_site(out)
        own, yard = keep_own(out), m.store.scenes.get("yard").id
        m.remove("hall")
        m.write_site(out)
        m.write_site(tmp_path / "fresh")
        assert {name: text.encode() for name, text in own.items()} | told(tmp_path / "fresh") == told(out)
        assert not any(m.store.scenes.find_any("hall").id in name for name in told(out))
        receipt = m.purge("yard")
        assert told(out) == {name: text.encode() for name, text in own.items()}
        assert not (tmp_path / "fresh").exists()
        assert str(out) in json.dumps(receipt.to_json())
        assert not any(yard in str(path) for path in out.rglob("*"))


def test_a_page_that_was_put_in_place_by_half_is_finished_by_the_next(folder, tmp_path, monkeypatch):
    out = tmp_path / "www"
    with gsmap.open(folder) as m:
        m.write_site(out)
        own = keep_own(out)
        m.remove("hall")
        for number in (1, 2, 5, 9):
            put, left = os.replace, [number]

            def broken(source, target, put=put, left=left):
                left[0] -= out in Path(target).parents
                if not left[0]:
                    raise OSError(5, "Input/output error")
                put(source, target)

            monkeypatch.setattr(os, "replace", broken)
            with pytest.raises(OSError, match="Input/output"):
                m.write_site(out)
            monkeypatch.undo()
            assert all((out / name).read_text() == text for name, text in own.items())
        m.write_site(out)
        m.write_site(tmp_path / "fresh")
        assert {name: text.encode() for name, text in own.items()} | told(tmp_path / "fresh") == told(out)


def test_a_page_is_not_written_over_files_of_others(folder, tmp_path):
    out = tmp_path / "www"
    with gsmap.open(folder) as m:
        m.write_site(out)
        (out / "map.json").unlink()
        (out / "map.json").mkdir()
        before = told(out)
        with raises(ConfigError, code="folder_not_empty", match=r"map\.json"):
            m.write_site(out)
        assert told(out) == before
        (out / "map.json").rmdir()


def test_a_site_is_whole_or_not_there(folder, tmp_path, monkeypatch):
    from gsmap.view import site

    out = tmp_path / "www"
    with gsmap.open(folder) as m:
        m.write_site(out)
        before = sorted((path.name, path.stat().st_mtime_ns) for path in out.rglob("*"))

        def broken(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(site, "_with_policy", broken)
        with pytest.raises(OSError, match="No space"):
            m.write_site(out)
        assert sorted((path.name, path.stat().st_mtime_ns) for path in out.rglob("*")) == before
        assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_one_file_goes_where_it_may(folder, tmp_path):
    path = tmp_path / "map.html"
    with gsmap.open(folder) as m:
        report = m.write_page(path, megabytes=1)
        assert report.num_bytes == path.stat().st_size
        m.write_page(path)
        (tmp_path / "mine.html").write_text("<p>mine")
        for name, code in (("mine.html", "foreign_export"), ("map.txt", "wrong_suffix")):
            with raises(ConfigError, code=code):
                m.write_page(tmp_path / name)
        with raises(NotFoundError, code="folder_not_found"):
            m.write_page(tmp_path / "nowhere" / "map.html")
        for megabytes in (0, -1, float("nan")):
            with raises(ConfigError, code="out_of_range", match="megabytes"):
                m.write_page(path, megabytes=megabytes)


def test_merged_tiles_of_this_map_are_shown_beside_its_scenes(folder, tmp_path):
    with gsmap.open(folder) as m:
        m.export(tmp_path / "tiles", format="3dtiles", merge="union", tile_size_m=4.0)
        with m.view(tiles=tmp_path / "tiles").start() as server:
            page = Browser(server)
            address = page.told("map.json")["components"][0]["merged"]
            tileset = page.told(address)
            uri = tileset["root"]["content"]["uri"]
            assert page.ask(address.replace("tileset.json", uri))[1][:4] == b"glTF"
        m.write_site(tmp_path / "www", tiles=tmp_path / "tiles")
        assert (tmp_path / "www" / "merged" / "0" / "tileset.json").is_file()
        assert (tmp_path / "www" / "merged" / "0" / uri).is_file()
        m.export(tmp_path / "plain", format="ply", merge="union", tile_size_m=0)
        with raises(ConfigError, code="no_tiles"):
            m.view(tiles=tmp_path / "plain")
    with create(tmp_path / "other.gsmap") as m, raises(ConfigError, code="foreign_export"):
        m.view(tiles=tmp_path / "tiles")


def test_the_command_serves_until_it_is_interrupted(folder):
    command = [sys.executable, "-P", "-m", "gsmap", "view", str(folder), "--no-browser", "--read-only"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            line = process.stderr.readline()
            assert line.startswith("http://127.0.0.1:")
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            assert b"page.js" in browser.open(line.split()[0], timeout=10).read()
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0
        finally:
            process.kill()


def test_the_commands_write_pages(folder, tmp_path):
    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-P", "-m", "gsmap", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120)

    done = run("view", folder, "--export", tmp_path / "www", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["num_scenes"] == 2
    assert Path(tmp_path / "www" / "index.html").is_file()
    done = run("export", folder, tmp_path / "map.html", "--format", "html", "--page-mb", "2", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["tiles"] == []
    assert (tmp_path / "map.html").stat().st_size > 1000
    done = run("export", folder, tmp_path / "map.html", "--format", "html", "--merge", "union")
    assert done.returncode == 2
    assert "--merge does not apply to --format html" in done.stderr


def test_the_cache_is_bounded_by_a_setting(folder):
    with gsmap.open(folder) as m:
        m.with_settings({"view.cache_gib": 1e-5})  # ten kilobytes: one tree at a time
        m.write_page(folder.parent / "map.html")
        kept = [path for path in cache_folder().iterdir() if path.suffix == ".tree"]
        assert len(kept) == 1
        cache = TreeCache(cache_folder(), 0)
        assert cache.tree(kept[0].stem) is not None
        with raises(ConfigError, code="out_of_range", match="cache_gib"):
            m.with_settings({"view.cache_gib": 0})
