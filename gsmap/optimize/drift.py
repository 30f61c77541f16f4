"""Drift model: uncertainty of a pose predicted along a chain of edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.structure import component_labels, roots

# Limit of scenes times sources of exact shortest paths; beyond it distances give an estimate.
_MAX_EXACT_HOPS = 20_000_000


@dataclass(frozen=True, eq=False)
class DriftModel:
    """Uncertainty of the predicted relative pose of two scenes: a random walk along the accepted edges between them.

    After h edges with rotation variance sr^2, translation variance st^2 and length l, a walk has the variance h sr^2 in
    rotation and h st^2 + sr^2 l^2 h^3 / 3 in position (rotation errors act on ever longer levers). Parallel paths only
    reduce the error, so the model rather accepts than rejects edges.

    Assumes that the accepted edges are correct and their errors independent, and that all edges are like the median
    edge. A component with a wrong edge, or with edges that share a bias, drifts further.

    Args:
        graph: (N, N) adjacency matrix of the scenes by accepted edges.
        labels: (N,) component of each scene.
        depth: (N,) number of edges from each scene to the first scene of its component.
        step: (4,) median variances of an edge in rotation, translation and log scale, and its length in map units.
        poses: N poses of the scenes.
    """

    graph: sp.csr_matrix
    labels: np.ndarray
    depth: np.ndarray
    step: np.ndarray
    poses: Similarities

    @classmethod
    def over(cls, edges: Measurements, rows: np.ndarray, poses: Similarities) -> DriftModel:
        n = edges.num_scenes
        labels = component_labels(edges, rows)
        a, b = edges.targets[rows], edges.sources[rows]
        graph = sp.coo_matrix((np.ones(len(rows)), (a, b)), shape=(n, n)).tocsr()
        graph = ((graph + graph.T) > 0).astype(np.float64)
        depth = dijkstra(graph, directed=False, indices=roots(labels), unweighted=True, min_only=True)
        rows = rows if len(rows) else np.arange(len(edges))
        if not len(edges):
            return cls(graph, labels, depth, np.zeros(4), poses)
        diagonal = np.einsum("eii->ei", edges.covariance[rows])
        unit = np.exp(poses.log_scales[edges.sources[rows]])
        length = np.linalg.norm(edges.measured.translations[rows], axis=1) * np.exp(
            poses.log_scales[edges.targets[rows]]
        )
        step = np.array(
            [
                np.median(diagonal[:, :3].mean(1)),
                np.median(diagonal[:, 3:6].mean(1) * unit**2),
                np.median(diagonal[:, 6]) if edges.dim == 7 else 0.0,
                np.median(length),
            ]
        )
        return cls(graph, labels, depth, step, poses)

    def bound(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return an upper bound of the number of edges from a to b: the path through the first scene of their
        component."""
        return self.depth[a] + self.depth[b]

    def hops(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Compute the number of edges on the shortest path between scenes of one component."""
        out = np.zeros(len(a))
        starts, which = np.unique(a, return_inverse=True)
        if len(starts) * len(self.depth) > _MAX_EXACT_HOPS:
            distance = np.linalg.norm(self.poses.translations[a] - self.poses.translations[b], axis=1)
            guess = 2 + 1.5 * distance / max(self.step[3], 1e-9)
            return np.where(a == b, 0.0, np.minimum(guess, self.bound(a, b)))
        for begin in range(0, len(starts), 256):
            mine = (which >= begin) & (which < begin + 256)
            paths = dijkstra(self.graph, directed=False, indices=starts[begin : begin + 256], unweighted=True)
            out[mine] = paths[which[mine] - begin, b[mine]]
        return np.minimum(out, self.bound(a, b))

    def variances(self, hops: np.ndarray, at: np.ndarray, dim: int) -> np.ndarray:
        """Return the diagonal (K, dim) of the covariance after ``hops`` edges, in the unit of scene ``at``."""
        rotation, translation, scale, length = self.step
        unit = np.exp(-2 * self.poses.log_scales[at])
        out = np.empty((len(hops), dim))
        out[:, :3] = (rotation * hops)[:, None]
        out[:, 3:6] = ((translation * hops + (rotation + scale) * length**2 * hops**3 / 3) * unit)[:, None]
        if dim == 7:
            out[:, 6] = scale * hops
        return out
