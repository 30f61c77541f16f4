"""What names a registration, what is said of a missing package, and which refiner is asked."""

import sys
from dataclasses import fields, is_dataclass, replace

import numpy as np
from register_worlds import splat_world

from gsmap.methods import MethodParams
from gsmap.register import Params, recipe, recipe_key, refinement, register_pair, verdict
from gsmap.register.proposers import graph
from gsmap.register.refiners import colored_icp, icp
from gsmap.settings import changed, field_docs, leaves
from gsmap.types import Proposal, Sim3


def test_the_key_names_all_that_takes_part_and_nothing_else():
    key = recipe_key()
    assert (key.stage, key.method) == ("register", "pair")
    assert set(key.version) == {
        "register",
        "prepare",
        "probability",
        "proposer.graph",
        "proposer.kiss_matcher",
        "refiner.colored_icp",
        "refiner.none",
    }
    assert set(key.settings["refiners"]) == {"colored_icp", "none"}
    assert key.backend.startswith("native kiss_matcher=")
    rigid_only = recipe_key(Params(refiner="gicp", fallback="never"))
    assert set(rigid_only.settings["refiners"]) == {"colored_icp", "gicp", "none"}  # colored_icp for unknown scales
    assert rigid_only.backend == "native"
    assert "fallback_proposer" not in rigid_only.settings


def test_settings_of_methods_that_are_not_asked_change_no_key():
    base = recipe_key().recipe
    unused = Params().refiners.with_params("icp", icp.Params(means=True))
    assert recipe_key(Params(refiners=unused)).recipe == base
    used = Params().refiners.with_params("colored_icp", colored_icp.Params(colour_weight=0.1))
    assert recipe_key(Params(refiners=used)).recipe != base


def test_every_setting_of_the_default_recipe_changes_its_key():
    base = recipe_key().recipe
    in_use = ("proposers.graph.", "proposers.kiss_matcher.", "refiners.colored_icp.")
    seen = 0
    for leaf in leaves(Params()):
        in_family = leaf.name.split(".")[0] in ("proposers", "refiners")
        other = _other(leaf.value)
        if other is None or (in_family and not leaf.name.startswith(in_use)):
            continue
        seen += 1
        assert recipe_key(changed(Params(), {leaf.name: other})).recipe != base, leaf.name
    assert seen >= 15


def _other(value):
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return 0.9 * value or 0.5
    if isinstance(value, tuple) and value and not isinstance(value[0], str):
        return (*value, value[-1])
    return None


def test_the_package_of_a_proposer_is_in_the_key(monkeypatch):
    with_it = recipe_key().recipe
    monkeypatch.setattr(recipe, "version", _not_found)
    assert "kiss_matcher=missing" in recipe_key().backend
    assert recipe_key().recipe != with_it


def _not_found(name):
    raise recipe.PackageNotFoundError(name)


def test_a_missing_package_is_said_in_the_notes(monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)
    world = splat_world(9, points=2000, nodes=3)
    found = register_pair(world.target, world.source)
    assert found.status == "no_match"
    assert len(found.notes) == 1
    assert "kiss_matcher is not installed" in found.notes[0]
    assert register_pair(world.target, world.source, Params(fallback="never")).notes == ()


def test_a_refiner_that_cannot_scale_gives_way_where_the_scale_is_sought():
    assert refinement.refiner_for("gicp", with_scale=False) == "gicp"
    assert refinement.refiner_for("gicp", with_scale=True) == "colored_icp"
    assert refinement.refiner_for("none", with_scale=True) == "none"


def test_without_refiners_the_pose_is_the_proposed_one():
    world = splat_world(0, points=15_000, policy="known")
    (proposed, *_) = graph.propose_by_kind(world.target.graph, world.source.graph, "landmarks")
    params = Params(coarse_refiner="none", refiner="none", fallback="never")
    found = register_pair(world.target, world.source, params)
    assert found.proposer == "graph:landmarks"
    assert found.S_target_source is not None
    assert np.allclose(found.S_target_source.matrix(), proposed.S_target_source.matrix())


def test_settings_are_few():
    known = {leaf.name for leaf in leaves(Params(), "register.")}
    assert known == {
        "register.coarse_refiner",
        "register.fallback",
        "register.fallback_proposer",
        "register.max_poses",
        "register.num_cameras",
        "register.polisher",
        "register.proposer",
        "register.proposers.graph.consistency.height_slope",
        "register.proposers.graph.consistency.test",
        "register.proposers.graph.context.hops",
        "register.proposers.graph.kinds",
        "register.proposers.graph.max_correspondences",
        "register.proposers.graph.step_limit",
        "register.proposers.kiss_matcher.voxel_m",
        "register.refiner",
        "register.refiners.colored_icp.colour_weight",
        "register.refiners.icp.means",
        "register.refiners.icp.radii_m",
        "register.verdict.max_free_space_violation",
        "register.verdict.max_log_nfa",
        "register.verdict.max_rotation_sigma_deg",
        "register.verdict.max_scale_sigma",
        "register.verdict.max_translation_sigma_m",
        "register.verdict.min_coinciding",
        "register.verdict.min_colour_correlation",
        "register.verdict.min_probability",
    }


def test_every_setting_is_explained():
    for leaf in leaves(Params()):
        assert leaf.meaning, leaf.name


def test_docs_cover_every_field_of_nested_params():
    def walk(node):
        if isinstance(node, MethodParams):
            for name in node:
                yield from walk(node[name])
        elif is_dataclass(node):
            yield type(node)
            for f in fields(node):
                yield from walk(getattr(node, f.name))

    for cls in set(walk(Params())):
        assert set(field_docs(cls)) >= {f.name for f in fields(cls)}, cls


def test_the_metre_of_a_pair_scales_its_covariance_and_nothing_else(monkeypatch):
    # The same captures, the source in decimetres: its translations are ten times as large, and so are their sigmas.
    world = splat_world(1, points=20_000, policy="unknown", with_cameras=False)
    tenfold = splat_world(1, points=20_000, policy="unknown", with_cameras=False, scale=0.1)
    monkeypatch.setattr(verdict, "PRESCREEN_LOG_NFA", np.inf)
    a, b = (register_pair(w.target, w.source) for w in (world, tenfold))
    assert (a.status, b.status) == ("accepted", "accepted")
    sigmas = [np.sqrt(np.diag(np.linalg.inv(r.information))) for r in (a, b)]
    ratio = sigmas[1] / sigmas[0]
    assert np.allclose(ratio[[0, 1, 2, 6]], 1.0, rtol=0.1)
    assert np.allclose(ratio[3:6], 10.0, rtol=0.1)
    assert isinstance(a.S_target_source, Sim3)


def test_not_significant_is_said_in_the_fields_words():
    world = splat_world(0, points=10_000, policy="known", with_cameras=False)
    bars = replace(Params().verdict, max_log_nfa=-1000.0)
    found = register_pair(world.target, world.source, Params(fallback="never", verdict=bars))
    assert found.status == "no_match"
    assert found.reason.startswith(
        f"not significant: log10 NFA is {found.evidence['log_nfa']:.1f}, must be < -1000.0 (not probable enough: "
        f"{found.evidence['probability']:.1%}, needs 90%: "
    )
    unsure = Proposal("graph:objects", Sim3.identity(), with_scale=False, num_inliers=9, log_nfa=-9.0, runner_up=0.9)
    assert "a rival clique has 90% of the best clique's size, allowed 70%" in verdict.not_significant(
        unsure, verdict.Params()
    )
    uncounted = replace(unsure, proposer="kiss_matcher", log_nfa=float("nan"))
    assert "proposer kiss_matcher does not compute the NFA" in verdict.not_significant(uncounted, verdict.Params())
