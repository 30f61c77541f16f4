"""Match the nodes of two scene graphs by their embeddings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.types import NodeLayer

MIN_SIMILARITY = 0.5  # cosine of node embeddings (the paper's tau_node)
MAX_CORRESPONDENCES = 1200


@dataclass(frozen=True, eq=False)
class Correspondences:
    """M candidate pairs of nodes, most similar first, with positions in metres.

    Args:
        target, source: (M, 3) float64 positions of the two nodes of each pair, each in the frame of its scene, in
            metres.
        target_ids, source_ids: (M,) int32 rows of the two layers.
        similarity: (M,) float32 cosine of the embeddings.
        target_heights, source_heights: (M,) float64 heights along gravity, or None where it is unknown in either scene.
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
        return Correspondences(
            target=self.target[index],
            source=self.source[index],
            target_ids=self.target_ids[index],
            source_ids=self.source_ids[index],
            similarity=self.similarity[index],
            target_heights=None if self.target_heights is None else self.target_heights[index],
            source_heights=None if self.source_heights is None else self.source_heights[index],
        )


def match_nodes(
    target: NodeLayer,
    source: NodeLayer,
    *,
    top_k: int = 1,
    min_similarity: float = MIN_SIMILARITY,
    max_correspondences: int = MAX_CORRESPONDENCES,
    units_m: tuple[float, float] = (1.0, 1.0),
    ups: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
) -> Correspondences:
    """Match each node with the ``top_k`` most similar nodes of its type in the other scene; return the union of both
    directions.

    Args:
        target, source: one layer of each scene, both with the same descriptor.
        top_k: a pair is kept if one node is among the ``top_k`` nodes of its type that are most similar to the other.
        min_similarity: smallest cosine of the embeddings of a pair.
        max_correspondences: number of the most similar pairs that are kept.
        units_m: metres per unit of the target's and of the source's frame.
        ups: unit vectors against gravity, or None.
    """
    # Sorted by type, so that each type's similarities are one product of two blocks.
    order_t, order_s = (np.argsort(layer.types, kind="stable") for layer in (target, source))
    types_t, types_s = target.types[order_t], source.types[order_s]
    embeddings_t, embeddings_s = target.embeddings[order_t], source.embeddings[order_s]
    kinds = np.intersect1d(types_t, types_s)
    bounds = (np.searchsorted(t, kinds, side) for t in (types_t, types_s) for side in ("left", "right"))
    found_t, found_s = [np.zeros(0, int)], [np.zeros(0, int)]
    found = [np.zeros(0, np.float32)]
    for t0, t1, s0, s1 in zip(*bounds, strict=True):
        block = embeddings_t[t0:t1] @ embeddings_s[s0:s1].T
        rows, columns = _mutual_top_k(block, top_k, min_similarity)
        found_t.append(order_t[t0 + rows])
        found_s.append(order_s[s0 + columns])
        found.append(block[rows, columns])
    t, s, similarity = np.concatenate(found_t), np.concatenate(found_s), np.concatenate(found)
    if len(t) > max_correspondences:
        least = np.partition(similarity, -max_correspondences)[-max_correspondences]
        t, s, similarity = t[similarity >= least], s[similarity >= least], similarity[similarity >= least]
    order = np.lexsort((s, t, -similarity))[:max_correspondences]
    return _between(target, source, t[order], s[order], similarity[order], units_m, ups)


def similar_pairs(
    target: NodeLayer,
    source: NodeLayer,
    members: Correspondences,
    quantile: float,
    count: int,
    *,
    units_m: tuple[float, float],
    ups: tuple[np.ndarray | None, np.ndarray | None],
) -> Correspondences:
    """Match the nodes of some correspondences with all nodes that are about as similar to them as their partners.

    Args:
        members: the correspondences.
        quantile: the similarity of a pair must reach this quantile of the similarities of ``members``.
        count: largest number of pairs; the most similar are kept.
        units_m, ups: as in `match_nodes`.
    """
    bar = float(np.quantile(members.similarity, quantile)) - 1e-6
    ends_t, ends_s = np.unique(members.target_ids), np.unique(members.source_ids)
    found_t, found_s = _similar_pairs(target, source, ends_t, np.arange(len(source)), bar)
    other_t, other_s = _similar_pairs(target, source, np.arange(len(target)), ends_s, bar)
    pairs = np.unique(np.column_stack([np.r_[found_t, other_t], np.r_[found_s, other_s]]), axis=0)
    t, s = pairs.T
    similarity = np.einsum("ij,ij->i", target.embeddings[t], source.embeddings[s])
    order = np.lexsort((s, t, -similarity))[:count]
    return _between(target, source, t[order], s[order], similarity[order], units_m, ups)


def _similar_pairs(
    target: NodeLayer, source: NodeLayer, t: np.ndarray, s: np.ndarray, bar: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of pairs of nodes that have the same type and a similarity of at least ``bar``."""
    similar = target.embeddings[t] @ source.embeddings[s].T >= bar
    rows, columns = np.nonzero(similar & (target.types[t][:, None] == source.types[s]))
    return t[rows], s[columns]


def _between(
    target: NodeLayer,
    source: NodeLayer,
    t: np.ndarray,
    s: np.ndarray,
    similarity: np.ndarray,
    units_m: tuple[float, float],
    ups: tuple[np.ndarray | None, np.ndarray | None],
) -> Correspondences:
    """Return the correspondences between rows ``t`` of the target and rows ``s`` of the source, in metres."""
    points_t, points_s = target.positions[t] * units_m[0], source.positions[s] * units_m[1]
    level = ups[0] is not None and ups[1] is not None
    return Correspondences(
        target=points_t,
        source=points_s,
        target_ids=t.astype(np.int32),
        source_ids=s.astype(np.int32),
        similarity=similarity.astype(np.float32),
        target_heights=points_t @ ups[0] if level else None,
        source_heights=points_s @ ups[1] if level else None,
    )


def _mutual_top_k(similarity: np.ndarray, top_k: int, min_similarity: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the entries that are among the ``top_k`` largest of their row or of their column."""
    height, width = similarity.shape
    if top_k == 1:
        column, row = similarity.argmax(1), similarity.argmax(0)
        once = np.flatnonzero(column[row] != np.arange(width))  # mutual matches were already added from their row
        rows, columns = np.concatenate([np.arange(height), row[once]]), np.concatenate([column, once])
    else:
        k, m = min(top_k, width), min(top_k, height)
        keep = np.zeros(similarity.shape, dtype=bool)
        np.put_along_axis(keep, np.argpartition(-similarity, k - 1, axis=1)[:, :k], True, axis=1)
        np.put_along_axis(keep, np.argpartition(-similarity, m - 1, axis=0)[:m], True, axis=0)
        rows, columns = np.nonzero(keep)
    enough = similarity[rows, columns] >= min_similarity
    return rows[enough], columns[enough]
