import numpy as np
import pytest
from made_worlds import STIFF, city, information, near_pairs, poses_at, true_edges, twin_wings

from gsmap.geometry import similarities
from gsmap.geometry.rotations import angle_between
from gsmap.geometry.similarities import Similarities
from gsmap.optimize import optimize
from gsmap.types import Edge, Prior, Sim3

INF = np.inf


@pytest.fixture
def world():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 15, (25, 3)) * [1, 1, 0.3] + [100, 200, 5]
    truth = poses_at(positions, 3)
    ids = [f"s{k}" for k in range(25)]
    return ids, truth, true_edges(truth, near_pairs(positions, 90, rng), rng, ids)


def error_m(answer, ids, truth):
    found = np.array([answer.poses[s].S_map_scene.translation for s in ids])
    return np.linalg.norm(found - truth.translations, axis=1)


@pytest.mark.guards("answers")
def test_an_anchor_sets_the_frame(world):
    ids, truth, edges = world
    anchor = Prior("s7", truth.item(7), np.r_[[1e-4] * 3, [1e-3] * 3, 1e-6])
    answer = optimize(ids, edges, [anchor])
    assert error_m(answer, ids, truth)[7] < 1e-3
    assert error_m(answer, ids, truth).max() < 0.6
    assert np.sqrt(np.diag(answer.poses["s7"].covariance))[3:6].max() < 2e-3


def test_positions_place_and_turn_the_map(world):
    ids, truth, edges = world
    rng = np.random.default_rng(1)
    gps = [
        Prior(s, Sim3(np.eye(3), truth.translations[k] + rng.normal(0, 0.05, 3)), np.r_[[INF] * 3, [0.05] * 3, INF])
        for k, s in enumerate(ids)
    ]
    answer = optimize(ids, edges, gps)
    assert error_m(answer, ids, truth).max() < 0.15
    alone = optimize(ids, edges)
    gained = np.trace(answer.poses["s20"].covariance) / np.trace(alone.poses["s20"].covariance)
    assert np.isfinite(gained)


def test_one_position_moves_the_map_and_leaves_its_heading(world):
    ids, truth, edges = world
    alone = optimize(ids, edges)
    gps = Prior("s3", Sim3(np.eye(3), truth.translations[3]), np.r_[[INF] * 3, [0.1] * 3, INF])
    answer = optimize(ids, edges, [gps])
    assert error_m(answer, ids, truth)[3] < 1e-3
    turned = [angle_between(answer.poses[s].S_map_scene.rotation, alone.poses[s].S_map_scene.rotation) for s in ids]
    assert max(turned) < 1e-3
    assert np.isfinite(answer.poses["s9"].covariance).all()


def test_gravity_levels_the_map(world):
    ids, truth, edges = world
    level = [Prior(s, Sim3.identity(), np.full(7, INF), up=truth.rotations[k][2]) for k, s in enumerate(ids[:5])]
    answer = optimize(ids, edges, level)
    ups = np.array([answer.poses[s].S_map_scene.rotation @ truth.rotations[k][2] for k, s in enumerate(ids)])
    assert np.degrees(np.arccos(np.clip(ups[:, 2], -1, 1))).max() < 2


def test_a_lone_scene_with_a_known_pose_is_where_it_is_known(world):
    _, truth, _ = world
    answer = optimize(["s0"], [], [Prior("s0", truth.item(0), np.r_[[0.01] * 3, [0.1] * 3, 0.01])])
    np.testing.assert_allclose(answer.poses["s0"].S_map_scene.matrix(), truth.item(0).matrix(), atol=1e-6)


def scaled_world(seed=0):
    """Scenes each in a unit of its own; all edges are similarities."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(0, 15, (25, 3)) * [1, 1, 0.3]
    truth = poses_at(positions, seed)
    truth = Similarities(truth.rotations, truth.translations, rng.uniform(-1, 1, 25))
    pairs = near_pairs(positions, 100, rng)
    ids = [f"s{k}" for k in range(25)]
    edges = []
    for a, b in pairs:
        unit = np.exp(truth.log_scales[b])
        noise = rng.normal(0, 1, (1, 7)) * ([0.01] * 3 + [0.05 / unit] * 3 + [0.01])
        measured = truth[[a]].inverse() @ truth[[b]] @ similarities.exp(noise)
        edges.append(Edge(ids[a], ids[b], measured.item(0), information(0.01, 0.05 / unit, 0.01)))
    return ids, truth, edges


def test_similarities_are_solved_up_to_one_scale():
    ids, truth, edges = scaled_world()
    rng = np.random.default_rng(1)
    for k in rng.permutation(len(edges))[:20]:
        e = edges[k]
        off = Sim3(
            poses_at(rng.normal(0, 5, (1, 3)), int(k)).rotations[0], rng.normal(0, 5, 3), float(rng.uniform(0.3, 3))
        )
        edges[k] = Edge(e.target, e.source, off, e.information)
    answer = optimize(ids, edges)
    found = Similarities.stack([answer.poses[s].S_map_scene for s in ids])
    lead = truth[[0]].inverse()
    want = (
        Similarities(*(np.repeat(x, 25, axis=0) for x in (lead.rotations, lead.translations, lead.log_scales))) @ truth
    )
    unit = np.exp(-truth.log_scales[0])
    assert np.abs(found.log_scales - want.log_scales).max() < 0.05
    assert np.linalg.norm(found.translations - want.translations, axis=1).max() < 0.8 * unit
    placed = [p for p in answer.poses.values() if p.status == "placed"]
    assert len(placed) == 25
    assert all(p.covariance[6, 6] > 0 for p in placed)


def test_scale_comes_from_the_scenes_where_it_is_known():
    ids, truth, edges = scaled_world()
    exact = Sim3(np.eye(3), np.zeros(3), float(np.exp(truth.log_scales[4])))
    answer = optimize(ids, edges, [Prior("s4", exact, np.r_[[INF] * 6, 1e-4])])
    found = Similarities.stack([answer.poses[s].S_map_scene for s in ids])
    assert np.abs(found.log_scales - truth.log_scales).max() < 0.05
    span = np.linalg.norm(np.ptp(found.translations, axis=0)) / np.linalg.norm(np.ptp(truth.translations, axis=0))
    assert 0.5 < span < 2


def test_a_rigid_edge_keeps_two_scales_equal():
    ids, truth, edges = scaled_world()
    truth.log_scales[5] = truth.log_scales[6]
    rigid = (truth[[5]].inverse() @ truth[[6]]).item(0)
    rigid = Sim3(rigid.rotation, rigid.translation)
    touching = [e for e in edges if not {e.target, e.source} & {"s5"}]
    again = [
        Edge("s5", f"s{k}", (truth[[5]].inverse() @ truth[[k]]).item(0), information(0.01, 0.05, 0.05))
        for k in (7, 8, 9)
    ]
    stiff = information(0.01, 0.05)
    assert stiff[6, 6] == STIFF
    answer = optimize(ids, [*touching, *again, Edge("s5", "s6", rigid, stiff)])
    a, b = (answer.poses[s].S_map_scene.scale for s in ("s5", "s6"))
    assert answer.use("s5", "s6") == "used"
    assert a == pytest.approx(b, rel=1e-4)


def test_position_priors_part_a_fold_that_edges_alone_support():
    """A wing reached only by look-alike edges, and positions that say it is elsewhere."""
    world = twin_wings(150, 0.06, seed=2)
    hall = 150 - 2 * 30
    through = [
        (int(e.target[1:]) < hall) != (int(e.source[1:]) < hall) and max(int(e.target[1:]), int(e.source[1:])) >= 120
        for e in world.edges
    ]
    edges = [e for e, cut in zip(world.edges, through, strict=True) if not cut]
    folded = optimize(world.ids, edges)
    assert folded.poses["s00149"].component == folded.poses["s00000"].component
    gps = [
        Prior(s, Sim3(np.eye(3), world.truth.translations[k]), np.r_[[INF] * 3, [0.5] * 3, INF])
        for k, s in enumerate(world.ids)
        if k % 3 == 0
    ]
    answer = optimize(world.ids, edges, gps)
    assert not [key for key in world.wrong_keys if answer.use(*key) == "used"]
    assert error_m(answer, world.ids, world.truth)[[k % 3 == 0 for k in range(150)]].max() < 1.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_wrong_position_is_outweighed(seed):
    """Another scene's position was noted; in the first world the four right ones nearly lie along a line."""
    world = city(100, 0.1, seed)

    def gps(k, off=0.0):
        position = world.truth.translations[k] + [off, 0, 0]
        return Prior(world.ids[k], Sim3(np.eye(3), position), np.r_[[INF] * 3, [0.5] * 3, INF])

    answer = optimize(world.ids, world.edges, [gps(3), gps(40), gps(77), gps(90), gps(60, off=25)])
    assert answer.provenance.contradicted_priors == (world.ids[60],)
    assert answer.poses[world.ids[60]].component == answer.poses[world.ids[3]].component
    assert error_m(answer, world.ids, world.truth)[[3, 40, 60, 77, 90]].max() < 0.5
