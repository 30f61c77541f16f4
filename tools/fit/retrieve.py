#!/usr/bin/env python
"""Fit the axes that retrieval keeps of a descriptor's vectors: their mean and principal axes over made flats.

    python -m tools.fit.retrieve --seeds 61 62 63 64

Describes two captures of each flat, laid on their depth frames and not trained, and writes ``gsmap/retrieve/axes.npz``:
by dimension of a layer's vectors, their mean and as many principal axes as an index keeps. Vectors of other dimensions
go through seeded random axes (`gsmap.retrieve.codes`). Prints the share of the variance that is kept.
"""

from __future__ import annotations

import numpy as np

from gsmap.describe import Params, describe
from gsmap.retrieve.codes import AXES, NUM_DIMS
from gsmap_synthetic import make_captures
from tools.harness import argument_parser, say


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[61, 62, 63, 64])
    args = parser.parse_args()
    vectors: dict[int, list[np.ndarray]] = {}
    for seed in args.seeds:
        for capture in make_captures(seed, 2, steps=0, num_frames=24, num_gaussians=30_000, size_px=(240, 180)):
            params = Params(things=False)
            graph = describe(capture.name, capture.gaussians, capture.cameras, params, scale_policy="auto")
            for layer in graph.layers.values():
                if len(layer):
                    vectors.setdefault(layer.embeddings.shape[1], []).append(layer.embeddings)
        say(f"flat {seed} described")
    arrays = {}
    for dim, parts in vectors.items():
        found = np.concatenate(parts).astype(np.float64)
        mean = found.mean(0)
        variances, axes = np.linalg.eigh(np.cov((found - mean).T))
        kept = axes[:, ::-1][:, :NUM_DIMS]
        kept *= np.sign(kept[np.abs(kept).argmax(0), np.arange(kept.shape[1])])
        arrays |= {f"{dim}.mean": mean.astype(np.float32), f"{dim}.axes": kept.astype(np.float32)}
        share = variances[::-1][:NUM_DIMS].sum() / variances.sum()
        print(f"{len(found)} vectors of {dim} dimensions: {kept.shape[1]} axes keep {share:.1%} of the variance")
    np.savez(AXES, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
