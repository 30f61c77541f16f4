import networkx
import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.structure import bridges


def test_bridges_are_networkx_bridges():
    rng = np.random.default_rng(0)
    for _ in range(100):
        n, e = int(rng.integers(2, 30)), int(rng.integers(1, 45))
        a = rng.integers(0, n, e)
        b = (a + rng.integers(1, n, e)) % n
        accepted = rng.random(e) < 0.8
        ids, flags, unknown = tuple(map(str, range(n))), np.zeros(e, dtype=bool), np.full(e, np.nan)
        information = np.tile(np.eye(6), (e, 1, 1))
        m = Measurements(
            ids, a, b, Similarities.identity(e), information, flags, unknown, unknown, flags, unknown, flags
        )
        graph = networkx.MultiGraph()
        graph.add_edges_from([(x, y) for x, y, k in zip(a, b, accepted, strict=True) if k])
        found = {frozenset(pair) for pair in networkx.bridges(networkx.Graph(graph))}
        want = [
            k and frozenset((x, y)) in found and graph.number_of_edges(x, y) == 1
            for x, y, k in zip(a, b, accepted, strict=True)
        ]
        assert bridges(m, accepted).tolist() == want
