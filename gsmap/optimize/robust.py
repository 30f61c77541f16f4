"""Estimate robust poses from edges that may be wrong: spanning tree, chordal relaxation, graduated non-convexity."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from gsmap.geometry.similarities import Similarities, commutator, exp
from gsmap.optimize.blocks import BlockSystem
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.structure import component_labels, roots

_GNC_SHRINK = 4.0  # factor by which the robust kernel narrows from one width to the next


def spanning_tree_init(edges: Measurements, rows: np.ndarray, cost: np.ndarray, poses: Similarities) -> Similarities:
    """Initialize poses along the minimum spanning forest of the edges at ``rows``, from the first scene of each
    component.

    Args:
        cost: (len(rows),) positive cost of each edge; edges of lower cost are trusted more.
        poses: initial poses; the first scene of each component keeps its pose.
    """
    n = edges.num_scenes
    order = np.lexsort((rows, cost))
    rank = np.empty(len(rows))
    rank[order] = np.arange(1, len(rows) + 1)
    # Of several edges between two scenes only the best may enter the tree, because sparse matrices add entries.
    low = np.minimum(edges.targets[rows], edges.sources[rows])
    high = np.maximum(edges.targets[rows], edges.sources[rows])
    _, best = np.unique((low * n + high)[order], return_index=True)
    best = order[best]
    tree = minimum_spanning_tree(sp.coo_matrix((rank[best], (low[best], high[best])), shape=(n, n)).tocsr()).tocoo()
    edge_of = rows[order[tree.data.astype(np.int64) - 1]]
    link = sp.coo_matrix((edge_of + 1.0, (tree.row, tree.col)), shape=(n, n)).tocsr()
    link = link + link.T
    out = Similarities(poses.rotations.copy(), poses.translations.copy(), poses.log_scales.copy())
    depth = np.full(n, -1)
    parent = np.full(n, -1)
    for root in roots(component_labels(edges, rows)):
        found, before = breadth_first_order(link, root, directed=False)
        parent[found] = before[found]
        depth[root] = 0
        for scene in found[1:]:
            depth[scene] = depth[before[scene]] + 1
    for level in range(1, depth.max(initial=0) + 1):
        scenes = np.flatnonzero(depth == level)
        edge = np.asarray(link[scenes, parent[scenes]]).ravel().astype(np.int64) - 1
        step = edges.measured[edge]
        backward = edges.targets[edge] == scenes
        step = step.replaced(backward, step[backward].inverse())
        placed = out[parent[scenes]] @ step
        out = out.replaced(scenes, placed.orthonormalised())
    return out


def residuals(edges: Measurements, poses: Similarities) -> np.ndarray:
    """Compute the residuals ``Log(S_target_source^-1 S_map_target^-1 S_map_source)`` (E, D) on the source side."""
    predicted = poses[edges.targets].inverse() @ poses[edges.sources]
    return (edges.measured.inverse() @ predicted).log()[:, : edges.dim]


def linearize(edges: Measurements, poses: Similarities, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the derivatives (E, D, D) of the residuals ``r`` with respect to steps of the target and of the source,
    each on the scene's side."""
    d = edges.dim
    full = np.zeros((len(edges), 7))
    full[:, :d] = r
    ad = commutator(full)
    # Inverse right Jacobian of the exponential, to second order (exact up to the fourth).
    inverse_right = np.eye(7) + ad / 2 + ad @ ad / 12
    back = (poses[edges.sources].inverse() @ poses[edges.targets]).adjoint()
    return -(inverse_right @ back)[:, :d, :d], inverse_right[:, :d, :d]


def chi_squares(edges: Measurements, poses: Similarities) -> np.ndarray:
    """Compute the (E,) chi-square of each edge under ``poses``, with D degrees of freedom."""
    r = residuals(edges, poses)
    return np.einsum("ed,edf,ef->e", r, edges.information, r)


def chordal(edges: Measurements, fixed: np.ndarray, poses: Similarities) -> Similarities:
    """Estimate poses by least squares without initial poses; fixed scenes keep their poses.

    Rotations follow from the chordal relaxation (Martinec and Pajdla 2007; Carlone et al. 2015, sec. III-B): solve
    ``R_source^T = R_target_source^T R_target^T`` over all edges as if the entries were free, then project to SO(3). Log
    scales and then translations are linear once the rotations are known.
    """
    n, a, b = edges.num_scenes, edges.targets, edges.sources
    touched = np.zeros(n, dtype=bool)
    touched[a] = touched[b] = True
    still = fixed | ~touched
    covariance = edges.covariance
    weight_r = 3 / np.einsum("eii->e", covariance[:, :3, :3])
    weight_t = 3 / np.einsum("eii->e", covariance[:, 3:6, 3:6])

    def solve(A: np.ndarray, B: np.ndarray, weight: np.ndarray, r: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Solve for x over all scenes; free scenes start at 0, fixed scenes have the values of ``known``."""
        start = np.where(still[:, None, None], known, 0.0)
        system = BlockSystem(a, b, still, A.shape[2])
        W = weight[:, None, None] * np.eye(A.shape[1])
        return start + system.solve(A, B, W, A @ start[a] + B @ start[b] + r)

    eye = np.tile(np.eye(3), (len(edges), 1, 1))
    backward = edges.measured.rotations.transpose(0, 2, 1)
    transposed = solve(-backward, eye, weight_r, np.zeros((len(edges), 3, 3)), poses.rotations.transpose(0, 2, 1))
    u, _, vt = np.linalg.svd(transposed.transpose(0, 2, 1))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotations = np.where(still[:, None, None], poses.rotations, u @ vt)

    one = np.ones((len(edges), 1, 1))
    log_scales = poses.log_scales
    if edges.dim == 7:
        r = -edges.measured.log_scales[:, None, None]
        log_scales = solve(-one, one, 1 / covariance[:, 6, 6], r, poses.log_scales[:, None, None])[:, 0, 0]
    moved = np.einsum("eij,ej->ei", rotations[a], edges.measured.translations) * np.exp(log_scales[a])[:, None]
    weight_t = weight_t * np.exp(-2 * log_scales[b])
    translations = solve(-one, one, weight_t, -moved[:, None, :], poses.translations[:, None, :])[:, 0, :]
    return Similarities(rotations, translations, log_scales)


@dataclass(frozen=True, eq=False)
class GaussNewton:
    """Gauss-Newton optimization over a fixed set of edges.

    Args:
        edges: edges to fit.
        fixed: (N,) mask of scenes that do not move.
    """

    edges: Measurements
    fixed: np.ndarray

    @cached_property
    def system(self) -> BlockSystem:
        touched = np.zeros(self.edges.num_scenes, dtype=bool)
        touched[self.edges.targets] = touched[self.edges.sources] = True
        still = self.fixed | ~touched
        return BlockSystem(self.edges.targets, self.edges.sources, still, self.edges.dim)

    def step(self, poses: Similarities, weights: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Compute the Gauss-Newton step (N, D) from the residuals ``r`` and a weight per edge."""
        edges = self.edges
        A, B = linearize(edges, poses, r)
        W = edges.information * weights[:, None, None]
        return self.system.solve(A, B, W, r[:, :, None])[:, :, 0]

    def fit(self, poses: Similarities, max_steps: int = 20, tolerance: float = 1e-6) -> Similarities:
        """Fit poses by least squares from good initial poses, with step halving; stop when the cost falls by less than
        ``tolerance``."""
        cost = self._cost(poses)
        ones = np.ones(len(self.edges))
        for _ in range(max_steps):
            step = self.step(poses, ones, residuals(self.edges, poses))
            for _ in range(4):
                trial = (poses @ exp(step)).orthonormalised()
                trial_cost = self._cost(trial)
                if trial_cost <= cost:
                    break
                step = step / 2
            else:
                return poses
            gain, cost, poses = cost - trial_cost, trial_cost, trial
            if gain <= tolerance * cost + 1e-9:
                break
        return poses

    def solve_gnc(self, poses: Similarities, gate: float, widest: float, trusted: np.ndarray) -> Similarities:
        """Fit poses by iteratively reweighted least squares with Geman-McClure weights of decreasing width.

        ``w = (c / (c + chi2))^2``; c starts at ``widest`` gates and shrinks by a factor (graduated non-convexity, Yang
        et al. 2020; cycle consistency allows a narrow start). ``trusted`` edges keep weight 1.
        """
        c = gate * max(1.0, widest)
        noise = float(np.sqrt(np.median(np.einsum("eii->ei", self.edges.covariance)[:, :3])))
        while True:
            for _ in range(4 if c <= gate else 2):
                r = residuals(self.edges, poses)
                chi = np.einsum("ed,edf,ef->e", r, self.edges.information, r)
                weights = np.where(trusted, 1.0, (c / (c + chi)) ** 2)
                step = self.step(poses, weights, r)
                poses = (poses @ exp(step)).orthonormalised()
                # Converged: the step is small compared with the noise of the edges.
                if np.abs(step).max(initial=0) < 1e-2 * noise:
                    break
            if c <= gate:
                return poses
            c = max(gate, c / _GNC_SHRINK)

    def _cost(self, poses: Similarities) -> float:
        return float(chi_squares(self.edges, poses).sum())
