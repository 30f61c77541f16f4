"""What names an answer, what it says of itself, and what is built upon it."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import PLACING, STIFF, city, information, poses_at, true_edges

from gsmap.errors import ConfigError
from gsmap.optimize import Params, optimize, recipe_key
from gsmap.optimize.recipe import VERSIONS
from gsmap.settings import changed, leaves
from gsmap.types import Edge, Sim3
from gsmap.types.plain import plain


@pytest.mark.parametrize("leaf", list(leaves(Params())), ids=lambda leaf: leaf.name)
def test_every_setting_is_documented_and_part_of_the_key(leaf):
    assert leaf.meaning
    other = not leaf.value if isinstance(leaf.value, bool) else leaf.value + 1 if isinstance(leaf.value, int) else None
    other = 0.99 * leaf.value if other is None else other
    assert recipe_key(changed(Params(), {leaf.name: other})).recipe != recipe_key(Params()).recipe


def test_the_key_names_versions_and_the_solver(monkeypatch):
    key = recipe_key(Params())
    assert (key.stage, key.method, key.inputs) == ("optimize", "pose_graph", ())
    assert key.version == VERSIONS
    assert key.backend.startswith("gtsam ")
    monkeypatch.setitem(VERSIONS, "optimize", VERSIONS["optimize"] + 1)
    assert recipe_key(Params()).recipe != key.recipe


@pytest.mark.parametrize(
    "values",
    [
        {"min_wrong_probability": 1.5},
        {"min_bridge_edges": 0},
        {"max_unchanged_sigmas": -1.0},
        {"max_tilt_deg": -1.0},
        {"min_large_component": 0},
        {"max_look_alike": 1.0},
        {"same_visit_h": -1.0},
        {"max_growth": -0.1},
    ],
)
def test_odd_settings_are_refused(values):
    with pytest.raises(ConfigError):
        changed(Params(), values)


def test_settings_and_keys_load_no_solver():
    code = "import sys; from gsmap.optimize import Params, recipe_key; recipe_key(Params()); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"gtsam", "networkx", "torch"} & set(loaded)


def test_an_answer_tells_its_recipe_and_is_built_upon_by_that_recipe_only():
    world = city(60, 0.0, seed=1)
    old = [e for e in world.edges if world.ids[59] not in (e.target, e.source)]
    before = optimize(world.ids[:59], old, params=PLACING)
    assert before.settings == plain(PLACING)
    assert before.provenance.recipe == recipe_key(PLACING).recipe

    def method(previous, params):
        return optimize(world.ids, world.edges, previous=previous, params=params).provenance.method

    assert method(before, PLACING) == "incremental"
    assert method(before, replace(PLACING, gate_probability=0.99)) == "batch"
    unknown = replace(before, provenance=replace(before.provenance, recipe=""))
    assert method(unknown, PLACING) == "batch"


def test_missing_covariances_are_noted():
    world = city(40, 0.0, seed=1)
    assert optimize(world.ids, world.edges).notes == ()
    assert optimize(world.ids, world.edges, params=Params(marginals=False)).notes == ()
    few = replace(PLACING, max_marginal_scenes=10)
    answer = optimize(world.ids, world.edges, params=few)
    large = [p.component for p in answer.poses.values()].count(0)
    assert answer.poses[world.ids[0]].covariance is None
    assert answer.notes[0].startswith(f"no covariances in component 0 ({large} scenes)")
    assert "marginal_scenes" in answer.notes[0]
    more = optimize([*world.ids, "new"], [*world.edges, *attached(world)], previous=answer, params=few)
    assert more.provenance.method == "incremental"
    assert more.notes[: len(answer.notes)] == answer.notes
    assert "scene new is relative to its neighbours" in more.notes[-1]


def attached(world):
    """Edges from three neighbours to a new scene, which lies where the first scene does."""
    near = np.argsort(np.linalg.norm(world.truth.translations - world.truth.translations[0], axis=1))[:3]
    edges = true_edges(world.truth, [[k, 0] for k in near[1:]], np.random.default_rng(3), world.ids)
    here = Edge(world.ids[0], "new", Sim3.identity(), information())
    return [here, *(replace(e, source="new") for e in edges)]


def test_covariances_that_cannot_be_computed_are_noted():
    """Scales of many powers of ten: gtsam finds the system singular."""
    truth = poses_at(np.arange(3)[:, None] * [3.0, 1, 0])
    edges = [
        replace(e, S_target_source=replace(e.S_target_source, scale=scale), information=np.diag([1e-9] * 6 + [STIFF]))
        for e, scale in zip(
            true_edges(truth, [[0, 1], [1, 2]], np.random.default_rng(0), list("abc")), (1e-9, 1e-9), strict=True
        )
    ]
    answer = optimize(list("abc"), [replace(e, confirmed=True) for e in edges])
    assert all(np.isfinite(p.S_map_scene.translation).all() for p in answer.poses.values())
    assert all(p.covariance is None for p in answer.poses.values())
    assert answer.notes[0].startswith("no covariances in component 0 (3 scenes): Indeterminate")
