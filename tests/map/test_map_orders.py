"""The same content in any order gives the same map: edges are settled by content, not by who came first."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from map_orders import Described, Outcome, pairs_remembered, walked_room

import gsmap.map
from gsmap import register as registering
from gsmap.map.stages.describe import graph_keys

NAMES = ["capture_a", "capture_b", "capture_c"]


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch, pairs_remembered():
        patch.setenv("GSMAP_WORKERS", "1")
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Described]:
    with walked_room(tmp_path_factory.mktemp("maps") / "described.gsmap", 3) as found:
        yield found


@pytest.fixture(scope="module")
def reference(made: Described, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    return made.in_order(NAMES, tmp_path_factory.mktemp("maps") / "one.gsmap", one_by_one=False)


@pytest.mark.parametrize(("order", "one_by_one"), [("cba", False), ("bca", False), ("cab", True), ("bac", True)])
def test_any_order_gives_the_same_edges_and_poses(
    made: Described, reference: Outcome, tmp_path: Path, order: str, one_by_one: bool
) -> None:
    assert {use for *_, use in reference.accepted} == {"used"}
    assert len(reference.accepted) == 3
    names = [f"capture_{letter}" for letter in order]
    other = made.in_order(names, tmp_path / "other.gsmap", one_by_one=one_by_one)
    assert other.same_edges(reference)
    mm, deg = other.apart(reference)
    assert mm < 1e-3
    assert deg < 1e-5


def test_a_pair_is_the_same_pair_however_it_is_named(made: Described) -> None:
    m = made.map
    ids = {scene.name: scene.id for scene in m.scenes()}
    expected = tuple(sorted((ids["capture_a"], ids["capture_c"])))
    both = [("capture_c", "capture_a"), ("capture_a", "capture_c")]
    for pairs in ("capture_a:capture_c", "capture_c:capture_a", both):
        (row,) = m.register(pairs)
        assert (row.target, row.source) == expected


def test_an_edge_in_the_other_direction_stays_until_its_recipe_changes(made: Described, tmp_path: Path) -> None:
    """Maps of gsmap 0.1 hold edges from the later scene to the earlier one, whatever their ids."""
    with gsmap.map.create(tmp_path / "old.gsmap") as m:
        for name in NAMES[:2]:
            made.ingest(m, name)
        low, high = sorted(scene.id for scene in m.scenes())
        edge = registering.register_pair(*(view(made, scene) for scene in (high, low)))
        assert edge.status == "accepted"
        keys = graph_keys(m.store, m.scenes(), m.settings)
        key = registering.recipe_key(m.settings.register).of(keys[high].digest, keys[low].digest)
        m.store.registrations.save(edge, key)
        assert m.register("auto") == m.register("all") == []
        assert "stale_edges" not in {row.what for row in m.status().todo}
        m.update()
        assert [len(members) for members in Outcome.of(m).islands] == [2]
        # Other settings make it anew, by content; going back to the first brings it back as it was.
        m.with_settings({"register.verdict.max_log_nfa": -7.0})
        (row,) = m.register("auto")
        assert (row.target, row.source) == (low, high)
        m.with_settings({"register.verdict.max_log_nfa": -8.0})
        assert m.register("auto") == []
        (stored,) = m.store.registrations.current()
        assert (stored.registration.target, stored.adopts) == (high, 1)


def view(made: Described, scene: str) -> registering.SceneView:
    scenes, graphs = made.map.store.scenes, made.map.store.graphs
    policy = scenes.get(scene).scale_policy
    return registering.SceneView(scene, scenes.gaussians(scene), scenes.cameras(scene), graphs.load(scene), policy)
