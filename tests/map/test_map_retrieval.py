"""What an update reads: only new scenes ask the index, nothing is read where nothing is new, and what is lost is made
anew."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from map_orders import Described, pairs_remembered, walked_room

import gsmap.map
from gsmap.map import Map
from gsmap.store.graphs import Graphs
from gsmap.store.indexes import StoredSegment

NAMES = [f"capture_{letter}" for letter in "abcd"]


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch, pairs_remembered():
        patch.setenv("GSMAP_WORKERS", "1")
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Described]:
    with walked_room(tmp_path_factory.mktemp("maps") / "described.gsmap", 4) as found:
        yield found


@pytest.fixture(scope="module")
def three(made: Described, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "three.gsmap"
    with gsmap.map.create(path) as m:
        for name in NAMES[:3]:
            made.ingest(m, name)
        m.update()
        assert {row.status for row in m.edge_rows()} == {"accepted"}
    return path


@pytest.fixture
def site(three: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(three, tmp_path / "site.gsmap"))


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often a graph was loaded, and rows of the index were read."""
    count: Counter[str] = Counter()
    load, rows = Graphs.load, StoredSegment.rows

    def counted_load(*args, **kwargs):
        count["graphs"] += 1
        return load(*args, **kwargs)

    def counted_rows(*args):
        count["rows"] += 1
        return rows(*args)

    monkeypatch.setattr(Graphs, "load", counted_load)
    monkeypatch.setattr(StoredSegment, "rows", counted_rows)
    return count


def pairs(m: Map) -> set[frozenset[str]]:
    return {frozenset((row.target_name, row.source_name)) for row in m.edge_rows()}


def test_an_update_of_nothing_reads_no_graph_and_no_index(site: Path, read: Counter[str]) -> None:
    with gsmap.map.open(site) as m:
        m.update()
        assert m.register("auto") == []
    assert read == {}


def test_a_newcomer_alone_asks(made: Described, site: Path, read: Counter[str]) -> None:
    with gsmap.map.open(site) as m:
        made.ingest(m, NAMES[3])
        read.clear()
        before = {one: at[0] for one, at in m.store.indexes.lookup_states().items()}
        rows = m.register("auto")
        assert len(rows) == 3
        asked = m.store.indexes.lookup_states()
        assert {one: asked[one][0] for one in before} == before
        assert len(asked) == 4
        (new,) = set(asked) - set(before)
        assert asked[new][1] == 0
        # Its graph once to be asked with, and once to be prepared, since these tests describe without that; the others'
        # and its own where its pairs are worked on, not before.
        assert read["graphs"] <= 1 + 1 + 4
        assert len(m.store.indexes.lookups([new])[0].candidates) == 3
        (segment,) = m.store.indexes.segments(_recipe(m))
        assert len(segment.members) == 4


def test_a_lost_or_damaged_index_is_made_anew_and_says_the_same(made: Described, site: Path) -> None:
    with gsmap.map.open(site) as m:
        (segment,) = m.store.indexes.segments(_recipe(m))
        for path in (m.store.arrays.root / "indexes" / segment.id).iterdir():
            if path.is_file():
                path.write_bytes(b"damaged".ljust(path.stat().st_size, b"."))
        assert not m.store.check().ok
        made.ingest(m, NAMES[3])
        assert len(m.register("auto")) == 3
        assert m.store.check().ok
        whole = m.store.indexes.lookups([scene.id for scene in m.scenes()])
        m.store.indexes.forget([one.id for one in m.store.indexes.segments(_recipe(m))])
        m.with_settings({"retrieve.top_k": 33})
        assert m.register("auto") == []
        again = m.store.indexes.lookups([scene.id for scene in m.scenes()])
    # Other settings: all have asked, and those that the newcomer found find it.
    assert {one.scene for one in again} == {one.scene for one in whole}
    assert all(len(one.candidates) == 3 for one in again)


def test_a_removed_scene_is_not_proposed_and_asks_again_when_it_is_back(made: Described, site: Path) -> None:
    with gsmap.map.open(site) as m:
        m.remove(NAMES[0])
        made.ingest(m, NAMES[3])
        m.register("auto")
        assert pairs(m) == {
            frozenset(pair) for pair in [(NAMES[1], NAMES[2]), (NAMES[1], NAMES[3]), (NAMES[2], NAMES[3])]
        }
        made.ingest(m, NAMES[0])
        m.register("auto")
        assert len(pairs(m)) == 6


def test_an_interrupted_run_goes_on_with_what_it_had_proposed(
    made: Described, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsmap.map.stages import register as stage

    with gsmap.map.open(site) as m:
        made.ingest(m, NAMES[3])

        def killed(*args, **kwargs):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(stage, "run_jobs", killed)
            with pytest.raises(KeyboardInterrupt):
                m.register("auto")
        assert None in {left for _, left in m.store.indexes.lookup_states().values()}
        (why,) = [step for step in m.why(f"{NAMES[0]}:{NAMES[3]}").steps if step.name == "retrieval"]
        assert "the next gsmap update tries" in str(why.value)
        assert "the next gsmap update tries" in m.why(f"{NAMES[0]}:{NAMES[3]}").advice
        assert len(m.register("auto")) == 3


def test_pairs_are_not_tried_where_the_map_is_rigid(made: Described, tmp_path: Path) -> None:
    with gsmap.map.create(tmp_path / "rigid.gsmap") as m:
        m.with_settings({"retrieve.max_edges_per_scene": 1, "retrieve.num_neighbours": 0})
        for name in NAMES:
            made.ingest(m, name)
            m.register("auto")
        # Each newcomer is tied by its first pair, and most of its list over the scene that it is tied to.
        tried = pairs(m)
        assert 3 <= len(tried) < 6
        left = {m.store.scenes.get(one).name: count for one, (_, count) in m.store.indexes.lookup_states().items()}
        assert sum(count or 0 for count in left.values()) == 6 - len(tried)
        untried = next(f"{a}:{b}" for a in NAMES for b in NAMES if a < b and frozenset((a, b)) not in tried)
        (why,) = [step for step in m.why(untried).steps if step.name == "retrieval"]
        assert "edges that are not doubtful" in str(why.value)
        assert not why.passed
        # They share a place, and were left out for cost: that is the advice, and no word of nothing that they share.
        assert "left out to save time" in m.why(untried).advice
        assert f"--pairs {untried}" in m.why(untried).advice
        # The edges of one are rejected: what was left of its list is tried.
        scene = max(left, key=lambda name: left[name] or 0)
        for a, b in sorted(sorted(pair) for pair in tried if scene in pair):
            m.reject(f"{a}:{b}")
        assert "the next gsmap update tries" in m.why(_untried_of(scene, tried)).advice
        m.register("auto")
        assert len(pairs(m)) > len(tried)


def test_why_tells_what_is_not_looked_up_from_what_is_not_listed(made: Described, site: Path) -> None:
    with gsmap.map.open(site) as m:
        made.ingest(m, NAMES[3])
        pair = f"{NAMES[0]}:{NAMES[3]}"
        assert "next gsmap update" in m.why(pair).advice
    with gsmap.map.open(site) as m:
        m.with_settings({"retrieve.top_k": 1, "retrieve.num_neighbours": 0})
        m.register("auto")
        told = {}
        for k, a in enumerate(NAMES):
            for b in NAMES[k + 1 :]:
                report = m.why(f"{a}:{b}")
                told[report.status, "the first 1 " in report.advice] = report
        assert ("never registered", True) in told
        assert ("never registered", False) not in told


def _untried_of(scene: str, tried: set[frozenset[str]]) -> str:
    return next(
        ":".join(sorted((scene, other)))
        for other in NAMES
        if frozenset((scene, other)) not in tried | {frozenset((scene,))}
    )


def _recipe(m: Map) -> str:
    from gsmap.retrieve import index_recipe

    return index_recipe(m.settings.retrieve)
