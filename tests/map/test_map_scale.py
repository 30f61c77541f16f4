"""What one update costs does not depend on how many scenes there are: statements and graphs are counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from scale_maps import Filled, filled, tiny_pattern

from gsmap.map.stages import optimize

SMALL, LARGE = 12, 36
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


def test_cost_is_that_of_what_is_new(street: Filled) -> None:
    m, num = street.map, street.num_scenes
    assert m.pose_graph() is not None
    note(street, "nothing to do", num, m.update)
    street.add()
    note(street, "one scene more", num, m.update)
    graph = m.pose_graph()
    assert graph is not None
    assert {graph.poses[scene].status for scene in street.order} == {"placed"}
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
