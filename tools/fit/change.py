"""How probable a change is by its evidence: fits the weights of `gsmap.change.confidence`, and says how they do.

    python -m tools.make.change DEV --set dev            # also dev-small, dev-false
    python -m tools.fit.change DEV/* --cache DIR                          # fits, and judges places left out of the fit
    python -m tools.fit.change DEV/* --cache DIR --only alike             # fits one weight and keeps all others
    python -m tools.fit.change DEV/* --cache DIR --test TEST/*            # judges places no constant was chosen on

Every change that comparing two captures under their true poses comes up with is one row, however unsure. It is right if
half of its voxels lie within 15 cm of a true change (see `change_scores`), and wrong in places where nothing
changed. Right and wrong ones weigh the same in the fit. By each probability: how many are right, how many wrong.
"""

from __future__ import annotations

import itertools
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from gsmap.change import VERSION, Params, compare
from gsmap.change.confidence import BASES, WEIGHTS, pieces
from gsmap.types import PosedScene
from tools.bench import change_scores as scores
from tools.harness import argument_parser
from tools.make.change_truth import VOXEL_M, Truth, changed_voxels

_NEAR_M = 0.15
_FOUND = 0.3
_BARS = (0.0, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


@dataclass(frozen=True)
class Row:
    """One change that a pair of captures came up with.

    Args:
        place, pair: which.
        kind, evidence: what is said of it.
        right: whether half of it is one.
        finds: names of the true changes of which it covers enough to find them.
    """

    place: str
    pair: str
    kind: str
    evidence: dict[str, float]
    right: bool
    finds: tuple[str, ...]


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="+", help="folders of tools/make/change.py to fit on")
    parser.add_argument("--test", type=Path, nargs="+", default=[], help="folders that are only judged")
    parser.add_argument("--cache", type=Path, required=True, help="keep what comparing came up with here")
    parser.add_argument("--ridge", type=float, default=0.01)
    parser.add_argument("--only", help="fit the weight of this feature, without ridge; all others stay as they are")
    args = parser.parse_args()

    def fitted(rows: list[Row]) -> tuple[float, dict[str, float]]:
        return fit(rows, args.ridge) if args.only is None else fit_one(rows, args.only)

    rows = [row for folder in args.places for row in found_in(folder, args.cache)]
    for way in ("looked through", "painted"):
        if args.only is not None and args.only not in WEIGHTS[way]:
            continue
        mine = [row for row in rows if pieces(row.evidence)[0] == way]
        base, weights = fitted(mine)
        told = ", ".join(f'"{name}": {weight:.2f}' for name, weight in weights.items())
        print(
            f"{way}: {sum(r.right for r in mine)} right, {sum(not r.right for r in mine)} wrong; {base:.2f}, {{{told}}}"
        )
        held = np.zeros(len(mine))
        for place in {row.place for row in mine}:
            left = fitted([row for row in mine if row.place != place])
            for k, row in enumerate(mine):
                if row.place == place:
                    held[k] = probability(row, *left)
        table(f"{way}, places left out", mine, held)
        others = [row for folder in args.test for row in found_in(folder, args.cache)]
        others = [row for row in others if pieces(row.evidence)[0] == way]
        if others:
            table(f"{way}, test", others, np.array([probability(row, base, weights) for row in others]))
    return 0


def found_in(folder: Path, cache: Path) -> list[Row]:
    """All that comparing the captures of a place comes up with."""
    kept = cache / f"{folder.name}-{VERSION}.json"
    if not kept.exists():
        rows = [row for pair in itertools.combinations(Truth(folder).times, 2) for row in _rows(Truth(folder), *pair)]
        cache.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps([vars(row) for row in rows]))
        print(
            f"{folder.name}: {len(rows)} changes, {sum(row.right for row in rows)} right", file=sys.stderr, flush=True
        )
    return [Row(**{**row, "finds": tuple(row["finds"])}) for row in json.loads(kept.read_text())]


def _rows(truth: Truth, before: str, after: str) -> list[Row]:
    scenes = (PosedScene(truth.gaussians(t), truth.cameras(t), t, truth.captured_at(t)) for t in (before, after))
    report = compare(*scenes, replace(Params(), min_confidence=0.0))
    true = [(change["name"], voxels) for change, voxels in changed_voxels(truth, before, after) if len(voxels)]
    every = np.concatenate([voxels for _, voxels in true]) if true else np.zeros((0, 3))
    rows = []
    for change in report.changes:
        if change.kind == "lighting":
            continue
        claimed = change.voxels.astype(np.float64)
        right = bool((scores.distances(claimed, every) <= _NEAR_M).mean() >= 0.5)
        finds = [n for n, voxels in true if (scores.distances(voxels, claimed) <= VOXEL_M).mean() >= _FOUND]
        rows.append(
            Row(truth.folder.name, f"{before}:{after}", change.kind, dict(change.evidence), right, tuple(finds))
        )
    return rows


def fit(rows: list[Row], ridge: float) -> tuple[float, dict[str, float]]:
    """Base and weights of a logistic regression; right and wrong weigh the same."""
    names = list(pieces(rows[0].evidence)[1])
    x = np.array([list(pieces(row.evidence)[1].values()) for row in rows])
    right = np.array([row.right for row in rows])
    weight = np.where(right, 0.5 / max(right.sum(), 1), 0.5 / max((~right).sum(), 1))
    sign = np.where(right, 1.0, -1.0)
    spread = np.maximum(x.std(0), 1e-6)

    def loss(p: np.ndarray) -> tuple[float, np.ndarray]:
        odds = p[0] + x @ p[1:]
        slope = -weight * sign / (1 + np.exp(np.clip(sign * odds, -50, 50)))
        value = float(weight @ np.logaddexp(0, -sign * odds) + ridge * ((p[1:] * spread) ** 2).sum())
        return value, np.append(slope.sum(), x.T @ slope + 2 * ridge * p[1:] * spread**2)

    p = minimize(loss, np.zeros(1 + x.shape[1]), jac=True, method="L-BFGS-B").x
    return float(p[0]), dict(zip(names, p[1:].tolist(), strict=True))


def fit_one(rows: list[Row], name: str) -> tuple[float, dict[str, float]]:
    """Base and weights as `gsmap.change.confidence` has them, but for one that is fitted as by `fit`."""
    way = pieces(rows[0].evidence)[0]
    right = np.array([row.right for row in rows])
    weight = np.where(right, 0.5 / max(right.sum(), 1), 0.5 / max((~right).sum(), 1))
    told = [np.clip(probability(row, BASES[way], WEIGHTS[way] | {name: 0.0}), 1e-12, 1 - 1e-12) for row in rows]
    odds, x = np.log(told) - np.log1p(-np.array(told)), np.array([pieces(row.evidence)[1][name] for row in rows])
    sign = np.where(right, 1.0, -1.0)
    best = minimize_scalar(lambda w: float(weight @ np.logaddexp(0, -sign * (odds + w * x)))).x
    return BASES[way], WEIGHTS[way] | {name: float(best)}


def probability(row: Row, base: float, weights: dict[str, float]) -> float:
    odds = base + sum(weights[name] * value for name, value in pieces(row.evidence)[1].items())
    return float(1 / (1 + np.exp(-odds)))


def table(title: str, rows: list[Row], told: np.ndarray) -> None:
    """By each bar: how many at least so probable are right, and wrong."""
    right = np.array([row.right for row in rows])
    cells = [f"{bar:.2f}: {(right & (told >= bar)).sum()}/{(~right & (told >= bar)).sum()}" for bar in _BARS]
    print(f"  {title}, at least so probable: right/wrong  " + "  ".join(cells))


if __name__ == "__main__":
    sys.exit(main())
