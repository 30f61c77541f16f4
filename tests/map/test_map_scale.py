"""What one update costs does not depend on how many scenes there are: statements and graphs are counted."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from sqlalchemy import select

from gsmap.map import Map, shared_jobs
from gsmap.map.stages import optimize, register
from gsmap.store.matrices import pose_bytes
from gsmap.store.registrations import Registrations, StoredRegistration
from gsmap.store.schema import edges, poses
from gsmap.types import PoseGraph, ScenePose
from tools.make.large_maps import TRIED, Filled, filled, tiny_pattern

SMALL, LARGE = 12, 100
LOOKED_UP = False  # whether the map says which pairs to try; else these are given (`Filled.standing_in`)
MOST_STATEMENTS = 300


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSMAP_WORKERS", "1")
        yield


@pytest.fixture(scope="module", params=[SMALL, LARGE])
def street(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Filled]:
    with filled(tmp_path_factory.mktemp("scale") / "street.gsmap", request.param, tiny_pattern()) as one:
        yield one


COUNTS: dict[str, dict[int, dict[str, int]]] = {}


def note(street: Filled, name: str, num: int, work: Callable[[], object]) -> None:
    """Count a piece of work; what it counts is the same for every number of scenes."""
    with street.counting() as counts, street.standing_in(lookup=LOOKED_UP):
        work()
    of_all = COUNTS.setdefault(name, {})
    of_all[num] = dict(counts)
    assert counts["sql"] < MOST_STATEMENTS
    assert all(found == of_all[num] for found in of_all.values()), f"{name}: {of_all}"


def is_new(m: Map, scene: str, pose: ScenePose) -> bool:
    """Whether the newest revision has put a scene anywhere else than the one before."""
    last = m.store.revisions.newest_number()
    assert last is not None
    before = m.store.revisions.get(last - 1)
    assert before is not None
    then = before.poses.get(scene)
    return then is None or pose_bytes(then.S_map_scene) != pose_bytes(pose.S_map_scene) or then.status != pose.status


def test_cost_is_that_of_what_is_new(street: Filled) -> None:
    m, num = street.map, street.num_scenes
    assert m.pose_graph() is not None
    reports = []
    note(street, "nothing to do", num, lambda: reports.append(m.update()))
    new = street.add()
    note(street, "one scene more", num, lambda: reports.append(m.update()))
    graph = m.pose_graph()
    assert graph is not None
    assert {graph.poses[scene].status for scene in street.order} == {"placed"}
    nothing, one_more = reports
    assert (nothing.ingested, nothing.scenes, nothing.edges) == ((), (), ())
    tried = {frozenset((edge.target, edge.source)) for edge in one_more.edges if new in (edge.target, edge.source)}
    assert tried == {frozenset((new, other)) for other in street.order[-1 - TRIED : -1]}
    assert new in {row.id for row in one_more.scenes}
    moved = {scene for scene, pose in graph.poses.items() if is_new(m, scene, pose)}
    assert {row.id for row in one_more.scenes} == moved
    for row in one_more.scenes:  # each as the list of all has it
        assert row == next(one for one in m.scene_rows() if one.id == row.id)
    for edge in one_more.edges:
        assert edge == next(one for one in m.edge_rows() if one.pair == edge.pair)
    note(street, "list revisions", num, m.revision_rows)
    note(street, "show A:B", num, lambda: m.show_pair(street.some_pair()))
    name = m.scenes()[-1].name
    note(street, "show SCENE", num, lambda: m.show_scene(name))
    note(street, "status", num, m.status)
    if num == LARGE:
        assert len(COUNTS["one scene more"]) == 2


def test_poses_are_named_again_only_where_edges_came_after_the_solve(
    street: Filled, monkeypatch: pytest.MonkeyPatch
) -> None:
    named, pose_basis = [], optimize.pose_basis
    monkeypatch.setattr(optimize, "pose_basis", lambda *given: named.append(1) or pose_basis(*given))
    street.add()
    with street.standing_in():
        street.map.update()
    assert len(named) == 2  # to see whether to solve, and what is solved


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[Filled]:
    """A small street of a test's own."""
    with filled(tmp_path / "alone.gsmap", SMALL, tiny_pattern()) as one:
        yield one


def test_pairs_share_their_statements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_jobs, "TOGETHER_S", 600.0)  # on a machine however slow
    counts = {}
    for num, pairs in ((3, 3), (5, 10)):
        with filled(tmp_path / f"{num}.gsmap", num, tiny_pattern()) as one:
            one.map.with_settings({"register.verdict.max_log_nfa": -9.5})
            with one.counting() as counted, one.standing_in(lookup=True):
                assert len(one.map.register("all")) == pairs
            counts[num] = counted["sql"]
            for a, b in combinations(one.order, 2):
                assert len(one.map.store.registrations.history(a, b)) == 2
    # One job is leased first, to see how long it takes; then as many as there are.
    assert counts[3] == counts[5] < 60


def test_who_is_stopped_keeps_the_pairs_that_are_done(alone: Filled, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_jobs, "TOGETHER_S", 600.0)
    done = 3

    def stops(job: object, arguments: Iterable[Any], *_: Any, **__: Any) -> Iterator[tuple[int, Any]]:
        for k, made in enumerate(alone._register(job, arguments)):
            if k == done:
                raise KeyboardInterrupt
            yield made

    before = alone.map.store.registrations.newest_number()
    pairs = [(alone.order[0], other) for other in alone.order[1:8]]
    # Undone in the order in which they were made: the other way round one would stay.
    stopping = mock.patch.object(register, "run_jobs", stops)
    with alone.standing_in(lookup=True), stopping, pytest.raises(KeyboardInterrupt) as stopped:
        alone.map.register(pairs)
    assert "3 of 7 pairs are registered and kept" in stopped.value.__notes__
    assert alone.map.store.registrations.newest_number() == before + done
    assert alone.map.store.leases.list() == []


def test_a_scene_placed_by_what_lies_around_it_lies_where_all_edges_put_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers, read = [], []
    usable = Registrations.current_usable

    def counted(self: Registrations, among: Collection[str] | None = None) -> list[StoredRegistration]:
        found = usable(self, among)
        read.append(len(found))
        return found

    monkeypatch.setattr(Registrations, "current_usable", counted)
    for name, inputs in (("around", optimize._inputs), ("all", optimize.pose_inputs)):
        with filled(tmp_path / name, 40, tiny_pattern()) as one, one.standing_in():
            one.map.with_settings({"optimize.max_full_scenes": 10})
            one.map.optimize()
            monkeypatch.setattr(optimize, "_inputs", inputs)
            read.clear()
            for _ in range(3):
                one.add()
                one.map.update()
            graph, history = one.map.pose_graph(), one.map.store.revisions.list()
            assert graph is not None
            assert graph.provenance.method == "incremental"
            with one.map.store.catalog.read() as connection:
                rows = [connection.execute(select(table).order_by(*table.c[:3])).all() for table in (poses, edges)]
            answers.append(([(r.number, r.key, r.num_used, r.num_scenes) for r in history], str(graph.provenance)))
            answers[-1] += (said(graph), [[str(tuple(row)) for row in of_one] for of_one in rows])
            if name == "around":
                assert len(read) == 3  # nothing was asked twice
                assert max(read) < 25  # of eighty
    assert answers[0] == answers[1]


def test_all_is_solved_anew_where_an_older_edge_changed_as_well(tmp_path: Path) -> None:
    with filled(tmp_path / "long.gsmap", 40, tiny_pattern()) as alone:
        _changes_with_a_scene(alone)


def _changes_with_a_scene(alone: Filled) -> None:
    m = alone.map
    m.with_settings({"optimize.max_full_scenes": 10})
    m.optimize()
    names = m.store.scenes.names()
    methods = []
    for review in (False, True, False):
        if review:
            m.reject(f"{names[alone.order[2]]}:{names[alone.order[3]]}")
        alone.add()
        m.update()
        graph = m.pose_graph()
        assert graph is not None
        methods.append(graph.provenance.method)
    assert methods == ["incremental", "batch", "incremental"]
    assert not {one.what for one in m.status().todo} & {"unsolved", "stale_poses"}


def said(graph: PoseGraph) -> list[tuple[object, ...]]:
    """Poses and outcomes to the last bit."""
    placed = [
        (scene, pose_bytes(pose.S_map_scene), pose.component, pose.status, str(pose.covariance))
        for scene, pose in sorted(graph.poses.items())
    ]
    return placed + sorted(graph.outcomes.items())
