"""Steps of the solver that large maps, maps of unknown scale and bridges need, against direct computation."""

from __future__ import annotations

import networkx
import numpy as np
import pytest
from made_worlds import poses_at

from gsmap.geometry.similarities import Similarities
from gsmap.optimize import Params, blocks, drift
from gsmap.optimize.blocks import BlockSystem
from gsmap.optimize.component_growth import cut_weak_bridges
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.measurements import Measurements, measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import chordal
from gsmap.optimize.state import State
from gsmap.types import Edge, Sim3


@pytest.mark.guards("answers")
@pytest.mark.parametrize("max_fill", [500_000, 0])
def test_both_ways_to_solve_minimize_the_residuals(monkeypatch: pytest.MonkeyPatch, max_fill: int) -> None:
    """Against the dense problem; without fill-in allowed, by conjugate gradients."""
    monkeypatch.setattr(blocks, "_MAX_FILL_BLOCKS", max_fill)
    rng = np.random.default_rng(0)
    n, d, e = 8, 3, 20
    targets = rng.integers(0, n, e)
    sources = (targets + rng.integers(1, n, e)) % n
    fixed = np.zeros(n, dtype=bool)
    fixed[[2, 5]] = True
    A, B, r = rng.normal(size=(e, d, d)), rng.normal(size=(e, d, d)), rng.normal(size=(e, d, 2))
    root = rng.normal(size=(e, d, d)) + 3 * np.eye(d)
    W = root.transpose(0, 2, 1) @ root
    J = np.zeros((e, d, n, d))
    J[np.arange(e), :, targets] += root @ A
    J[np.arange(e), :, sources] += root @ B
    free = J[:, :, ~fixed].reshape(e * d, -1)
    wanted = np.zeros((n, d, 2))
    wanted[~fixed] = np.linalg.lstsq(free, -(root @ r).reshape(e * d, 2))[0].reshape(-1, d, 2)
    found = BlockSystem(targets, sources, fixed, d).solve(A, B, W, r)
    np.testing.assert_allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.guards("answers")
def test_poses_of_unknown_scale_follow_from_exact_edges() -> None:
    """Scenes in units of their own: the first keeps its pose, and the edges give all the others."""
    rng = np.random.default_rng(1)
    base = poses_at(rng.normal(0, 5, (6, 3)), 1)
    truth = Similarities(base.rotations, base.translations, rng.normal(0, 0.5, 6))
    pairs = [(0, 1), (2, 1), (2, 3), (3, 4), (4, 0), (1, 4), (5, 2), (5, 0)]
    weights = [np.diag(rng.uniform(1, 9, 7)) for _ in pairs]
    edges = [
        Edge(f"s{a}", f"s{b}", truth.item(a).inverse() @ truth.item(b), W)
        for (a, b), W in zip(pairs, weights, strict=True)
    ]
    m = measurements([f"s{k}" for k in range(6)], edges, rigid=False)
    start = poses_at(np.zeros((6, 3)), 9).replaced(np.array([0]), truth[np.array([0])])
    found = chordal(m, np.arange(6) == 0, start)
    np.testing.assert_allclose(found.log_scales, truth.log_scales, atol=1e-9)
    np.testing.assert_allclose(found.translations, truth.translations, atol=1e-8)
    np.testing.assert_allclose(found.rotations, truth.rotations, atol=1e-8)


@pytest.mark.guards("answers")
def test_edges_of_scenes_with_other_units_count_by_their_sigmas_in_the_map() -> None:
    """Sigmas are in the unit of an edge's source: two edges that contradict each other meet at their weighted mean."""
    scale, sigma, apart = 4.0, 0.1, np.array([1.0, -2.0, 0.5])
    known, places = Similarities.identity(3), np.array([[0.0, 0, 0], [10.0, 0, 0]])
    known = Similarities(known.rotations, np.vstack([places, np.zeros((1, 3))]), np.log([1.0, 1.0, scale]))
    at = Sim3(np.eye(3), np.array([4.0, 5.0, 6.0]), scale)
    information = np.diag([1e4] * 3 + [sigma**-2] * 3 + [1e6])
    edges = [
        Edge("s0", "s2", known.item(0).inverse() @ at, information),
        Edge("s2", "s1", Sim3(at.rotation, at.translation + apart, scale).inverse() @ known.item(1), information),
    ]
    m = measurements(["s0", "s1", "s2"], edges, rigid=False)
    found = chordal(m, np.arange(3) < 2, known)
    weights = np.array([(sigma * scale) ** -2, sigma**-2])  # the sources are s2, four times as large, and s1
    np.testing.assert_allclose(found.translations[2], at.translation + apart * weights[1] / weights.sum(), atol=1e-9)


def graph_of(pairs: list[tuple[int, int]], count: int, confirmed: tuple[int, ...] = ()) -> Measurements:
    truth = poses_at(np.arange(count)[:, None] * [3.0, 0, 0])
    edges = [
        Edge(f"s{a:02}", f"s{b:02}", truth.item(a).inverse() @ truth.item(b), np.eye(7), confirmed=k in confirmed)
        for k, (a, b) in enumerate(pairs)
    ]
    return measurements([f"s{k:02}" for k in range(count)], edges)


def clique(*scenes: int) -> list[tuple[int, int]]:
    return [(a, b) for a in scenes for b in scenes if a < b]


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("pairs", "cut", "confirmed"),
    [
        ([*clique(0, 1, 2), *clique(3, 4, 5), (2, 3)], [6], ()),
        ([*clique(0, 1, 2), *clique(3, 4, 5), (2, 3)], [], (6,)),  # a person said so
        ([*clique(0, 1, 2), *clique(3, 4, 5), (2, 3), (0, 4)], [], ()),  # two edges
        ([*clique(0, 1, 2), (2, 3), (3, 4)], [], ()),  # only scenes hang on it
        ([*clique(0, 1, 2), (2, 6), (6, 3), *clique(3, 4, 5)], [3, 4], ()),  # a scene between two
        ([*clique(3, 4, 5), (5, 0), (0, 1), (1, 2), (0, 6), *clique(6, 7, 8)], [3, 6], ()),  # not the branch of scenes
        ([*clique(0, 1, 2), (2, 3), *clique(3, 4, 5), (5, 6), *clique(6, 7, 8)], [3, 7], ()),
    ],
)
def test_a_single_edge_between_two_large_components_is_cut(
    pairs: list[tuple[int, int]], cut: list[int], confirmed: tuple[int, ...]
) -> None:
    count = 1 + max(map(max, pairs))
    m = graph_of(pairs, count, confirmed)
    terms = PriorTerms.stack((), ())
    state = State.fresh(m, poses_at(np.zeros((count, 3))), np.ones(len(m), dtype=bool), terms)
    cut_weak_bridges(m, state, Params(min_large_component=3))
    assert np.flatnonzero(~state.accepted).tolist() == cut


def test_lengths_of_paths_are_exact_in_small_maps_and_bounded_in_large_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    pairs = [(k, k + 1) for k in range(11)] + [(0, 5), (3, 9)]
    m = graph_of(pairs, 12)
    model = DriftModel.over(m, np.arange(len(m)), poses_at(np.arange(12)[:, None] * [3.0, 0, 0]))
    a, b = rng.integers(0, 12, (2, 40))
    b[0] = a[0]
    graph = networkx.Graph(pairs)
    exact = [networkx.shortest_path_length(graph, x, y) for x, y in zip(a.tolist(), b.tolist(), strict=True)]
    through_first = [networkx.shortest_path_length(graph, 0, x) for x in range(12)]
    assert model.hops(a, b).tolist() == exact
    monkeypatch.setattr(drift, "_MAX_EXACT_HOPS", 0)
    bound = np.take(through_first, a) + np.take(through_first, b)
    guessed = np.minimum(2 + 1.5 * np.abs(a - b) * 3.0 / np.median(3.0 * np.abs(np.diff(pairs))), bound)
    np.testing.assert_allclose(model.hops(a, b), np.where(a == b, 0, guessed))
