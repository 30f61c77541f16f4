"""The native maximum clique against networkx and planted answers."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises

from gsmap.errors import InputError
from gsmap.register.clique import maximum_clique
from gsmap.register.consistency import consistency_graph, pack, unpack
from gsmap.register.correspondences import Correspondences


def _random_graph(n: int, density: float, seed: int) -> np.ndarray:
    upper = np.triu(np.random.default_rng(seed).random((n, n)) < density, 1)
    return upper | upper.T


def _is_clique(adjacency: np.ndarray, members: np.ndarray) -> bool:
    return bool(adjacency[np.ix_(members, members)].sum() == len(members) * (len(members) - 1))


@settings(max_examples=150, deadline=None)
@given(n=st.integers(1, 75), density=st.floats(0, 0.7), seed=st.integers(0, 2**31))
def test_agrees_with_networkx(n, density, seed):
    adjacency = _random_graph(n, density, seed)
    clique = maximum_clique(pack(adjacency), step_limit=10**12)
    expected = max(len(c) for c in nx.find_cliques(nx.from_numpy_array(adjacency)))
    assert clique.exact
    assert len(clique) == expected
    assert _is_clique(adjacency, clique.members)


@pytest.mark.parametrize("n", [63, 64, 65, 128, 129])
def test_word_boundaries(n):
    full = ~np.eye(n, dtype=bool)
    assert len(maximum_clique(pack(full))) == n
    full[0, n - 1] = full[n - 1, 0] = False
    assert len(maximum_clique(pack(full))) == n - 1


def test_finds_a_planted_clique_in_a_large_graph():
    n, size = 3000, 30
    adjacency = _random_graph(n, 0.05, 3)
    members = np.random.default_rng(4).choice(n, size, replace=False)
    adjacency[np.ix_(members, members)] = True
    np.fill_diagonal(adjacency, False)
    clique = maximum_clique(pack(adjacency))
    assert clique.exact
    assert clique.members.tolist() == sorted(members.tolist())


def test_only_cliques_of_more_than_so_many_members_count():
    adjacency = _random_graph(120, 0.3, 7)
    size = len(maximum_clique(pack(adjacency)))
    for more_than in (1, size - 1):
        clique = maximum_clique(pack(adjacency), more_than=more_than)
        assert len(clique) == size
        assert _is_clique(adjacency, clique.members)
    none = maximum_clique(pack(adjacency), more_than=size)
    assert len(none) == 0
    assert none.exact


@pytest.mark.parametrize("room_m", [(20, 15, 3), (4, 4, 2)])
def test_work_on_500_nodes_and_6000_correspondences_is_bounded(room_m):
    rng = np.random.default_rng(0)
    nodes, shared = 500, 200
    target, source = (rng.uniform(0, 1, (nodes, 3)) * room_m for _ in range(2))
    source[:shared] = target[:shared] + rng.normal(size=(shared, 3)) * 0.02
    rows_t, rows_s = (np.r_[np.arange(shared), rng.integers(0, nodes, 6000 - shared)] for _ in range(2))
    matches = Correspondences(
        target[rows_t], source[rows_s], rows_t.astype(np.int32), rows_s.astype(np.int32), np.ones(6000, np.float32)
    )
    limit = 20_000_000
    clique = maximum_clique(consistency_graph(matches), limit)
    assert clique.steps < 1.1 * limit
    assert clique.exact == (clique.steps <= limit)
    assert np.isin(np.arange(shared), clique.members).mean() > 0.7


def test_limit_gives_a_clique_that_is_not_called_exact():
    adjacency = _random_graph(300, 0.9, 5)
    clique = maximum_clique(pack(adjacency), step_limit=10**5)
    assert not clique.exact
    assert len(clique) > 20
    assert _is_clique(adjacency, clique.members)
    again = maximum_clique(pack(adjacency), step_limit=10**5)
    assert clique.members.tolist() == again.members.tolist()


def test_empty_edgeless_and_malformed_graphs():
    assert len(maximum_clique(np.zeros((0, 0), np.uint64))) == 0
    assert len(maximum_clique(np.zeros((5, 1), np.uint64))) == 1
    with raises(InputError, code="shape_mismatch", match=r"\(100, 1\) uint64"):
        maximum_clique(np.zeros((100, 1), np.uint64))
    with raises(InputError, code="shape_mismatch", match=r"\(5, 1\) int32"):
        maximum_clique(np.zeros((5, 1), np.int32))


def test_self_loops_are_ignored():
    adjacency = np.eye(10, dtype=bool)
    assert len(maximum_clique(pack(adjacency))) == 1


def test_pack_round_trip():
    adjacency = _random_graph(70, 0.3, 6)
    assert np.array_equal(unpack(pack(adjacency)), adjacency)
