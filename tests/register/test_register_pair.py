"""Registering pairs end to end, on rooms made for the purpose: right poses accepted, everything else refused."""

from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from register_worlds import splat_world

from gsmap.errors import ConfigError
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities
from gsmap.register import Params, SceneView, refinement, register_pair, verdict
from gsmap.register import pair as pair_module
from gsmap.register.evidence import PoseEvidence
from gsmap.register.metric_scene import MetricScene
from gsmap.register.pose_selection import EvaluatedPose, select_pose
from gsmap.register.probability import probability
from gsmap.register.proposers import graph
from gsmap.types import Cameras, Gaussians, NodeLayer, Proposal, SceneGraph, Sim3


def _error(world, found):
    return pose_error(found.S_target_source, world.S_target_source, scene_centroid(world.source.gaussians))


def test_overlapping_captures_are_accepted_to_the_millimetre():
    world = splat_world(0)
    found = register_pair(world.target, world.source)
    assert (found.status, found.reason) == ("accepted", "")
    error = _error(world, found)
    assert error.rre_deg < 0.1
    assert error.centroid_m < 0.01
    assert found.S_target_source.is_rigid
    assert (found.target, found.source, found.proposer) == ("s0", "s1", "graph:landmarks")
    assert 0.1 < found.overlap < 0.8
    assert found.evidence["log_nfa"] < -10
    assert set(found.seconds) >= {"match", "refine", "verdict"}


def test_captures_trained_too_briefly_to_turn_opaque_still_register():
    world = splat_world(0)
    rng = np.random.default_rng(0)
    views = []
    for view in (world.target, world.source):
        opacities = rng.uniform(0.1, 0.45, len(view.gaussians))
        views.append(replace(view, gaussians=replace(view.gaussians, logit_opacities=-np.log(1 / opacities - 1))))
    found = register_pair(*views)
    assert found.status == "accepted"
    assert _error(world, found).centroid_m < 0.01


def test_a_scene_whose_vertical_is_unknown_registers_with_one_that_knows_it():
    world = splat_world(0, policy="known")
    layer = world.target.graph.layers["landmarks"]
    levelled = replace(layer, embeddings=layer.embeddings[::-1], descriptor_id="levelled")
    knows = replace(world.target.graph, layers={"landmarks": levelled, "landmarks_gravity_free": layer})
    target = replace(world.target, graph=knows)
    source = replace(world.source, graph=replace(world.source.graph, up=None))
    for pair in ((target, source), (source, target)):
        assert register_pair(*pair).status == "accepted"
    assert register_pair(target, world.source, Params(fallback="never")).status == "no_match"


def test_a_wrong_vertical_does_not_keep_scenes_apart():
    world = splat_world(0, policy="known")
    views = []
    for view, up in ((world.target, world.target.graph.up), (world.source, np.roll(world.source.graph.up, 1))):
        layer = view.graph.layers["landmarks"]
        levelled = replace(layer, embeddings=layer.embeddings[::-1])
        layers = {"landmarks": levelled, "landmarks_gravity_free": replace(layer, descriptor_id="free")}
        views.append(replace(view, graph=replace(view.graph, layers=layers, up=up)))
    found = register_pair(*views)
    assert found.status == "accepted"
    assert _error(world, found).centroid_m < 0.02


@pytest.mark.parametrize("which", ["few", "none"])
def test_cameras_that_do_not_see_the_overlap_are_helped_by_made_ones(which):
    world = splat_world(0)
    S, views = world.S_target_source, []
    for view, other in (
        (world.target, S.apply(world.source.centre)),
        (world.source, S.inverse().apply(world.target.centre)),
    ):
        # The two of the twelve that look away from the other half of the room the most.
        towards = view.cameras.T_frame_camera[:, :3, 2] @ (other - view.centre)
        few, made = view.cameras[np.argsort(towards)[:2]], synthesise_cameras(view.gaussians)
        views.append(replace(view, cameras=few if which == "few" else made))
    found, whole = register_pair(*views), register_pair(world.target, world.source)
    assert found.status == whole.status == "accepted"
    assert found.evidence["num_seen"] > 0.5 * whole.evidence["num_seen"]
    assert found.evidence["colour_correlation"] > 0.5
    assert found.evidence["free_space_violation"] < 0.08


@pytest.mark.parametrize("seed", range(2))
def test_made_cameras_accept_no_different_places(seed):
    world = splat_world(seed, place=(20 + seed, 40 + seed))
    views = [replace(view, cameras=synthesise_cameras(view.gaussians)) for view in (world.target, world.source)]
    assert register_pair(*views).status != "accepted"


def test_the_answer_is_the_same_both_ways_and_twice():
    world = splat_world(1)
    there, back = register_pair(world.target, world.source), register_pair(world.source, world.target)
    loop = there.S_target_source @ back.S_target_source
    moved = loop.apply(world.target.gaussians.means)
    assert np.abs(moved - world.target.gaussians.means).max() < 0.02
    again = register_pair(world.target, world.source)
    assert np.array_equal(again.S_target_source.matrix(), there.S_target_source.matrix())
    assert np.array_equal(again.information, there.information)


@pytest.mark.parametrize("scale", [0.27, 4.0])
def test_unknown_scale_is_found(scale):
    world = splat_world(2, scale=scale, policy="unknown")
    found = register_pair(world.target, world.source)
    assert found.status == "accepted"
    error = _error(world, found)
    assert error.rse < 0.005
    assert error.rre_deg < 0.2
    assert error.centroid_m < 0.02
    # The scale is measured, and known about as well as it is right.
    assert 1e-4 < np.sqrt(np.linalg.inv(found.information)[6, 6]) < 0.01


def test_the_scene_that_knows_its_scale_says_what_a_metre_is():
    world = splat_world(2, scale=0.27, policy="unknown")
    metric = world.target.graph
    layers = {"landmarks": replace(metric.layers["landmarks:0"], unit_m=1.0)}
    source = replace(world.target, graph=replace(metric, layers=layers, unit_m=1.0), scale_policy="known")
    answers = []
    for wrong in (1.0, 0.4):
        graph = replace(world.source.graph, unit_m=wrong * world.source.graph.unit_m)
        answers.append(register_pair(replace(world.source, graph=graph), source))
    assert [a.status for a in answers] == ["accepted", "accepted"]
    assert np.array_equal(answers[0].S_target_source.matrix(), answers[1].S_target_source.matrix())
    assert abs(answers[0].scale * 0.27 - 1) < 0.005


def test_auto_snaps_to_rigid_only_when_the_scale_is_one():
    rigid = register_pair(*_views(splat_world(3)))
    assert rigid.S_target_source.is_rigid
    assert 1e-5 < np.sqrt(np.linalg.inv(rigid.information)[6, 6]) < 1e-3  # as it was measured
    scaled = splat_world(3, scale=1.4)
    found = register_pair(*_views(scaled))
    assert found.status == "accepted"
    assert abs(found.scale / 1.4 - 1) < 0.005


@pytest.mark.parametrize("factor", [0.97, 1.005, 1.02, 1.03])
@pytest.mark.guards("answers")
def test_a_scale_near_one_is_measured_too(factor):
    world = splat_world(3, scale=factor)
    found = register_pair(*_views(world))
    assert found.status == "accepted"
    assert not found.S_target_source.is_rigid
    assert _error(world, found).rse < 0.002
    assert _error(world, found).centroid_m < 0.01
    off = (Similarities.stack([found.S_target_source]).inverse() @ Similarities.stack([world.S_target_source])).log()[0]
    assert off @ found.information @ off < 24.3  # a chi-square with 7 degrees of freedom, at 0.999
    assert found.evidence["log_scale"] == pytest.approx(np.log(found.scale), abs=1e-9)
    assert found.evidence["log_scale_sigma"] == pytest.approx(np.sqrt(np.linalg.inv(found.information)[6, 6]))
    assert found.notes == ()


def test_captures_said_to_be_in_metres_that_disagree_say_so():
    right, wrong = (register_pair(*_views(splat_world(3, scale=s, policy="known"))) for s in (1.0, 1.015))
    assert [found.status for found in (right, wrong)] == ["accepted", "accepted"]
    assert all(found.S_target_source.is_rigid for found in (right, wrong))
    assert right.notes == ()
    assert "differ in scale by +1.5" in wrong.notes[0]
    assert wrong.evidence["log_scale"] == pytest.approx(np.log(1.015), abs=0.001)
    assert np.sqrt(np.linalg.inv(wrong.information)[6, 6]) > 0.014


def _views(world):
    return world.target, world.source


def test_known_scale_never_scales():
    world = splat_world(4, scale=1.4, policy="known")
    assert register_pair(world.target, world.source).status != "accepted"


@pytest.mark.parametrize("seed", range(4))
def test_different_places_are_never_accepted(seed):
    world = splat_world(seed, place=(20 + seed, 40 + seed))
    found = register_pair(world.target, world.source)
    assert found.status != "accepted"
    assert found.reason


def test_look_alike_nodes_do_not_carry_a_pose_that_the_surfaces_contradict():
    # The source shows another room, but its graph is that of the target's: a significant clique, and a wrong one.
    right, other = splat_world(5), splat_world(5, place=(7, 8))
    source = replace(other.source, graph=right.source.graph)
    found = register_pair(right.target, source)
    assert found.evidence["log_nfa"] < -10
    assert found.status == "rejected"
    assert "colour" in found.reason or "free-space" in found.reason


def test_repainted_room_in_another_shape_is_contradicted_by_free_space():
    right = splat_world(6)
    g = right.source.gaussians
    # A wall of points of plausible colours across what the target's cameras saw as empty.
    inside = right.S_target_source.inverse()
    rng = np.random.default_rng(0)
    wall = np.c_[np.full(9000, 3.0), rng.uniform(0, 4, 9000), rng.uniform(0, 2.5, 9000)]
    extra = Gaussians(
        inside.apply(wall), np.tile([1.0, 0, 0, 0], (9000, 1)), np.full((9000, 3), np.log(0.02)), np.full(9000, 3.0),
        np.zeros((9000, 1, 3)),
    )  # fmt: skip
    found = register_pair(right.target, replace(right.source, gaussians=Gaussians.concatenate([g, extra])))
    assert found.evidence["free_space_violation"] > 0.15
    assert found.status == "rejected"


def test_without_cameras_the_rest_still_decides():
    world = splat_world(7, with_cameras=False)
    found = register_pair(world.target, world.source)
    assert found.status == "accepted"
    assert np.isnan(found.evidence["free_space_violation"])


def test_surfaces_propose_where_graphs_are_poor():
    world = splat_world(8, cut_m=(5.0, 1.0))
    few = {k: _first(layer, 4) for k, layer in world.target.graph.layers.items()}
    target = replace(world.target, graph=replace(world.target.graph, layers=few))
    found = register_pair(target, world.source)
    assert found.proposer == "kiss_matcher"
    assert found.status == "accepted"
    assert _error(world, found).rre_deg < 0.2
    assert "fallback" in found.seconds
    assert register_pair(target, world.source, Params(fallback="never")).status == "no_match"


def _first(layer: NodeLayer, n: int) -> NodeLayer:
    names = ("positions", "embeddings", "types", "weights", "extents", "features", "num_views")
    return NodeLayer(*(getattr(layer, k)[:n] for k in names), descriptor_id=layer.descriptor_id, unit_m=layer.unit_m)


def test_two_proposals_of_one_pose_are_not_ambiguous(monkeypatch):
    world = splat_world(13)
    centre = scene_centroid(world.source.gaussians)
    found = []
    # The second is too far off to be told for the first until it is refined; neither is sure enough to end the search.
    for degrees in (1.0, 4.5):
        turn = exp_so3(np.radians(degrees) * np.array([0.0, 0.6, 0.8]))
        S = world.S_target_source @ Sim3(turn, centre - turn @ centre)
        found.append(Proposal("graph:landmarks", S, with_scale=False, num_inliers=20, log_nfa=-1.0, runner_up=0.9))
    monkeypatch.setattr(graph, "propose", lambda *args, **kwargs: found)
    answer = register_pair(world.target, world.source, Params(fallback="never"))
    assert (answer.status, answer.reason) == ("accepted", "")
    assert _error(world, answer).rre_deg < 0.1


def _moved(S: Sim3, metres: float) -> Sim3:
    return Sim3(S.rotation, S.translation + np.array([metres, 0.0, 0.0]), S.scale)


def test_every_round_of_proposals_has_places_of_its_own(monkeypatch):
    """Three wrong rigid poses fill no place of a scaled one, as where two captures without metres are laid as if in
    metres first."""
    world = splat_world(3, scale=1.4)
    S = world.S_target_source

    def propose(target, source, params=None, *, with_scale=False):
        if with_scale:
            return [Proposal("graph:landmarks", S, True, 60, log_nfa=-60.0, runner_up=0.0)]
        wrong = (Sim3(S.rotation, _moved(S, k).translation) for k in (2.0, 4.0, 6.0, 8.0))
        return [Proposal("graph:landmarks", p, False, 10, log_nfa=-1.0, runner_up=0.9) for p in wrong]

    monkeypatch.setattr(graph, "propose", propose)
    found = register_pair(world.target, world.source, Params(fallback="never"))
    assert found.status == "accepted"
    assert _error(world, found).rse < 0.005
    assert _error(world, found).centroid_m < 0.02


@pytest.mark.parametrize("away_m", [0.0, 0.8])
def test_a_refined_pose_that_leaves_its_clique_is_not_judged_for_it(away_m, monkeypatch):
    """A refiner that slides by 80 cm, as along a front: what the clique proposed is judged, as it was proposed, and
    known as well as the clique knows it."""
    world = splat_world(0)
    refine = refinement._refine

    def slides(*args):
        return _moved(refine(*args), away_m)

    monkeypatch.setattr(refinement, "_refine", slides)
    found = register_pair(world.target, world.source)
    error = _error(world, found)
    assert found.status == "accepted"
    assert error.centroid_m < 0.03
    sigma = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(found.information)[3:6, 3:6])[-1])
    assert (sigma > 0.01) == (away_m > 0)
    off = (Similarities.stack([found.S_target_source]).inverse() @ Similarities.stack([world.S_target_source])).log()[0]
    assert off @ found.information @ off < 24.3  # a chi-square with 7 degrees of freedom, at 0.999


def test_a_refined_pose_that_leaves_correspondences_which_chance_explains_is_refused(monkeypatch):
    world = splat_world(0)
    refine, judge = refinement._refine, pair_module._evaluate
    monkeypatch.setattr(refinement, "_refine", lambda *args: _moved(refine(*args), 0.4))
    monkeypatch.setattr(pair_module, "_evaluate", lambda p, *args, **kw: judge(replace(p, log_nfa=-1.0), *args, **kw))
    found = register_pair(world.target, world.source, Params(fallback="never"))
    assert found.status != "accepted"


def test_false_alarms_are_those_of_the_pose_that_is_judged(monkeypatch):
    """A refiner that turns the pose by as much as leaves some of the clique: fewer agree, so chance explains more."""
    world = splat_world(0)
    found = register_pair(world.target, world.source)
    (best, *_) = graph.propose(*(MetricScene(view, 1.0) for view in (world.target, world.source)))
    assert found.evidence["log_nfa"] == best.support.count(found.S_target_source)[1]
    refine = refinement._refine
    monkeypatch.setattr(refinement, "_refine", lambda *args: _moved(refine(*args), 0.12))
    worse = register_pair(world.target, world.source)
    assert worse.evidence["log_nfa"] > found.evidence["log_nfa"] + 1


def test_a_rival_that_is_known_too_loosely_to_be_an_edge_is_a_rival():
    world = splat_world(0)
    evidence = PoseEvidence(0.4, 3000, 0.01, 2000, 0.7, 8.0, disagreement=0.01, seen_m2=30.0, num_judged=2000)
    best = EvaluatedPose(
        Proposal("graph", world.S_target_source, False, 60, log_nfa=-7.0, runner_up=0.9), evidence, np.eye(7), ""
    )
    moved = replace(best.proposal, S_target_source=_moved(world.S_target_source, 3.0))

    def status(rival: EvaluatedPose) -> tuple[str, float]:
        found = select_pose(world.target, world.source, [best, rival], Params(), seconds={})
        return found.status, found.evidence["probability"]

    found = select_pose(world.target, world.source, [best], Params(), seconds={}).evidence
    alone, one_place = found["probability"], 1 - found["look_alike"]
    loose = replace(best, proposal=moved, flaw="the overlap determines the pose only to 8 cm")
    assert status(loose) == ("no_match", pytest.approx(0.5, abs=0.01))
    near = replace(loose, proposal=_nearly(best.proposal))
    assert status(near) == ("accepted", pytest.approx(alone))
    contradicted = replace(loose, evidence=replace(evidence, colour_correlation=0.05))
    assert status(contradicted) == ("accepted", pytest.approx(alone))
    # At most one of both is right: odds of each against neither and against the other.
    weaker = replace(loose, evidence=replace(evidence, colour_correlation=0.16, overlap=0.05), flaw="not probable")
    odds = [p / (1 - p) for p in (alone / one_place, probability(moved, weaker.evidence, verdict.PRIOR))]
    assert odds[1] > 0.2
    assert status(weaker)[1] == pytest.approx(one_place * odds[0] / (1 + sum(odds)))


def _nearly(proposal: Proposal) -> Proposal:
    """The same pose, a centimetre off."""
    return replace(proposal, S_target_source=_moved(proposal.S_target_source, 0.01))


def test_scenes_with_nothing_in_them_do_not_match():
    world = splat_world(9, points=5000)
    empty = SceneView("e", Gaussians.empty(), None, SceneGraph("e"))
    bare = replace(world.source, graph=SceneGraph("s1"))
    faint = replace(world.source.gaussians, logit_opacities=np.full(len(world.source.gaussians), -6.0))
    for source in (empty, bare, replace(world.source, gaussians=faint)):
        for pair in ((world.target, source), (source, world.target)):
            found = register_pair(*pair)
            assert found.status in ("no_match", "rejected")
            assert found.reason
    one = replace(world.source.graph, layers={k: _first(v, 1) for k, v in world.source.graph.layers.items()})
    assert register_pair(world.target, replace(world.source, graph=one), Params(fallback="never")).status == "no_match"


def test_collinear_nodes_are_refused_with_that_reason():
    world = splat_world(10)
    layers = {}
    line = np.linspace(0, 5, 60)[:, None] * [1.0, 0.0, 0.0] + [0.0, 2.0, 0.5]
    for view, name in ((world.target, "t"), (world.source, "s")):
        move = Sim3.identity() if name == "t" else world.S_target_source.inverse()
        layers[name] = {}
        for k, v in view.graph.layers.items():
            known = world.target.graph.layers[k].embeddings[:60]
            layers[name][k] = replace(_first(v, 60), positions=move.apply(line), embeddings=known, types=np.zeros(60))
    target = replace(world.target, graph=replace(world.target.graph, layers=layers["t"]))
    source = replace(world.source, graph=replace(world.source.graph, layers=layers["s"]))
    found = register_pair(target, source, Params(fallback="never"))
    assert found.status in ("rejected", "no_match")
    assert "line" in found.reason


def test_cameras_inside_walls_do_no_harm():
    world = splat_world(11)
    cameras = world.target.cameras
    poses = cameras.T_frame_camera.copy()
    poses[:, :3, 3] = [0.0, 0.0, 0.0]  # a corner of the room
    buried = Cameras(poses, cameras.intrinsics_px, cameras.sizes_px)
    found = register_pair(replace(world.target, cameras=buried), world.source)
    assert found.status == "accepted"
    assert _error(world, found).centroid_m < 0.01


def test_options_that_do_not_exist_are_refused():
    with raises(ConfigError, code="unknown_method", match="refiner 'magic'"):
        Params(refiner="magic")
    with raises(ConfigError, code="invalid_choice", match="scale policy .*'maybe'"):
        replace(splat_world(0, points=1000).target, scale_policy="maybe")


def test_progress_rises_to_one():
    seen = []
    world = splat_world(12, points=20_000)
    register_pair(world.target, world.source, progress=lambda fraction, text: seen.append(fraction))
    assert seen[0] == 0.0
    assert seen[-1] == 1.0
    assert seen == sorted(seen)
