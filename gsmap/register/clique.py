"""Find the maximum clique of a compatibility graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError


@dataclass(frozen=True, eq=False)
class Clique:
    """A clique of a compatibility graph.

    Args:
        members: indices of the correspondences, ascending.
        exact: the clique is proved to be the largest; False when the search stopped at its limit and returned the best
            clique found so far.
        steps: work done (number of 64-bit words read).
    """

    members: np.ndarray
    exact: bool
    steps: int

    def __len__(self) -> int:
        return len(self.members)


def maximum_clique(rows: np.ndarray, step_limit: int = 50_000_000, *, more_than: int = 0) -> Clique:
    """Find the maximum clique of a graph whose adjacency matrix is given as symmetric bit rows (`consistency_graph`).

    Exact branch and bound over a degeneracy order, bounded by greedy colouring with recolouring (San Segundo et al.
    2011; Tomita et al. 2010), starting from greedily grown cliques. The limit counts steps of work (about two
    nanoseconds each), not seconds, so the result is the same on every machine. The clique is empty if no clique has
    more than ``more_than`` members.

    Raises:
        InputError: rows that are not (M, ceil(M / 64)) uint64.
    """
    from gsmap import _native

    rows = np.ascontiguousarray(rows)
    if rows.dtype != np.uint64 or rows.ndim != 2 or rows.shape[1] != -(-len(rows) // 64):
        raise InputError(
            f"a compatibility graph has (M, ceil(M / 64)) uint64 bit rows, got {rows.shape} {rows.dtype}",
            code="shape_mismatch",
        )
    members, exact, steps = _native.maximum_clique(rows, int(more_than), int(step_limit))
    return Clique(members.astype(np.int64), bool(exact), int(steps))
