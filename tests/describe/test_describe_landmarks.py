"""Landmarks: the same place gives the same nodes, whatever its frame, unit and lighting."""

import hashlib
import json

import numpy as np
import pytest
from describe_places import moved, room
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsmap.describe import Params, describe, recipe_key
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.describe.landmarks import layer as landmarks
from gsmap.describe.landmarks.context import METRICS, NUM_RINGS, NUM_SHELLS, embed, metric, metric_digest
from gsmap.describe.landmarks.layer import landmark_layer
from gsmap.describe.unit import LEVEL_STEP, LEVELS, estimate_unit_m
from gsmap.geometry.sh import rgb_of_sh0, sh0_of_rgb
from gsmap.register.correspondences import match_nodes
from gsmap.types import Cameras, Gaussians, NodeLayer, Sim3

LANDMARKS = Params(objects=False)


def counterparts(a: NodeLayer, b: NodeLayer, S_a_b: Sim3, within: float) -> float:
    """Share of a's nodes with a node of b of the same type within a distance (a's unit)."""
    far = np.c_[S_a_b.apply(b.positions), b.types * 1e3]
    return float((cKDTree(far).query(np.c_[a.positions, a.types * 1e3])[0] < within).mean())


def recall(a: NodeLayer, b: NodeLayer, S_a_b: Sim3, within: float) -> float:
    """Share of a's nodes with a counterpart whose most similar node of that type is one."""
    mapped = S_a_b.apply(b.positions)
    similar = a.embeddings @ b.embeddings.T
    near = np.linalg.norm(a.positions[:, None] - mapped[None], axis=2) < within
    same = a.types[:, None] == b.types[None]
    has = (near & same).any(1)
    best = np.where(same, similar, -2).argmax(1)
    return float(near[np.arange(len(a)), best][has].mean())


def test_landmarks_follow_the_scene_into_any_frame_and_unit():
    gaussians, cameras = room()
    one = describe("one", gaussians, cameras, LANDMARKS, scale_policy="unknown")
    S = Sim3(Rotation.random(random_state=3).as_matrix(), np.array([30.0, -7, 12]), 2.7)
    two = describe("two", *moved(gaussians, cameras, S), LANDMARKS, scale_policy="unknown")
    assert two.up @ (S.rotation @ one.up) > np.cos(np.radians(0.5))
    assert two.unit_m == pytest.approx(one.unit_m / 2.7, rel=1e-3)
    a, b = one.layers["landmarks:1"], two.layers["landmarks:1"]
    assert len(a) > 60
    assert counterparts(a, b, S.inverse(), 0.1) > 0.75
    assert recall(a, b, S.inverse(), 0.1) > 0.85


def test_two_samplings_of_one_room_share_landmarks_and_one_is_not_another_room():
    one = describe("one", *room(1), LANDMARKS, scale_policy="known").layers["landmarks"]
    two = describe("two", *room(2), LANDMARKS, scale_policy="known").layers["landmarks"]
    assert counterparts(one, two, Sim3.identity(), 0.1) > 0.6
    turned = Sim3(Rotation.from_euler("z", 73, degrees=True).as_matrix(), np.array([1.0, -2, 0]))
    assert counterparts(one, two, turned, 0.1) < 0.15


def test_another_white_balance_leaves_landmarks_alike():
    """Two samplings of one room under a warm and a cold light: the candidates of registration stay the right ones."""
    layers = []
    for seed, light in ((1, [1.3, 1.0, 0.7]), (2, [0.75, 1.0, 1.25])):
        g, cameras = room(seed)
        rgb = np.clip(rgb_of_sh0(g.sh), 0, 1)
        lit = Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, sh0_of_rgb(light * rgb))
        layers.append(describe("room", lit, cameras, LANDMARKS, scale_policy="known").layers["landmarks"])
    found = match_nodes(*layers)
    right = np.linalg.norm(found.target - found.source, axis=1) < 0.1
    assert right.sum() > 90
    assert right.mean() > 0.3


def test_floaters_of_any_colour_do_not_hide_the_landmarks():
    layers = []
    for seed in (1, 2):
        g, cameras = room(seed)
        rng = np.random.default_rng(seed)
        n = len(g) // 3
        stray = Gaussians(
            rng.uniform([0, 0, 0], [6, 5, 2.5], (n, 3)),
            np.tile([1.0, 0, 0, 0], (n, 1)),
            np.full((n, 3), np.log(0.02)),
            rng.uniform(-2, 2, n),
            rng.uniform(-1.5, 1.5, (n, 1, 3)),
        )
        both = Gaussians.concatenate([g, stray])
        layers.append(describe("room", both, cameras, LANDMARKS, scale_policy="known").layers["landmarks"])
    found = match_nodes(*layers)
    right = np.linalg.norm(found.target - found.source, axis=1) < 0.1
    assert right.sum() > 70


def test_a_scene_that_knows_up_still_matches_one_that_does_not():
    graph = describe("upright", *room(1), LANDMARKS, scale_policy="known")
    R = Rotation.random(random_state=5).as_matrix()
    turned, _ = moved(*room(2), Sim3(R, np.zeros(3)))
    other = landmark_layer(surface_cloud(turned), None, 1.0)
    assert other.descriptor_id != graph.layers["landmarks"].descriptor_id
    assert other.descriptor_id == graph.layers["landmarks_gravity_free"].descriptor_id
    found = match_nodes(graph.layers["landmarks_gravity_free"], other)
    right = np.linalg.norm(found.target @ R.T - found.source, axis=1) < 0.1
    assert right.sum() > 60
    unknown = describe("upright", *room(1), LANDMARKS, scale_policy="unknown")
    assert unknown.layers["landmarks_gravity_free:1"].unit_m == unknown.layers["landmarks:1"].unit_m


def test_any_two_units_have_a_pair_of_levels_within_20_percent():
    units = LEVEL_STEP ** np.array(LEVELS, float)
    for error in np.geomspace(1 / 3.6, 3.6, 101):
        ratio = (units[:, None] * error) / units[None]
        assert np.exp(np.abs(np.log(ratio))).min() < LEVEL_STEP**0.5 + 1e-9


def test_up_is_found_with_and_without_cameras():
    gaussians, cameras = room(n=10000)
    R = Rotation.random(random_state=1).as_matrix()
    gaussians, cameras = moved(gaussians, cameras, Sim3(R, np.zeros(3)))
    points = surface_cloud(gaussians).points
    for given in (cameras, None):
        up = estimate_up(points, given)
        assert np.degrees(np.arccos(up @ R[:, 2])) < 0.5
    # Cameras that all look down by 30 degrees and never turn: planes must find what the images cannot say.
    poses = np.tile(np.eye(4), (5, 1, 1))
    right, forward = np.array([0.0, -1, 0]), np.array([np.cos(0.52), 0, -np.sin(0.52)])
    poses[:, :3, :3] = R @ np.stack([right, np.cross(forward, right), forward], 1)
    up = estimate_up(points, Cameras(poses, np.tile([200.0, 200, 160, 120], (5, 1)), np.tile([320, 240], (5, 1))))
    assert np.degrees(np.arccos(up @ R[:, 2])) < 0.5


def test_a_ball_without_cameras_has_no_up_and_says_so():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(5000, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    rgb = np.where(np.sin(9 * p).prod(1, keepdims=True) > 0.2, 0.4, -0.4) * [1, 0.5, -1]
    ball = Gaussians(p, np.tile([1.0, 0, 0, 0], (5000, 1)), np.full((5000, 3), -4.0), np.full(5000, 3.0), rgb[:, None])
    graph = describe("ball", ball, None, LANDMARKS, scale_policy="known")
    assert graph.up is None
    assert any("the vertical is unknown" in note for note in graph.notes)
    # Its landmarks are found all the same, compare in any frame, and never with those of upright scenes.
    S = Sim3(Rotation.random(random_state=2).as_matrix(), np.array([1.0, 2, 3]))
    turned, _ = moved(ball, room(n=100)[1], S)
    one, two = (describe("x", g, None, LANDMARKS, scale_policy="known").layers["landmarks"] for g in (ball, turned))
    assert len(one) > 20
    assert counterparts(one, two, S.inverse(), 0.1) > 0.7
    assert one.descriptor_id != landmarks.descriptor_id(landmarks.Params())


@pytest.mark.parametrize("shape", ["line", "point", "two points", "plane", "far away"])
def test_degenerate_scenes_are_described_without_a_fuss(shape):
    rng, n = np.random.default_rng(0), 1500
    p = {
        "line": np.linspace(0, 5, n)[:, None] * [1, 0.5, 0.2],
        "point": np.ones((n, 3)),
        "two points": np.repeat([[0.0, 0, 0], [1, 1, 1]], n // 2, 0),
        "plane": rng.uniform(0, 5, (n, 3)) * [1, 1, 0],
        "far away": rng.uniform(0, 5, (n, 3)) + 1e6,
    }[shape]
    m = len(p)
    sh = rng.uniform(-1, 1, (m, 1, 3))
    g = Gaussians(p, np.tile([1.0, 0, 0, 0], (m, 1)), np.full((m, 3), -3.5), np.full(m, 3.0), sh)
    for cameras in (room(n=100)[1], None):
        graph = describe(shape, g, cameras)
        assert all(np.isfinite(layer.positions).all() for layer in graph.layers.values())


@pytest.mark.parametrize("n", [0, 1, 5])
def test_next_to_nothing_is_described_honestly(n):
    g = Gaussians(np.ones((n, 3)), np.ones((n, 4)), np.full((n, 3), -3.0), np.full(n, 2.0), np.zeros((n, 1, 3)))
    graph = describe("tiny", g, room()[1])
    assert graph.num_nodes == 0
    assert graph.notes


def test_transparent_scene_is_empty_with_a_note():
    g, cameras = room(n=2000)
    g = Gaussians(g.means, g.quats, g.log_scales, np.full(len(g), -6.0), g.sh)
    graph = describe("clear", g, cameras)
    assert graph.num_nodes == 0
    full = describe("full", *room(n=2000), LANDMARKS, scale_policy="known").layers["landmarks"]
    assert graph.layers["landmarks"].embeddings.shape[1] == full.embeddings.shape[1]
    assert "no opaque Gaussians" in graph.notes[0]


def test_unit_scales_inversely_with_the_scene():
    gaussians, cameras = room()
    S = Sim3(np.eye(3), np.zeros(3), 0.2)
    points = surface_cloud(gaussians).points
    _, cameras_small = moved(gaussians, cameras, S)
    for with_cameras in (True, False):
        one = estimate_unit_m(points, cameras if with_cameras else None, np.array([0, 0, 1.0]))
        two = estimate_unit_m(points * 0.2, cameras_small if with_cameras else None, np.array([0, 0, 1.0]))
        assert two == pytest.approx(5 * one, rel=1e-3)
        assert 0.5 < one < 2


@pytest.mark.slow
def test_house_landmarks_repeat(shared_data):
    """Floors of the recipe's repeatability on two real, separately trained captures."""
    from gsmap import formats

    layers, truth = {}, {}
    for name in ("c0", "c1"):
        gaussians = formats.read(shared_data / "house" / f"{name}.ply")
        cameras = formats.read_cameras(shared_data / "house" / f"{name}.cameras.json")
        layers[name] = describe(name, gaussians, cameras, LANDMARKS, scale_policy="known").layers["landmarks"]
        record = json.loads((shared_data / "house" / "truth" / f"{name}.json").read_text())
        truth[name] = Sim3.from_matrix(np.array(record["T_scene_world"]))
    S = truth["c0"] @ truth["c1"].inverse()
    assert recall(layers["c0"], layers["c1"], S, 0.15) > 0.7
    assert counterparts(layers["c0"], layers["c1"], S, 0.1) > 0.25


def test_the_fitted_metric_maps_embeddings():
    for bins in (NUM_RINGS, NUM_SHELLS):
        found = metric(4 * bins)
        assert found.shape == (4 * bins, 4 * bins)
        np.testing.assert_allclose(found, found.T, atol=1e-3)
        values = np.linalg.eigvalsh(found)
        assert 0.02 < values.min() < 0.6 * values.max()  # it tells directions apart, and forgets none
        around = np.random.default_rng(0).uniform(0, 1, (30, bins, 4))
        plain, fitted = (embed(around, on) for on in (False, True))
        moved = plain @ found
        np.testing.assert_allclose(fitted, moved / np.linalg.norm(moved, axis=1, keepdims=True), atol=1e-9)


def test_a_metric_that_is_fitted_anew_makes_other_graphs_that_compare_with_no_older_ones(monkeypatch):
    keys = {}
    for fitted in (False, True):
        params = landmarks.Params(use_fitted_metric=fitted)
        for digest in ("as shipped", "anew"):
            monkeypatch.setattr(landmarks, "metric_digest", lambda digest=digest: digest)
            keys[fitted, digest] = recipe_key(Params(landmark=params)).digest, landmarks.descriptor_id(params)
    assert keys[False, "as shipped"] == keys[False, "anew"]
    for of in (0, 1):
        assert len({key[of] for key in keys.values()}) == 3
    monkeypatch.undo()
    assert metric_digest() == hashlib.sha256(METRICS.read_bytes()).hexdigest()[:32]
