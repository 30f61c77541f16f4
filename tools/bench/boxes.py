#!/usr/bin/env python
"""What order and size of chunks decide of reading a box: times the rows that it needs, in how many ranges.

    python -m tools.bench.boxes

A million points in a slab of 100 x 100 x 5 m, and in a made city of 20 blocks; boxes of 26,000 of them, of all heights,
square or a quarter as deep as wide; medians of 12. Rows lie along the Morton curve, the Hilbert curve, or in the leaves
of a k-d tree; every chunk that a box touches is read. "Held to 5" closes the smallest gaps until five ranges are left.
What Gaussians reach beyond their means is not counted; `tools/bench/store.py --boxes` measures the store as it is.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.morton import morton_order
from gsmap_synthetic.city import PER_BLOCK, City
from tools.harness import argument_parser

COUNT, IN_BOX, MOST, BOXES = 1_000_000, 26_000, 5, 12
_BITS = 16


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--rows", type=int, nargs="+", default=[16_384, 4096, 1024, 512], help="of a chunk")
    options = parser.parse_args()
    rng = np.random.default_rng(5)
    places = {
        "slab": rng.uniform([0, 0, 0], [100, 100, 5], (COUNT, 3)),
        "city": City(COUNT // PER_BLOCK, seed=9).load().means.astype(np.float64),
    }
    for place, points in places.items():
        centres = points[rng.integers(len(points), size=BOXES)]
        boxes = {"square": around(points, centres, 1.0), "wall": around(points, centres, 0.25)}
        curves = {"Morton": morton_order(points), "Hilbert": hilbert_order(points)}
        for name in (*curves, "k-d leaves"):
            for rows in options.rows:
                text = f"{place:5} {name:11} {rows:6} rows"
                ordered = points[curves[name] if name in curves else leaves(points, rows)]
                for shape, some in boxes.items():
                    held, touched, ranges = read(ordered, rows, some)
                    text += f"   {shape}: {touched:5.2f} in {ranges:2.0f}, held to {MOST} {held:5.2f}"
                print(text, flush=True)


def around(points: np.ndarray, centres: np.ndarray, depth: float) -> np.ndarray:
    """(B, 2, 3) boxes of `IN_BOX` points each, without end upwards and downwards."""
    out = []
    for centre in centres:
        away = (np.abs(points - centre)[:, :2] / [1.0, depth]).max(1)
        reach = np.partition(away, IN_BOX)[IN_BOX] * np.array([1.0, depth, 1e6])
        out.append([centre - reach, centre + reach])
    return np.array(out)


def read(points: np.ndarray, rows: int, boxes: np.ndarray) -> np.ndarray:
    """Medians over boxes: times the rows needed, held to `MOST` ranges and not; and how many ranges there are then."""
    starts = np.arange(0, len(points), rows)
    low, high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    found = []
    for a, b in boxes:
        touched = np.flatnonzero(((high >= a) & (low <= b)).all(1))
        gaps = np.sort(np.diff(touched)[np.diff(touched) > 1] - 1)
        closed = gaps[: max(0, len(gaps) + 1 - MOST)].sum()
        needed = ((points >= a) & (points <= b)).all(1).sum() / rows
        found.append(((len(touched) + closed) / needed, len(touched) / needed, len(gaps) + 1))
    out: np.ndarray = np.median(found, axis=0)
    return out


def leaves(points: np.ndarray, rows: int) -> np.ndarray:
    """The order of the leaves of a k-d tree that halves the longest side, ``rows`` points in each but the last."""
    out, stack = [], [np.arange(len(points))]
    while stack:
        mine = stack.pop()
        if len(mine) <= rows:
            out.append(mine)
            continue
        axis = int(np.argmax(np.ptp(points[mine], axis=0)))
        half = rows * max(1, (len(mine) // rows + 1) // 2)
        order = mine[np.argpartition(points[mine, axis], min(half, len(mine) - 1))]
        stack += [order[half:], order[:half]]
    return np.concatenate(out)


def hilbert_order(points: np.ndarray) -> np.ndarray:
    """The order along the Hilbert curve of the smallest cube (Skilling, Programming the Hilbert curve, 2004)."""
    span = float(np.ptp(points, axis=0).max()) * 1.0001
    x = list(((points - points.min(0)) / span * (1 << _BITS)).astype(np.int64).T)
    bit = 1 << (_BITS - 1)
    while bit > 1:
        below = bit - 1
        for i in range(3):
            set_ = (x[i] & bit) > 0
            x[0] = np.where(set_, x[0] ^ below, x[0])
            swapped = np.where(set_, 0, (x[0] ^ x[i]) & below)
            x[0], x[i] = x[0] ^ swapped, x[i] ^ swapped
        bit >>= 1
    x[1] ^= x[0]
    x[2] ^= x[1]
    flips, bit = np.zeros_like(x[0]), 1 << (_BITS - 1)
    while bit > 1:
        flips = np.where((x[2] & bit) > 0, flips ^ (bit - 1), flips)
        bit >>= 1
    code = np.zeros_like(x[0])
    for k in reversed(range(_BITS)):
        for axis in x:
            code = (code << 1) | (((axis ^ flips) >> k) & 1)
    return np.argsort(code, kind="stable")


if __name__ == "__main__":
    main()
