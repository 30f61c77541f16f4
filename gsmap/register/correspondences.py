"""Candidate correspondences between the nodes of two scene graphs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.types import NodeLayer


@dataclass(frozen=True)
class Params:
    """Which pairs of nodes may correspond.

    Args:
        min_similarity: least cosine of node embeddings (the paper's tau_node).
        top_k: keep a pair when either node is among the other's k most similar of its type.
        max_correspondences: keep the most similar this many.
    """

    min_similarity: float = 0.5
    top_k: int = 1
    max_correspondences: int = 1200


@dataclass(frozen=True, eq=False)
class Correspondences:
    """M candidate pairs of nodes, most similar first, in metres.

    Args:
        target, source: (M, 3) float64 positions of the two ends, each in its own scene's frame, in metres.
        target_ids, source_ids: (M,) int32 rows of the two layers.
        similarity: (M,) float32 cosine of the embeddings.
        target_heights, source_heights: (M,) float64 heights along gravity, or None where either scene does not know.
    """

    target: np.ndarray
    source: np.ndarray
    target_ids: np.ndarray
    source_ids: np.ndarray
    similarity: np.ndarray
    target_heights: np.ndarray | None = None
    source_heights: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.target)

    def __getitem__(self, index: np.ndarray) -> Correspondences:
        heights = (None, None)
        if self.target_heights is not None:
            heights = self.target_heights[index], self.source_heights[index]
        return Correspondences(
            self.target[index],
            self.source[index],
            self.target_ids[index],
            self.source_ids[index],
            self.similarity[index],
            *heights,
        )


def correspondences(
    target: NodeLayer,
    source: NodeLayer,
    params: Params | None = None,
    *,
    units_m: tuple[float, float] = (1.0, 1.0),
    ups: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
) -> Correspondences:
    """Pairs of nodes of one type whose embeddings are alike: each node's ``top_k``, from both sides.

    Args:
        target, source: one layer of each scene, made by the same method.
        units_m: metres per unit of the target's and of the source's frame.
        ups: unit vectors against gravity, or None.
    """
    params = params or Params()
    pairs = [
        _match_type(target, source, np.flatnonzero(target.types == kind), np.flatnonzero(source.types == kind), params)
        for kind in np.intersect1d(target.types, source.types)
    ]
    t = np.concatenate([p[0] for p in pairs]) if pairs else np.zeros(0, int)
    s = np.concatenate([p[1] for p in pairs]) if pairs else np.zeros(0, int)
    similarity = np.concatenate([p[2] for p in pairs]) if pairs else np.zeros(0, np.float32)
    order = np.lexsort((s, t, -similarity))[: params.max_correspondences]
    t, s = t[order], s[order]
    points_t, points_s = target.positions[t] * units_m[0], source.positions[s] * units_m[1]
    heights = (None, None)
    if ups[0] is not None and ups[1] is not None:
        heights = points_t @ ups[0], points_s @ ups[1]
    return Correspondences(
        points_t, points_s, t.astype(np.int32), s.astype(np.int32), similarity[order].astype(np.float32), *heights
    )


def _match_type(
    target: NodeLayer, source: NodeLayer, rows_t: np.ndarray, rows_s: np.ndarray, params: Params
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Candidates among the nodes of one type: rows of the target, rows of the source, similarity."""
    similarity = target.embeddings[rows_t] @ source.embeddings[rows_s].T
    keep = np.zeros(similarity.shape, dtype=bool)
    for axis in (0, 1):
        k = min(params.top_k, similarity.shape[axis])
        if k == 1:
            best = np.expand_dims(similarity.argmax(axis), axis)
        else:
            best = np.argpartition(-similarity, k - 1, axis=axis).take(np.arange(k), axis)
        np.put_along_axis(keep, best, True, axis=axis)
    t, s = np.nonzero(keep & (similarity >= params.min_similarity))
    return rows_t[t], rows_s[s], similarity[t, s]
