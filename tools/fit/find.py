"""Fit what the differences of two things are worth for finding things that are alike (gsmap/find/similarity.json).

    python -m tools.fit.find --cache FOLDER --seeds 200 210

Pairs of things of made places (`find_places`): of one look, in one capture or in two, against all others. Things that
show less than half of their object are left out of the first kind. No real capture has a part in it. Also printed: the
mean average precision on the places themselves, each left out of the fit in turn.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import gsmap.find
from gsmap.find.similarity import DIFFERENCES, SimilarityModel, differences
from tools.bench.find_scores import Item, average_precisions, by_model, items_of
from tools.fit.monotone import fit_curves
from tools.harness import argument_parser
from tools.make import find_places

_RIDGE = 3e-4
_RIGHT = 0.1  # share of the weight that pairs of one look have


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(200, 210), metavar=("FIRST", "END"))
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--write", action="store_true", help="write gsmap/find/similarity.json")
    args = parser.parse_args()
    places = [items_of(find_places.cached(seed, args.cache)) for seed in range(*args.seeds)]
    pairs = [pairs_of(place) for place in places]
    scores: list[float] = []
    for k, place in enumerate(places):
        model = fit([pair for i, pair in enumerate(pairs) if i != k])
        found = [ap for name, ap in average_precisions(place, lambda q, m=model: by_model(m, q)) if name]
        scores += found
        print(f"place {args.seeds[0] + k}: mAP {np.mean(found):.3f} of {len(found)} queries")
    print(f"left out in turn: mAP {np.mean(scores):.3f}")
    model = fit(pairs)
    for name, knots, worth in zip(DIFFERENCES, model.knots, model.worth, strict=True):
        print(name, [round(k, 2) for k in knots], [round(w, 2) for w in worth])
    if args.write:
        curves = {
            name: {"knots": [round(k, 4) for k in knots], "worth": [round(w, 4) for w in worth]}
            for name, knots, worth in zip(DIFFERENCES, model.knots, model.worth, strict=True)
        }
        path = Path(gsmap.find.__file__).with_name("similarity.json")
        path.write_text(json.dumps({"base": round(model.base, 4), "curves": curves}, indent=1) + "\n")


def pairs_of(items: Sequence[Item]) -> tuple[np.ndarray, np.ndarray]:
    """(P, 10) differences of pairs, and (P,) whether they are of one look."""
    rows, same = [], []
    for i, item in enumerate(items):
        others = [other for other in items[i + 1 :] if not (other.kind == item.kind and not (item.good and other.good))]
        rows.append(differences(item.look, [other.look for other in others]))
        same.append(np.array([other.kind == item.kind for other in others], bool))
    return np.concatenate(rows), np.concatenate(same)


def fit(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> SimilarityModel:
    """Curves that only fall; see `tools.fit.monotone`."""
    x, same = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
    knots, worth, base = fit_curves(x, same, ridge=_RIDGE, share=_RIGHT)
    return SimilarityModel(tuple(tuple(k.tolist()) for k in knots), tuple(tuple(w.tolist()) for w in worth), base)


if __name__ == "__main__":
    main()
