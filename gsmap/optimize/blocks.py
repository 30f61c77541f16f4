"""Sparse least squares over a graph: one block of unknowns per scene, one residual per edge."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, cg, splu

_MAX_FILL_BLOCKS = 500_000  # above it conjugate gradients are cheaper; only maps that fill a volume exceed it


class BlockSystem:
    """``min_x sum_e |A_e x_target + B_e x_source + r_e|^2_W`` over the scenes that are not fixed; ``x`` is 0 for fixed
    scenes.

    The elimination ordering is computed once from the sparsity pattern, on the graph of scenes rather than of scalars,
    and is used by every solve.

    Args:
        targets, sources: (E,) scenes of each edge.
        fixed: (N,) mask of fixed scenes; also True for scenes that no edge reaches.
        dim: number of unknowns per scene.
    """

    def __init__(self, targets: np.ndarray, sources: np.ndarray, fixed: np.ndarray, dim: int) -> None:
        self.targets, self.sources, self.dim = targets, sources, dim
        self.free = np.flatnonzero(~fixed)
        self.row = np.full(len(fixed), -1)
        self.row[self.free] = np.arange(len(self.free))
        n = len(self.free)
        a, b = self.row[targets], self.row[sources]
        self._both = (a >= 0) & (b >= 0)
        rows = np.concatenate([np.arange(n), a[a >= 0], b[b >= 0], a[self._both], b[self._both]])
        cols = np.concatenate([np.arange(n), a[a >= 0], b[b >= 0], b[self._both], a[self._both]])
        keys, self._slot = np.unique(rows * n + cols, return_inverse=True)
        self._indices, self._indptr = keys % max(n, 1), np.searchsorted(keys, np.arange(n + 1) * n)
        self._order, self._direct = self._ordering(n)

    def _ordering(self, n: int) -> tuple[np.ndarray, bool]:
        if n < 3:
            return np.arange(n), True
        graph = sp.csc_matrix((np.full(len(self._indices), -1.0), self._indices, self._indptr), shape=(n, n))
        graph = (graph + sp.diags(np.diff(self._indptr) + 1.0)).tocsc()
        factor = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        return np.argsort(factor.perm_c), factor.L.nnz <= _MAX_FILL_BLOCKS

    def solve(
        self,
        A: np.ndarray,
        B: np.ndarray,
        W: np.ndarray,
        r: np.ndarray,
    ) -> np.ndarray:
        """Solve one least-squares problem.

        Args:
            A, B: (E, M, dim). W: (E, M, M). r: (E, M, K): K right-hand sides at once.

        Returns:
            (N, dim, K).
        """
        n, d, k = len(self.free), self.dim, r.shape[2]
        out = np.zeros((len(self.row), d, k))
        if n == 0:
            return out
        a, b = self.row[self.targets], self.row[self.sources]
        AW, BW = A.transpose(0, 2, 1) @ W, B.transpose(0, 2, 1) @ W
        cross = AW[self._both] @ B[self._both]
        values = [np.zeros((n, d, d)), (AW @ A)[a >= 0], (BW @ B)[b >= 0], cross, cross.transpose(0, 2, 1)]
        data = _sum_by(self._slot, np.concatenate(values), len(self._indices))
        gradient = _sum_by(
            np.concatenate([a[a >= 0], b[b >= 0]]), np.concatenate([(AW @ r)[a >= 0], (BW @ r)[b >= 0]]), n
        )
        diagonal = np.flatnonzero(self._indices == np.repeat(np.arange(n), np.diff(self._indptr)))
        # Unit diagonals: radians, metres and stiff scale rows differ by many powers of ten.
        root = np.sqrt(np.maximum(np.einsum("nii->ni", data[diagonal]), 1e-300))
        owner = np.repeat(np.arange(n), np.diff(self._indptr))
        data = data / root[owner][:, :, None] / root[self._indices][:, None, :]
        data[diagonal] += 1e-12 * np.eye(d)
        gradient = gradient / root[:, :, None]
        solution = self._direct_solve(data, gradient) if self._direct else self._iterative(data, diagonal, gradient)
        out[self.free] = -solution / root[:, :, None]
        return out

    def _direct_solve(self, data: np.ndarray, rhs: np.ndarray) -> np.ndarray:
        n, d, k = rhs.shape
        inverse = np.empty(n, dtype=np.int64)
        inverse[self._order] = np.arange(n)
        owner = np.repeat(np.arange(n), np.diff(self._indptr))
        keys = inverse[owner] * n + inverse[self._indices]
        sort = np.argsort(keys)
        indptr = np.searchsorted(keys[sort], np.arange(n + 1) * n)
        matrix = sp.bsr_matrix((data[sort], inverse[self._indices][sort], indptr), shape=(n * d, n * d)).tocsc()
        factor = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0, options={"SymmetricMode": True})
        out = np.empty_like(rhs)
        out[self._order] = factor.solve(np.ascontiguousarray(rhs[self._order].reshape(n * d, k))).reshape(n, d, k)
        return out

    def _iterative(self, data: np.ndarray, diagonal: np.ndarray, rhs: np.ndarray) -> np.ndarray:
        n, d, k = rhs.shape
        matrix = sp.bsr_matrix((data, self._indices, self._indptr), shape=(n * d, n * d)).tocsr()
        jacobi = np.linalg.inv(data[diagonal])
        precondition = LinearOperator(
            matrix.shape, matvec=lambda x: np.einsum("nij,nj->ni", jacobi, x.reshape(n, d)).ravel(), dtype=float
        )
        columns = [
            cg(matrix, np.ascontiguousarray(rhs[:, :, c]).ravel(), rtol=1e-6, maxiter=2000, M=precondition)[0]
            for c in range(k)
        ]
        return np.stack(columns, axis=1).reshape(n, d, k)


def _sum_by(groups: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sum ``values`` (V, ...) by group; empty groups are zero."""
    out = np.zeros((count, *values.shape[1:]))
    if len(groups):
        order = np.argsort(groups, kind="stable")
        sorted_groups = groups[order]
        starts = np.flatnonzero(np.r_[True, sorted_groups[1:] != sorted_groups[:-1]])
        out[sorted_groups[starts]] = np.add.reduceat(values[order], starts, axis=0)
    return out
