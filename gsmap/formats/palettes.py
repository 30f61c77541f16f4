"""Vector quantization for SOG: codebooks of numbers, and a palette of vectors."""

from __future__ import annotations

import heapq

import numpy as np

_CELLS = 1 << 11  # that values are sorted into: by number, and by width as many more
_LLOYD_TURNS = 10
_SAMPLE = 1 << 16  # vectors that the coarse clusters are found in
_FINE = 256  # entries below one coarse cluster
_BLOCK = 1 << 13  # vectors compared at once


def codebook(values: np.ndarray, size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Compute the codebook with the least squared error for finite values, and the index of each value's entry.

    Neighbouring cells of a fine histogram are joined where this adds the least error (Ward 1963) until ``size`` cells
    are left; then Lloyd's iteration moves their borders.

    Returns:
        The ascending entries (size,) float32, and uint8 indices in the shape of the values.
    """
    flat = np.sort(values.reshape(-1).astype(np.float64))
    cuts = _cells(flat)
    sums = np.concatenate([[0], np.cumsum(flat)])
    cuts = _joined(cuts, sums, size)
    book = np.diff(sums[cuts]) / np.diff(cuts)
    for _ in range(_LLOYD_TURNS):
        cuts = np.concatenate([[0], np.searchsorted(flat, (book[1:] + book[:-1]) / 2), [len(flat)]])
        inside = np.diff(cuts)
        book = np.where(inside > 0, np.diff(sums[cuts]) / np.maximum(inside, 1), book)
    book = np.concatenate([book, np.full(size - len(book), book[-1])]).astype(np.float32)
    which = np.searchsorted((book[1:] + book[:-1]) / 2, values.astype(np.float32))
    return book, which.astype(np.uint8)


def _cells(flat: np.ndarray) -> np.ndarray:
    """Divide sorted values into cells, evenly by count and by width, never between equal values; return the bounds."""
    at = np.concatenate(
        [
            np.searchsorted(flat, flat[np.linspace(0, len(flat) - 1, _CELLS).astype(np.int64)]),
            np.searchsorted(flat, np.linspace(flat[0], flat[-1], _CELLS)),
            [0, len(flat)],
        ]
    )
    cuts: np.ndarray = np.unique(at)
    return cuts


def _joined(cuts: np.ndarray, sums: np.ndarray, size: int) -> np.ndarray:
    """Join neighbouring cells to ``size`` cells, those that add the least error first; return the remaining bounds."""
    count = np.diff(cuts).astype(float).tolist()
    total = np.diff(sums[cuts]).tolist()
    left, right = [*range(-1, len(count) - 1)], [*range(1, len(count) + 1)]
    alive, age = [True] * len(count), [0] * len(count)

    def cost(i: int, j: int) -> float:
        return count[i] * count[j] / (count[i] + count[j]) * (total[i] / count[i] - total[j] / count[j]) ** 2

    heap = [(cost(i, i + 1), i, i + 1, 0, 0) for i in range(len(count) - 1)]
    heapq.heapify(heap)
    for _ in range(len(count) - size):
        while True:
            _, i, j, age_i, age_j = heapq.heappop(heap)
            if alive[i] and alive[j] and (age[i], age[j]) == (age_i, age_j):
                break
        count[i], total[i], age[i], alive[j] = count[i] + count[j], total[i] + total[j], age[i] + 1, False
        right[i] = right[j]
        if right[i] < len(count):
            left[right[i]] = i
            heapq.heappush(heap, (cost(i, right[i]), i, right[i], age[i], age[right[i]]))
        if left[i] >= 0:
            heapq.heappush(heap, (cost(left[i], i), left[i], i, age[left[i]], age[i]))
    return np.concatenate([cuts[:-1][alive], cuts[-1:]])


def palette(vectors: np.ndarray, size: int, turns: int, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute a palette of vectors by k-means in two steps: coarse clusters, and palette entries within each cluster.

    So each vector is compared with all coarse clusters and the entries of one cluster, not with all ``size`` entries.

    Args:
        vectors: (N, D) float32.
        size: Maximum size of the palette.
        turns: Number of k-means iterations in each step.
        weights: (N,) weight of each vector, at least 0.

    Returns:
        The entries (P, D) float32 with P <= size, and the index (N,) int64 of each vector's entry. Entries of one
        coarse cluster are consecutive; clusters are sorted along the direction in which cluster centres vary most.
    """
    rng = np.random.default_rng(0)
    n = len(vectors)
    shadow = vectors.astype(np.float64) @ rng.normal(size=vectors.shape[1])  # alike where vectors are, and seldom else
    _, first, which = np.unique(shadow, return_index=True, return_inverse=True)
    if len(first) <= size and np.array_equal(vectors[first][which], vectors):
        return vectors[first], which
    coarse_size = -(-size // _FINE)
    sample = np.sort(rng.choice(n, min(n, _SAMPLE), replace=False))
    coarse = _lloyd(vectors[sample], weights[sample], min(coarse_size, len(sample)), turns, rng)
    centred = coarse - coarse.mean(0)
    main = np.linalg.svd(centred, full_matrices=False)[2][0]
    coarse = coarse[np.argsort(centred @ main, kind="stable")]
    cluster = _nearest(vectors, coarse)
    order = np.argsort(cluster, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(cluster, minlength=len(coarse)))])
    share = _shares(vectors, weights, coarse, cluster, size)
    labels, entries, begun = np.empty(n, np.int64), [], 0
    for k in range(len(coarse)):
        rows = order[ends[k] : ends[k + 1]]
        if not len(rows):
            continue
        inside = vectors[rows]
        if len(rows) <= share[k]:
            fine, own = inside, np.arange(len(rows))
        else:
            fine = _lloyd(inside, weights[rows], int(share[k]), turns, rng)
            own = _nearest(inside, fine)
        entries.append(fine)
        labels[rows] = begun + own
        begun += len(fine)
    return np.concatenate(entries).astype(np.float32), labels


def _shares(vectors: np.ndarray, weights: np.ndarray, coarse: np.ndarray, cluster: np.ndarray, size: int) -> np.ndarray:
    """Return the number of entries (K,) of each cluster, by the error of one entry; at most ``size`` in total."""
    count = np.bincount(cluster, minlength=len(coarse))
    away = ((vectors - coarse[cluster]) ** 2).sum(1) * weights
    error = np.sqrt(np.bincount(cluster, away, minlength=len(coarse)) * count)
    share = np.full(len(coarse), 1.0)
    if error.sum() > 0:
        share += (size - len(coarse)) * error / error.sum()
    whole: np.ndarray = np.maximum(1, np.minimum(np.floor(share), count)).astype(np.int64)
    return whole


def _lloyd(vectors: np.ndarray, weights: np.ndarray, size: int, turns: int, rng: np.random.Generator) -> np.ndarray:
    """Return the means (size, D) of k-means; an empty cluster restarts at a vector with a large error."""
    centres = vectors[np.sort(rng.choice(len(vectors), size, replace=False))].copy()
    for _ in range(turns):
        nearest = _nearest(vectors, centres)
        total = np.zeros_like(centres)
        weight = np.bincount(nearest, weights, minlength=size)
        weighted = vectors * weights[:, None]
        for d in range(vectors.shape[1]):
            total[:, d] = np.bincount(nearest, weighted[:, d], minlength=size)
        full = weight > 0
        centres[full] = total[full] / weight[full, None]
        empty = np.flatnonzero(np.bincount(nearest, minlength=size) == 0)
        if len(empty):
            away = ((vectors - centres[nearest]) ** 2).sum(1) * weights
            centres[empty] = vectors[np.argsort(-away, kind="stable")[: len(empty)]]
    return centres


def _nearest(vectors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the index (N,) of the centre nearest to each vector."""
    half = 0.5 * (centres**2).sum(1)
    out = np.empty(len(vectors), np.int64)
    for start in range(0, len(vectors), _BLOCK):
        part = vectors[start : start + _BLOCK]
        out[start : start + _BLOCK] = (half - part @ centres.T).argmin(1)
    return out
