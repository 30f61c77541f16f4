"""The doors of a map whose stages are stood in for: what is asked for, what is kept, and what is said."""

from __future__ import annotations

import inspect
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_sharers import prepared
from raising import raises

import gsmap.map
from gsmap.errors import ConfigError, InputError, NotFoundError, StoreError
from gsmap.map import Map
from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys
from gsmap.map.stages.export import Request
from gsmap.map.stages.register import read_pairs
from gsmap.settings import changed
from gsmap.store import Store
from gsmap.types import Cameras, Gaussians, NodeLayer, Registration, SceneGraph, Sim3

NAMES = ("hall", "stairs", "attic:east")


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """The pairs that were registered, as (target, source) ids; each finds that they lie a metre apart."""
    pairs: list[tuple[str, str]] = []

    def jobs(
        job: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], params: Any, **how: Any
    ) -> Iterator[tuple[int, Any]]:
        for i, (_, (target, _), (source, _), _) in enumerate(arguments):
            pairs.append((target, source))
            pose = Sim3(np.eye(3), np.array([1.0, 0, 0]))
            yield i, Registration(target, source, "accepted", "", pose, 100.0 * np.eye(7), 50, 60, 0.5, "graph:objects")

    monkeypatch.setattr("gsmap.map.stages.register.run_jobs", jobs)
    return pairs


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Map]:
    """Three described scenes."""
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        for i, name in enumerate(NAMES):
            rng = np.random.default_rng(i)
            m.ingest(_gaussians(rng), cameras=_cameras(), name=name, scale="known")
        describe(m)
        yield m


def describe(m: Map) -> None:
    for scene, key in graph_keys(m.store, m.scenes(), m.settings).items():
        m.store.graphs.save(_graph(scene), key)


def _gaussians(rng: np.random.Generator, n: int = 50) -> Gaussians:
    return Gaussians(
        rng.uniform(-1, 1, size=(n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), -3.0),
        np.zeros(n),
        rng.normal(size=(n, 1, 3)),
    )


def _cameras() -> Cameras:
    pose = np.eye(4)
    pose[2, 3] = -4.0
    return Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))


def _graph(scene: str, n: int = 4) -> SceneGraph:
    rng = np.random.default_rng(0)
    embeddings = rng.normal(size=(n, 8)).astype(np.float32)
    layer = NodeLayer(
        positions=rng.normal(size=(n, 3)),
        embeddings=embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True),
        types=np.zeros(n, dtype=np.int32),
        extents=np.zeros((n, 2, 3)),
        weights=np.ones(n),
        num_views=np.ones(n, dtype=np.int32),
        features=np.zeros((n, 1)),
        descriptor_id="test",
    )
    return SceneGraph(scene, {"objects": layer}, np.array([0.0, 0, 1]), 1.0)


def test_a_scene_that_is_named_gets_its_damaged_graph_again(site: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    described: list[str] = []

    def jobs(job: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], params: Any) -> Iterator[tuple[int, Any]]:
        for i, (_, scene, *_) in enumerate(arguments):
            described.append(scene)
            yield i, (_graph(scene), prepared(scene))

    def spoil(which: str = "*") -> None:
        for path in site.store.home.glob(f"arrays/graphs/{which}/arrays.zip"):
            path.write_bytes(b"")

    monkeypatch.setattr("gsmap.map.stages.describe.run_jobs", jobs)
    hall, stairs, _ = (scene.id for scene in site.scenes())
    spoil()
    site.describe()  # which reads no arrays
    assert described == []
    row = site.describe("hall")[0]
    assert (described, row.layers[0].num_nodes) == ([hall], 4)
    problems = site.check().problems
    assert len(problems) == 2
    assert not any("scene hall" in problem for problem in problems)
    assert (
        f"scene stairs: compute it again with gsmap describe {site.store.location} stairs" in problems[0] + problems[1]
    )
    site.describe("stairs", "attic:east", "hall")
    assert described[:2] == [hall, stairs]
    assert (len(described), site.check().problems) == (3, ())
    site.describe("hall")
    assert len(described) == 3
    # One of another recipe cannot be made again, and goes.
    older = replace(graph_keys(site.store, site.scenes(), site.settings)[hall], method="older")
    site.store.graphs.save(_graph(hall, 5), older)
    assert site.store.graphs.damaged([older]) == set()
    site.describe("hall")
    assert site.store.graphs.find(older) is not None
    spoil()
    site.describe("hall")
    assert site.store.graphs.find(older) is None
    assert len(site.check().problems) == 2


def test_a_pair_is_registered_once_from_its_lower_id_to_its_higher(site: Map, tried: list[tuple[str, str]]) -> None:
    ids = [scene.id for scene in site.scenes()]
    site.register([("stairs", "hall"), ("hall", "stairs")])
    assert tried == [tuple(sorted(ids[:2]))]
    site.register("all")
    assert sorted(tried) == list(combinations(sorted(ids), 2))
    assert site.register("all") == []
    site.with_settings({"register.verdict.max_log_nfa": -9.5})
    site.register("all")
    assert sorted(tried[3:]) == list(combinations(sorted(ids), 2))


def test_jobs_see_the_map_that_lies_at_a_path_now(tmp_path: Path) -> None:
    from gsmap.map.jobs import store_of

    path = tmp_path / "site.gsmap"
    gsmap.map.create(path).close()
    first = store_of(str(path)).id
    assert store_of(str(path)).id == first
    shutil.rmtree(path)
    with gsmap.map.create(path) as m:
        assert store_of(str(path)).id == m.store.id != first


def test_pairs_of_a_removed_scene_are_refused(site: Map, tried: list[tuple[str, str]]) -> None:
    gone = site.remove("stairs").id
    with raises(NotFoundError, code="scene_removed"):
        site.register([("hall", gone)])
    assert tried == []


def test_a_file_of_pairs_takes_names_with_spaces_and_colons(site: Map, tmp_path: Path) -> None:
    site.edit("hall", name="the hall")
    path = tmp_path / "pairs.txt"
    path.write_text("the hall:attic:east  # seen\n\nstairs attic:east\nstairs:the hall\n")
    found = [(a.name, b.name) for a, b in read_pairs(site.store, path)]
    assert found == [("the hall", "attic:east"), ("stairs", "attic:east"), ("stairs", "the hall")]
    path.write_text("stairs attic:east\nstairs nowhere\n")
    with raises(NotFoundError, code="scene_not_found"):
        read_pairs(site.store, path)
    path.write_text("stairs\n")
    with raises(InputError, code="invalid_pairs_file"):
        read_pairs(site.store, path)


@pytest.mark.parametrize("values", [{}, {"retrieve.top_k": 0}, {"register.verdict.max_log_nfa": -9.5}])
def test_update_ends_whatever_people_said_and_settings_are(
    site: Map, tried: list[tuple[str, str]], values: dict[str, Any]
) -> None:
    site.update()
    site.confirm("hall:stairs")
    site.reject("stairs:attic:east")
    site.add_edge("hall:attic:east", Sim3(np.eye(3), np.array([2.0, 0, 0])), np.full(7, 0.1))
    report = site.with_settings(values).update()
    assert report.revision is not None
    kept = {frozenset((row.target_name, row.source_name)): (row.review, row.proposer) for row in site.edge_rows()}
    assert kept[frozenset(("hall", "stairs"))] == ("confirm", "graph:objects")
    assert kept[frozenset(("hall", "attic:east"))] == (None, "manual")
    made = len(tried)
    assert site.update().revision == report.revision
    assert len(tried) == made
    wrong = {row.what for row in site.status().todo} & {"stale_edges", "unsolved", "stale_poses", "unregistered"}
    assert wrong == set()


def test_a_confirmed_pose_stays_when_an_older_result_becomes_current_again(
    site: Map, tried: list[tuple[str, str]]
) -> None:
    site.update()
    site.with_settings({"register.verdict.max_log_nfa": -9.5}).update()
    site.confirm("hall:stairs", "walked there")
    site.with_settings({"register.verdict.max_log_nfa": -8.0}, "default").update()
    row = next(row for row in site.edge_rows() if {row.target_name, row.source_name} == {"hall", "stairs"})
    assert row.review == "confirm"
    assert len(tried) == 6
    site.confirm("hall:stairs", withdraw=True)
    assert site.update().revision is not None
    assert len(tried) == 6


def test_a_lone_measurement_that_is_withdrawn_leaves_no_edge(site: Map) -> None:
    site.add_edge("hall:stairs", Sim3(np.eye(3), np.zeros(3)), np.full(7, 0.1), "tape")
    row = site.reject("hall:stairs", withdraw=True)
    assert (row.status, row.S_target_source) == ("never registered", None)
    report = site.show_pair("hall:stairs")
    assert [event.what for event in report.history] == ["accepted", "withdraw"]
    with raises(NotFoundError, code="registration_not_found"):
        site.confirm("hall:stairs")


def test_the_up_of_a_graph_that_does_not_know_it_is_not_taken_from_an_older_one(site: Map) -> None:
    from gsmap.map.stages.optimize import pose_inputs

    assert len(pose_inputs(site.store, site.settings).ups) == 3
    site.with_settings({"describe.landmarks": False})
    scene = site.scenes()[0]
    graph = SceneGraph(scene.id, _graph(scene.id).layers, None, 1.0)
    site.store.graphs.save(graph, graph_keys(site.store, [scene], site.settings)[scene.id])
    assert set(pose_inputs(site.store, site.settings).ups) == {other.id for other in site.scenes()[1:]}


def test_a_closed_map_answers_nothing_from_memory(site: Map, tried: list[tuple[str, str]]) -> None:
    site.update()
    doors = ("add_edge", "confirm", "edge_rows", "edit", "metres", "optimize", "poses", "prune", "read", "remove")
    doors += ("revision_rows", "scene_rows", "scenes", "show_pair", "show_scene", "status", "tag", "update", "why")
    given = {"ref": "hall", "pair": "hall:stairs", "what": "hall:stairs", "name": "n", "note": "n"}
    given |= {"S_target_source": Sim3.identity(), "sigmas": np.ones(7)}

    def call(door: str) -> object:
        wanted = inspect.signature(getattr(site, door)).parameters.values()
        return getattr(site, door)(**{p.name: given[p.name] for p in wanted if p.default is p.empty and p.kind == 1})

    for door in ("edge_rows", "scenes", "status", "show_scene", "why"):
        assert call(door)
    site.close()
    site.close()
    for door in doors:
        with raises(StoreError, code="map_closed"):
            call(door)
    with raises(StoreError, code="map_closed"):
        site["hall"]
    assert "closed" in repr(site)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("merge.method = 3", "invalid_setting_value"),
        ("merge = 2", "setting_not_a_leaf"),
        ("preset = 'napkin'", "unknown_preset"),
        ("not toml", "invalid_settings_file"),
    ],
)
def test_a_map_can_be_looked_at_whatever_its_settings_say(
    site: Map, tried: list[tuple[str, str]], text: str, code: str, tmp_path: Path
) -> None:
    site.update()
    folder = site.store.folder
    (folder / "settings.toml").write_text(text)
    with gsmap.map.open(folder) as m:
        assert len(m.scene_rows()) == len(m.pose_rows()) == 3
        assert m.edge_rows()
        assert len(m.revision_rows()) == len(m.store.revisions.list())
        shown = m.show_scene("hall")
        assert shown.num_nodes == 4
        assert "settings.toml" in shown.notes[-1]
        assert m.show_pair("hall:stairs").status == "accepted"
        assert m.check().ok
        m.prune(dry_run=True)
        m.view().close()
        m.edit("hall", note="wet")
        m.remove("attic:east")
        for door in (m.status, m.update, m.setting_rows, lambda: m.export(tmp_path / "out")):
            with raises(ConfigError, code=code, match=r"settings\.toml"):
                door()  # type: ignore[operator]


def test_settings_that_cannot_be_are_named_and_taken_back(site: Map) -> None:
    path = site.store.folder / "settings.toml"
    path.write_text("[merge]\nmethod = 3\n")
    with raises(ConfigError, code="invalid_setting_value", match="merge.method"):
        site.change_settings({"retrieve.top_k": 3})
    assert "top_k" not in path.read_text()
    assert site.with_settings({"merge.method": "union"}).settings.merge.method == "union"  # in this run
    site.change_settings(unset=["merge.method"])
    with gsmap.map.open(site.store.folder) as m:
        assert m.settings == Settings()


def test_a_map_whose_file_names_a_removed_setting_opens_with_one_warning(
    site: Map, caplog: pytest.LogCaptureFixture
) -> None:
    path = site.store.folder / "settings.toml"
    misspelt = "[optimize]\ngate_probabilty = 0.9\n"
    path.write_text("# mine\n[merge]\nmethod = 'union'\nformer = 0.3\n[gone.away]\nkin_share = 2\n" + misspelt)
    site.__dict__.pop("settings", None)
    assert site.settings == changed(Settings(), {"merge.method": "union"})
    with gsmap.map.open(site.store.folder) as m:
        assert m.settings == site.settings
        m.change_settings({"merge.method": "voxel"})
    for name in ("merge.former", "gone.away.kin_share", "optimize.gate_probabilty"):
        (warning,) = [one.getMessage() for one in caplog.records if name in one.getMessage()]
        assert warning.startswith(f"{path}: setting {name} is ignored")
        assert warning.endswith(f"gsmap settings MAP --unset {name}")
    with raises(ConfigError, code="unknown_setting", match=r"merge\.former"):
        site.with_settings({"merge.former": 0.4})
    with raises(ConfigError, code="unknown_setting", match=r"merge\.former"):
        site.change_settings({"merge.former": 0.4})
    site.change_settings(unset=["merge.former", "gone.away.kin_share", "optimize.gate_probabilty"])
    assert path.read_text().startswith("# mine")
    assert "former" not in path.read_text()


def test_show_takes_the_newest_graph_where_the_present_one_is_missing(site: Map) -> None:
    site.with_settings({"describe.landmarks": False})
    shown = site.show_scene("hall")
    assert (shown.num_nodes, shown.status) == (4, "described")
    assert "run gsmap update" in shown.notes[-1]


def test_a_map_that_is_read_only_is_shown_and_exported(
    site: Map, tried: list[tuple[str, str]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site.update()
    with Map(Store.open(site.store.folder, "r")) as m:
        assert len(m.scene_rows()) == len(m.pose_rows()) == 3
        assert m.show_scene("hall").edges
        assert m.status().scenes == 3
        assert m.setting_rows()
        m.write_poses(tmp_path / "poses.json", "json")
        caplog.set_level("WARNING", logger="gsmap.export")
        made = m.export(tmp_path / "out", format="ply", merge="union", tile_size_m=0)
        assert made.recomputed == 1
        assert "read-only" in caplog.text
        assert m.export(tmp_path / "out", format="ply", merge="union", tile_size_m=0).reused == 1
        with raises(StoreError, code="not_writable"):
            m.remove("hall")
    assert site.tile_rows() == []


def test_status_names_the_export_that_brings_a_folder_up_to_date(
    site: Map, tried: list[tuple[str, str]], tmp_path: Path
) -> None:
    site.update()
    out = tmp_path / "my tiles"
    site.export(out, merge="union", tile_size_m=2.0, bbox=[-3, -3, -3, 3, 3, 3], format="splat")
    assert "dirty_tiles" not in {row.what for row in site.status().todo}
    site.remove("attic:east")
    site.optimize()
    verb = next(row.verb for row in site.status().todo if row.what == "dirty_tiles")
    assert verb == (
        f"gsmap export {site.store.folder} '{out}' --format splat --tile-size 2.0 --bbox -3 -3 -3 3 3 3 --merge union"
    )
    with raises(NotFoundError, code="revision_not_found"):
        site.export(tmp_path / "none", revision=0)


def test_the_options_of_an_export() -> None:
    assert Request().options() == []
    assert Request(merge="tto", component=0, provenance=True).options() == [
        "--merge",
        "tto",
        "--component",
        "0",
        "--provenance",
    ]


def test_a_prior_is_answered_without_settings(site: Map) -> None:
    from gsmap.types import Prior

    (site.store.folder / "settings.toml").write_text("not toml")
    sigmas = np.r_[np.full(3, np.inf), np.full(3, 0.1), np.inf]
    row = site.set_prior(Prior("hall", Sim3(np.eye(3), np.ones(3)), sigmas))
    assert row is not None
    assert (row.scene_name, row.outcome) == ("hall", "not solved yet")
    assert row.to_json()["sigmas"][0] is None
    assert math.isinf(row.sigmas[0])


def test_a_prior_is_used_once_it_was_solved(site: Map, tried: list[tuple[str, str]]) -> None:
    from gsmap.types import Prior

    def outcome(x: float) -> str:
        row = site.set_prior(Prior("hall", Sim3(np.eye(3), np.array([x, 0, 0])), np.full(7, 0.1)))
        assert row is not None
        return row.outcome

    site.update()
    assert outcome(2.0) == "not solved yet"
    site.optimize()
    assert site.show_scene("hall").prior.outcome == "used"
    assert outcome(5.0) == "not solved yet"
    assert outcome(2.0) == "used", "the poses were solved with it"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("merge.method", "merger"),
        ("engine.executor", "executor"),
        ("register.refiner", "refiner"),
        ("describe.object.segmenter", "segmenter"),
        ("describe.object.embedder", "embedder"),
    ],
)
def test_a_method_that_does_not_exist_is_refused_when_it_is_set(site: Map, name: str, kind: str) -> None:
    with raises(ConfigError, code="unknown_method"):
        site.change_settings({name: "nope"})
    assert not (site.store.folder / "settings.toml").exists()


def test_a_preset_that_does_not_exist_is_not_blamed_on_the_file(site: Map) -> None:
    with raises(ConfigError, code="unknown_preset"):
        site.change_settings(preset="napkin")


def test_what_cannot_be_asked_for_changes_nothing(
    site: Map, tried: list[tuple[str, str]], tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    site.update()
    with raises(ConfigError, code="out_of_range", match="revisions .*-1"):
        site.prune(-1)
    assert site.revision_rows()[-1].dropped_at is None
    with raises(ConfigError, code="too_many_tiles"):
        site.export(tmp_path / "out", format="ply", tile_size_m=1e-300)
    choices = r"'doc': choose one of compressed\.ply, glb, ply, .*sog, splat, .*3dtiles, streamed-sog"
    with raises(ConfigError, code="unsupported_output", match=choices):
        site.export(tmp_path / "out", format="doc")
    assert not (tmp_path / "out").exists()
    for door in (site.confirm, site.show_pair, site.register):
        with raises(ConfigError, code="same_scene"):
            door("hall:hall")  # type: ignore[operator]
    with raises(ConfigError, code="wrong_suffix", match=r"\.png"):
        site.draw_graph("hall", tmp_path / "hall.doc")
    assert not list(tmp_path.glob("hall*"))
    assert [str(warning.message) for warning in recwarn] == []


def test_a_date_is_taken_back(site: Map) -> None:
    assert site.edit("hall", captured_at="2024-05-31").captured_at == "2024-05-31T00:00:00+00:00"
    assert site.edit("hall", captured_at="none").captured_at is None
