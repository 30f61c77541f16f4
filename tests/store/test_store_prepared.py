"""Prepared scenes are stored one per scene, read as they were saved, and reclaimed with their scene."""

import numpy as np
import pytest
from raising import raises
from store_samples import key, made_prepared, make_cameras, make_gaussians

from gsmap.errors import CorruptError, InputError
from gsmap.map.jobs import load_view
from gsmap.register.recipe import prepared_key
from gsmap.store.prepared_scenes import KIND
from gsmap.types import Cameras, Gaussians, SceneGraph


@pytest.fixture
def scene(store):
    return store.scenes.add(make_gaussians(), make_cameras(), name="a")[0]


def test_it_is_read_as_it_was_saved(store, scene):
    made = made_prepared(scene.id)
    store.prepared_scenes.save(made, key("register", scene.id))
    found = store.prepared_scenes.load(scene.id, key("register", scene.id))
    for name, value in vars(made).items():
        again = getattr(found, name)
        if isinstance(value, np.ndarray):
            assert again.dtype == value.dtype, name
            assert np.array_equal(again, value), name
        elif isinstance(value, Cameras):
            assert np.array_equal(again.T_frame_camera, value.T_frame_camera)
            assert np.array_equal(again.sizes_px, value.sizes_px)
        else:
            assert again == value
    assert store.prepared_scenes.load(scene.id, "0" * 32) is None


def test_the_latest_replaces_the_one_before(store, scene):
    first, second = key("register", scene.id), key("register", scene.id, "1" * 32)
    store.prepared_scenes.save(made_prepared(scene.id), first)
    store.prepared_scenes.save(made_prepared(scene.id, 9), second)
    assert store.prepared_scenes.stored_keys([first, second]) == {second.digest}
    assert len([name for kind, name in store.arrays.groups() if kind == KIND]) == 2
    store.prune()
    assert len([name for kind, name in store.arrays.groups() if kind == KIND]) == 1
    assert len(store.prepared_scenes.load(scene.id, second).points) == 9


def test_that_of_a_removed_scene_is_pruned(store, scene):
    store.prepared_scenes.save(made_prepared(scene.id), key("register", scene.id))
    store.scenes.remove(scene.id)
    store.prune()
    assert not [name for kind, name in store.arrays.groups() if kind == KIND]
    assert store.check().ok


def test_damage_is_found_and_named(store, scene):
    store.prepared_scenes.save(made_prepared(scene.id), key("register", scene.id))
    (name,) = (name for kind, name in store.arrays.groups() if kind == KIND)
    file = store.folder / "arrays" / KIND / name / "arrays.zip"
    file.write_bytes(file.read_bytes()[:-100])
    with raises(CorruptError, code="arrays_missing"):
        store.prepared_scenes.load(scene.id, key("register", scene.id))
    assert any(name in problem for problem in store.check().problems)


def test_damaged_ones_are_forgotten_and_stored_again(store, scene):
    made, mine = made_prepared(scene.id), key("register", scene.id)
    store.prepared_scenes.save(made, mine)
    store.prepared_scenes.forget_damaged([scene.id])
    assert store.prepared_scenes.stored_keys([mine])
    (name,) = (name for kind, name in store.arrays.groups() if kind == KIND)
    file = store.folder / "arrays" / KIND / name / "arrays.zip"
    file.write_bytes(file.read_bytes()[:-100])
    store.prepared_scenes.forget_damaged([scene.id])
    assert not store.prepared_scenes.stored_keys([mine])
    store.prepared_scenes.save(made, mine)
    assert len(store.prepared_scenes.load(scene.id, mine).points) == len(made.points)
    assert store.check().ok


def test_a_scene_whose_preparation_is_damaged_is_registered_nevertheless(store, scene):
    graph_key = key("describe", scene.id)
    store.graphs.save(SceneGraph(scene.id), graph_key)
    store.prepared_scenes.save(made_prepared(scene.id), prepared_key().of(scene.id, graph_key.digest))
    assert load_view(store, scene.id, graph_key.digest).known is not None
    (name,) = (name for kind, name in store.arrays.groups() if kind == KIND)
    file = store.folder / "arrays" / KIND / name / "arrays.zip"
    file.write_bytes(file.read_bytes()[:-100])
    assert load_view(store, scene.id, graph_key.digest).known is None


def test_its_key_must_name_the_scene(store, scene):
    with raises(InputError, code="key_input_mismatch"):
        store.prepared_scenes.save(made_prepared(scene.id), key("register", "0" * 32))


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_fields_of_unread_gaussians_are_those_of_the_scene(store, degree):
    g = make_gaussians(50)
    sh = np.random.default_rng(0).normal(size=(50, (degree + 1) ** 2, 3))
    scene, _ = store.scenes.add(
        Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, sh), make_cameras(), name="s"
    )
    whole, unread = store.scenes.gaussians(scene.id), store.scenes.unread(scene.id)
    assert len(unread) == 50
    assert unread.sh_degree == whole.sh_degree == degree
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        assert np.array_equal(getattr(unread, name), getattr(whole, name))
    mask = np.arange(50) % 3 == 0
    part = unread.degree_0(mask)
    assert np.array_equal(part.means, whole.means[mask])
    assert np.array_equal(part.sh, whole.sh[mask, :1])
    assert np.array_equal(unread.load().sh, whole.sh)
