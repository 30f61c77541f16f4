"""A new kind of result, made in this file alone, is listed, kept, copied, checked, pruned and purged like any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from raising import raises
from sqlalchemy import update
from store_samples import key, make_cameras, make_gaussians

from gsmap.errors import CorruptError, InputError
from gsmap.store import Store, merging, purging
from gsmap.store.array_groups import PackedResult
from gsmap.store.backup import restoring
from gsmap.store.column_types import is_object_set
from gsmap.store.result_rows import ResultRows
from gsmap.store.results import DerivedArrays
from gsmap.store.schema import results
from gsmap.store.sizes import sizes
from gsmap.types import Scene, SceneGraph


class MeanColours(DerivedArrays[tuple[str, np.ndarray]]):
    """The mean colour of each scene."""

    def __init__(self, store: Store) -> None:
        super().__init__(store.catalog, store.arrays, "colours", "the mean colour of scene")

    def _pack(self, found: tuple[str, np.ndarray]) -> PackedResult:
        scene, mean = found
        return PackedResult(scene, 1, {"num_items": 1}, {"mean": mean[None]})

    def add(self, scene: str, mean: np.ndarray) -> None:
        self.save((scene, mean), key("colours", scene))

    def load(self, scene: str) -> np.ndarray | None:
        return self.get(
            scene,
            key("colours", scene),
            lambda about: {"mean": (np.float64, (about["num_items"], 3))},
            lambda row, arrays: arrays["mean"][0],
        )


GREY = np.array([0.1, 0.2, 1 / 3])


@pytest.fixture
def scene(store: Store) -> Scene:
    made = store.scenes.add(make_gaussians(), make_cameras(), name="a")[0]
    MeanColours(store).add(made.id, GREY)
    return made


def groups(store: Store) -> list[str]:
    return [name for kind, name in store.arrays.groups() if kind == "colours"]


def test_it_is_read_as_it_was_saved_and_listed(store: Store, scene: Scene) -> None:
    colours = MeanColours(store)
    assert np.array_equal(colours.load(scene.id), GREY)
    assert colours.stored_keys([key("colours", scene.id), "0" * 32]) == {key("colours", scene.id).digest}
    assert sizes(store)["colours"][0] == 1
    assert store.view_features.stored_keys([key("colours", scene.id)]) == set()  # another kind
    assert store.graphs.find(key("colours", scene.id)) is None
    assert store.graphs.stored_keys([key("colours", scene.id)]) == set()
    with raises(InputError, code="key_input_mismatch"):
        colours.save((scene.id, GREY), key("colours"))


def test_a_clone_and_a_merge_carry_it(store: Store, scene: Scene, tmp_path: Path) -> None:
    restoring.clone(store, tmp_path / "clone.gsmap")
    with Store.open(tmp_path / "clone.gsmap", "r") as clone:
        assert np.array_equal(MeanColours(clone).load(scene.id), GREY)
    with Store.create(tmp_path / "other.gsmap") as other:
        merging.merge(other, store)
        assert np.array_equal(MeanColours(other).load(scene.id), GREY)
        MeanColours(other).save((scene.id, GREY + 1), key("colours", scene.id, bright=True))
        merging.merge(other, store)  # a scene has one of a kind: the map keeps its own
        assert MeanColours(other).load(scene.id) is None
        assert other.check().ok


def test_of_a_thinned_scene_it_is_forgotten_and_not_copied(store: Store, scene: Scene, tmp_path: Path) -> None:
    with Store.create(tmp_path / "other.gsmap") as other:
        other.scenes.add(make_gaussians(), make_cameras(), name="a")
        store.scenes.thin("a", np.arange(scene.num_gaussians) < 100)
        assert MeanColours(store).load(scene.id) is None
        MeanColours(store).add(scene.id, GREY)  # of the Gaussians that are left
        merging.merge(other, store)
        assert MeanColours(other).load(scene.id) is None
        MeanColours(other).add(scene.id, 2 * GREY)
        merging.merge(store, other)  # the scene is whole again, and the result comes with it
        assert np.array_equal(MeanColours(store).load(scene.id), 2 * GREY)


def test_damage_in_the_other_map_ends_no_merge(store: Store, scene: Scene, tmp_path: Path) -> None:
    (name,) = groups(store)
    file = store.folder / "arrays" / "colours" / name / "arrays.zip"
    file.write_bytes(file.read_bytes()[:-50])
    with Store.create(tmp_path / "other.gsmap") as other:
        assert merging.merge(other, store).num_scenes == 1
        assert MeanColours(other).load(scene.id) is None
        assert other.check().ok


def test_a_graph_of_a_thinned_scene_does_not_follow_that_of_the_whole_one(
    store: Store, scene: Scene, tmp_path: Path
) -> None:
    with Store.create(tmp_path / "whole.gsmap") as whole:
        whole.scenes.add(make_gaussians(), make_cameras(), name="a")
        whole.graphs.save(SceneGraph(scene.id, {}, None, 2.0), key("describe", scene.id))
        store.scenes.thin("a", np.arange(scene.num_gaussians) < 100)
        store.graphs.save(SceneGraph(scene.id, {}, None, 3.0), key("things", scene.id))
        assert merging.merge(whole, store).num_graphs == 0
        assert [graph.unit_m for graph in whole.graphs.list()] == [2.0]
        assert merging.merge(store, whole).num_graphs == 1  # the scene is whole again
        assert [graph.unit_m for graph in store.graphs.list()] == [2.0]


def test_it_goes_with_its_scene(store: Store, scene: Scene) -> None:
    store.scenes.remove("a")
    assert store.prune().num_bytes > 0
    assert groups(store) == []
    assert store.check().ok


def test_a_purge_counts_and_erases_it(store: Store, scene: Scene) -> None:
    restoring.clone(store, store.home.with_name("clone.gsmap"))  # shares files with the map
    done = purging.finish(store, purging.begin(store, scene.id), ())
    assert done.receipt["linked_files"] == 2  # the scene's, and this one
    assert done.receipt["rows"]["colours"] == 1
    assert groups(store) == []


def test_damage_is_found_and_forgotten(store: Store, scene: Scene) -> None:
    (name,) = groups(store)
    file = store.folder / "arrays" / "colours" / name / "arrays.zip"
    file.write_bytes(file.read_bytes()[:-50])
    (problem,) = store.check().problems
    assert "computes it again" in problem
    with raises(CorruptError, code="arrays_missing"):
        MeanColours(store).load(scene.id)
    MeanColours(store).forget_damaged([scene.id])
    assert MeanColours(store).load(scene.id) is None
    store.prune()
    assert store.check().ok


@pytest.mark.parametrize("column", ["scene", "group_id"])
def test_rows_without_a_scene_or_arrays_are_refused(store: Store, scene: Scene, column: str) -> None:
    store.graphs.save(SceneGraph(scene.id, {}, None, 2.0), key("describe", scene.id))
    with store.catalog.write() as connection:
        connection.execute(update(results).values({column: None}))
    with raises(CorruptError, code="catalog_invalid"):
        store.graphs.groups()
    if column == "group_id":
        for read in (store.graphs.list, lambda: MeanColours(store).load(scene.id)):
            with raises(CorruptError, code="catalog_invalid"):
                read()


def test_a_purge_finds_what_only_its_metadata_names(store: Store, scene: Scene) -> None:
    poses = {scene.id: {"rotation": np.eye(3).tolist(), "translation": [0, 0, 0], "scale": 1.0}}
    with store.catalog.write() as connection:
        ResultRows("objects", is_object_set).insert(connection, key="0" * 32, num_items=0, about={"poses": poses})
    with raises(CorruptError, code="catalog_invalid"):
        store.objects.sets()
    purging.finish(store, purging.begin(store, scene.id), ())
    assert store.objects.sets() == []
