"""Fits what the evidence for a pose is worth, on made places, and says how well that holds on others.

    python -m tools.make.verdict_places PLACES --set fit && python -m tools.make.verdict_places PLACES --set test
    python -m tools.fit.verdict PLACES --cache FOLDER            # writes gsmap/register/probability.json
    python -m tools.fit.verdict PLACES --cache FOLDER --also FLATS   # and says what becomes of FLATS/SEED/NAME.ply

Every pair of captures is matched, and every proposed pose refined and measured whatever the bars say; so are poses
that were never proposed: the true one moved a little, and floors laid on floors at any angle. A pose is right within
5 deg and 30 cm (of working metres: more where places are seen from far): the verdict says that it is the place, the
covariance how exactly. Poses that lay a wing on its exact twin are left out: nothing of a pair can tell them, the map
may. The curves (`gsmap.register.probability`) are monotone and fitted by maximum likelihood with a penalty on steep
ones; places are left out in turn to see how sure the sums may be.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, say

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import json
import pickle
import sys
import time
from dataclasses import asdict, dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from gsmap.describe import Params as DescribeParams
from gsmap.describe import describe
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.rotations import exp_so3
from gsmap.ingest import read_captures
from gsmap.register import Params, SceneView, verdict
from gsmap.register.pair import evaluate_pose
from gsmap.register.probability import Curve, Model, evidence_of
from gsmap.register.proposal_rounds import ProposalRounds
from gsmap.register.timing import Stopwatch
from gsmap.types import Sim3
from gsmap.types.registration import Proposal
from tools.make.verdict_places import SETS, twin_m

RIGHT_DEG, RIGHT_M = 5.0, 0.3
APART_FIT = 8  # captures of other places that each one is matched with

KNOTS = {
    "log_nfa": (-60.0, -30.0, -16.0, -8.0, -4.0, -2.0, 0.0, 3.0, 8.0),
    "runner_up": (0.0, 0.6, 0.8, 1.0, 1.5),
    "free_space_violation": tuple(np.log10(np.array([0.001, 0.004, 0.011, 0.021, 0.041, 0.081, 0.151, 0.251, 0.5]))),
    "overlap": tuple(np.log10(np.array([0.02, 0.06, 0.11, 0.16, 0.26, 0.41, 0.61]))),
    "num_coinciding": tuple(np.log10(np.array([60.0, 160, 310, 610, 1210, 2410, 4810]))),
    "colour_correlation": (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.7),
    "colour_t": tuple(np.log10(np.array([1.0, 2, 3, 5, 8, 12, 20, 40]))),
}
KNOTS["disagreement"] = KNOTS["free_space_violation"]
RISES = {"overlap", "num_coinciding", "colour_correlation", "colour_t"}


@dataclass
class Judged:
    """One pose and what is known of it."""

    place: str
    pair: tuple[str, str]
    kind: str  # proposed, near, floor
    evidence: dict[str, float]
    right: bool
    overlap: float
    error: tuple[float, float] | None
    accepted: bool

    @property
    def is_on_twin(self) -> bool:
        """Whether the pose is that of a wing on its exact twin."""
        if self.right or self.error is None or not any(self.place == str(seed) for of in SETS.values() for seed in of):
            return False
        return self.error[0] < RIGHT_DEG and abs(self.error[1] - twin_m(int(self.place))) < RIGHT_M


# --- what is judged --------------------------------------------------------------------------------------------------


def collect(folder: Path, cache: Path, apart: int | None, seed: int = 0) -> list[Judged]:
    """Every pose that is judged of the captures below a folder."""
    kept = cache / f"{folder.name}.json"
    if kept.exists():
        return [Judged(**row) for row in json.loads(kept.read_text())]
    views, truths, places = read(folder, cache)
    rng = np.random.default_rng(seed)
    names = sorted(views)
    overlaps = {}
    for place in sorted(set(places.values())):
        own = [n for n in names if places[n] == place]
        solid = {n: solid_centres(views[n].gaussians, truths[n]) for n in own}
        overlaps |= true_overlaps(own, solid.__getitem__)
    pairs = [(a, b) for a, b in combinations(names, 2) if places[a] == places[b]]
    others = [(a, b) for a, b in combinations(names, 2) if places[a] != places[b]]
    if apart is not None:
        others = [others[i] for i in rng.permutation(len(others))[: apart * len(names) // 2]]
    found, began = [], time.process_time()
    for k, (a, b) in enumerate(pairs + others):
        truth = truths[a] @ truths[b].inverse() if places[a] == places[b] else None
        overlap = overlaps[frozenset((a, b))] if truth is not None else 0.0
        found += judge_pair(views[a], views[b], places[a], truth, overlap, rng)
        if k % 50 == 0:
            say(f"{folder.name}: {k} of {len(pairs) + len(others)} pairs, {time.process_time() - began:.0f} CPU s")
    kept.write_text(json.dumps([asdict(judged) for judged in found]))
    return found


def told_apart(rows: list[Judged]) -> tuple[list[Judged], list[Judged]]:
    """Poses that the evidence of a pair can tell from right ones, and those that nothing of a pair can."""
    twins = {id(row) for row in rows if row.is_on_twin}
    return [row for row in rows if id(row) not in twins], [row for row in rows if id(row) in twins]


def read(folder: Path, cache: Path) -> tuple[dict[str, SceneView], dict[str, Sim3], dict[str, str]]:
    """Captures with their graphs, truth and place, by name."""
    views, truths, places = {}, {}, {}
    (cache / "graphs").mkdir(exist_ok=True)
    for place in sorted(p.parent for p in folder.glob("*/truth")):
        for capture in read_captures(place):
            name = f"{place.name}-{capture.name}"
            kept = cache / "graphs" / f"{name}.pickle"
            if not kept.exists():
                graph = describe(name, capture.gaussians, capture.cameras, DescribeParams(things=False))
                kept.write_bytes(pickle.dumps(graph))
            views[name] = SceneView(name, capture.gaussians, capture.cameras, pickle.loads(kept.read_bytes()))
            truth = json.loads((place / "truth" / f"{capture.name}.json").read_text())["T_scene_world"]
            truths[name], places[name] = Sim3.from_matrix(np.array(truth)), place.name
    return views, truths, places


def judge_pair(
    a: SceneView, b: SceneView, place: str, truth: Sim3 | None, overlap: float, rng: np.random.Generator
) -> list[Judged]:
    """Every pose of a pair that is worth a look, by its evidence."""
    params, watch, found = Params(fallback="never"), Stopwatch(), []
    working_m = float(np.sqrt(a.graph.working_m * b.graph.working_m))
    proposals = [("proposed", p) for round_ in ProposalRounds(a, b, params, watch).rounds() for p in round_[:3]]
    proposals = [(k, p) for k, p in proposals if not p.flaw and not p.with_scale and p.log_nfa < 12]
    if truth is not None and overlap > 0.02:
        off = exp_so3(rng.normal(size=3) * np.radians(rng.uniform(0.5, 4)))
        moved = truth @ about(off, rng.normal(size=3) * rng.uniform(0.02, 0.3), b.centre)
        proposals.append(("near", Proposal("moved", moved, False, 0)))
    elif a.graph.up is not None and b.graph.up is not None and rng.random() < 0.25:
        proposals.append(("floor", Proposal("floor", floor_on_floor(a, b, rng), False, 0)))
    for kind, proposal in proposals:
        judged = evaluate_pose(a, b, proposal, params)
        error = None
        if truth is not None:
            e = pose_error(judged.proposal.S_target_source, truth, scene_centroid(b.gaussians))
            error = (e.rre_deg, e.centroid_m)
        right = error is not None and error[0] < RIGHT_DEG and error[1] * working_m < RIGHT_M
        found.append(
            Judged(
                place,
                (a.id, b.id),
                kind,
                evidence_of(judged.proposal, judged.evidence),
                right,
                overlap,
                error,
                not judged.flaw,
            )
        )
    return found


def about(rotation: np.ndarray, shift: np.ndarray, centre: np.ndarray) -> Sim3:
    """A motion of the source about its middle."""
    return Sim3(rotation, centre + shift - rotation @ centre)


def floor_on_floor(a: SceneView, b: SceneView, rng: np.random.Generator) -> Sim3:
    """The source upright on the target's floor, turned anyhow, its middle somewhere within the target."""
    turn = exp_so3(a.graph.up * rng.uniform(0, 2 * np.pi)) @ align(b.graph.up, a.graph.up)
    turned = b.gaussians.means.astype(np.float64) @ turn.T
    theirs = a.gaussians.means.astype(np.float64)
    at = theirs[rng.integers(len(theirs))] - np.median(turned, 0)
    rise = np.percentile(theirs @ a.graph.up, 2) - np.percentile(turned @ a.graph.up, 2)
    return Sim3(turn, at + (rise - at @ a.graph.up) * a.graph.up)


def align(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The shortest rotation of one unit vector onto another."""
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3) if a @ b > 0 else exp_so3(np.pi * np.linalg.svd(a[None])[2][1])
    return exp_so3(axis / sine * np.arctan2(sine, a @ b))


# --- the fit ---------------------------------------------------------------------------------------------------------


def design(rows: list[dict[str, float]]) -> np.ndarray:
    """One column a segment of a curve, how much of it the value has behind it (falling curves: before it), and one a
    curve for missing values."""
    columns = []
    for name, knots in KNOTS.items():
        values = np.array([row[name] for row in rows])
        lacks = np.isnan(values)
        filled = np.where(lacks, knots[0], values)
        for low, high in pairwise(knots):
            share = np.clip((filled - low) / (high - low), 0, 1)
            share = share if name in RISES else 1 - share
            columns.append(np.where(lacks, 0, share))
        columns.append(lacks.astype(float))
    return np.column_stack(columns)


def fit(rows: list[Judged], penalty: float = 0.005) -> Model:
    """Maximum likelihood, right and wrong poses weighed alike, under a ridge on every segment's rise."""
    x = design([row.evidence for row in rows])
    y = np.array([row.right for row in rows], float)
    weight = np.where(y > 0, 0.5 / max(y.sum(), 1), 0.5 / max((1 - y).sum(), 1)) * len(y)
    free = np.zeros(x.shape[1], bool)  # missing evidence may speak either way
    at = 0
    for knots in KNOTS.values():
        at += len(knots) - 1
        free[at] = True
        at += 1

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        z = x @ w[:-1] + w[-1]
        p = 1 / (1 + np.exp(-z))
        value = (weight * (np.logaddexp(0, z) - y * z)).mean() + penalty * (w[:-1] ** 2).sum() / 2
        gradient = np.r_[x.T @ (weight * (p - y)) / len(y) + penalty * w[:-1], (weight * (p - y)).mean()]
        return float(value), gradient

    bounds = [(None, None) if f else (0, None) for f in free] + [(None, None)]
    w = minimize(
        loss, np.zeros(x.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 2000}
    ).x
    curves, at, base = {}, 0, w[-1]
    for name, knots in KNOTS.items():
        rises = w[at : at + len(knots) - 1]
        worth = np.r_[0, np.cumsum(rises)] if name in RISES else np.r_[np.cumsum(rises[::-1])[::-1], 0]
        curves[name] = Curve(tuple(map(float, knots)), tuple(map(float, worth)), float(w[at + len(knots) - 1]))
        at += len(knots)
    return Model(curves, float(base), 1e-4)


def log_odds(model: Model, rows: list[Judged]) -> np.ndarray:
    """Of every pose, with no prior."""
    return np.array([model.log_odds(row.evidence) for row in rows])


def left_out(rows: list[Judged], folds: int = 6) -> np.ndarray:
    """Log-odds of every pose by a model that saw nothing of its place."""
    names = sorted({row.place for row in rows})
    fold = np.array([names.index(row.place) % folds for row in rows])
    out = np.zeros(len(rows))
    for k in range(folds):
        model = fit([row for row, f in zip(rows, fold, strict=True) if f != k])
        held = np.flatnonzero(fold == k)
        out[held] = log_odds(model, [rows[i] for i in held])
    return out


def calibrated(model: Model, odds: np.ndarray, rows: list[Judged]) -> Model:
    """The model with its sums stretched or shrunk until held-out places bear out what they say (Platt 1999)."""
    y = np.array([row.right for row in rows], float)
    weight = np.where(y > 0, 0.5 / y.sum(), 0.5 / (1 - y).sum())

    def loss(ab: np.ndarray) -> float:
        z = ab[0] * odds + ab[1]
        return float((weight * (np.logaddexp(0, z) - y * z)).sum())

    a, b = minimize(loss, [1.0, 0.0], method="Nelder-Mead").x
    curves = {name: Curve(c.knots, tuple(a * w for w in c.worth), a * c.missing) for name, c in model.curves.items()}
    return Model(curves, a * model.base + b, 1.0 / max((y == 0).sum(), 1))


# --- what it says ----------------------------------------------------------------------------------------------------


def report(name: str, rows: list[Judged], odds: np.ndarray, bars: verdict.Params) -> None:
    """What probabilities accept, and what is true of what they say."""
    p = probabilities(odds)
    right, stands = np.array([row.right for row in rows]), np.array([not contradicted(row, bars) for row in rows])
    print(f"{name}: {right.sum()} right poses, {(~right).sum()} wrong ones")
    for bar in (0.5, 0.9, 0.95, 0.99, 0.999):
        yes = p >= bar
        past = f"past the bars on free space and colour {(yes & stands & right).sum()}, {(yes & stands & ~right).sum()}"
        print(f"  p >= {bar}: {(yes & right).sum()} right, {(yes & ~right).sum()} wrong accepted; {past}")
    now = np.array([row.accepted for row in rows])
    print(f"  the verdict when they were judged: {(now & right).sum()} right, {(now & ~right).sum()} wrong accepted")
    for low, high in ((0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01)):
        those = (p >= low) & (p < high)
        if those.any():
            print(f"  said {low:.2f} to {min(high, 1):.2f}: {those.sum():5d} poses, {right[those].mean():.3f} right")


def report_pairs(name: str, rows: list[Judged], odds: np.ndarray, bars: verdict.Params) -> None:
    """Of how many pairs a right pose, and a wrong one, would be accepted; by overlap those that gsmap proposes."""
    p = probabilities(odds)
    yes = [q >= bars.min_probability and not contradicted(row, bars) for row, q in zip(rows, p, strict=True)]
    one_place = {tuple(row.pair) for row in rows if row.error is not None}
    accepted = {tuple(row.pair) for row, y in zip(rows, yes, strict=True) if y and row.right}
    wrong = {tuple(row.pair) for row, y in zip(rows, yes, strict=True) if y and not row.right}
    apart = {tuple(row.pair) for row in rows} - one_place
    print(f"{name}: {len(accepted)} of {len(one_place)} pairs of one place accepted, {len(wrong)} pairs wrongly;")
    print(f"  {len(apart)} pairs of different places had a pose to judge")
    proposed = [row.kind == "proposed" for row in rows]
    for low, high in ((0.02, 0.1), (0.1, 0.25), (0.25, 1.01)):
        band = {tuple(row.pair) for row in rows if low <= row.overlap < high}
        right = {tuple(row.pair) for row, y, p in zip(rows, yes, proposed, strict=True) if y and p and row.right}
        found = {tuple(row.pair) for row, p in zip(rows, proposed, strict=True) if p and row.right}
        share = f"{len(right & band)} of {len(band)} pairs accepted, of {len(found & band)} a right pose was proposed"
        print(f"  overlap {low:.0%} to {min(high, 1):.0%}: {share}")


def probabilities(odds: np.ndarray) -> np.ndarray:
    """Of log-odds without a prior, under the verdict's."""
    out: np.ndarray = 1 / (1 + np.exp(-(odds + np.log(verdict.PRIOR / (1 - verdict.PRIOR)))))
    return out


def contradicted(row: Judged, bars: verdict.Params) -> bool:
    """Whether the verdict refuses a pose whatever speaks for it; evidence that could not be had refuses none."""
    violation = 10 ** row.evidence["free_space_violation"] - 1e-3
    return violation > bars.max_free_space_violation or row.evidence["colour_correlation"] < bars.min_colour_correlation


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--also", type=Path, nargs="+", default=[], help="folders of captured places to be judged, too")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    bars = verdict.Params()
    rows, twins = told_apart(collect(args.places / "fit", args.cache, APART_FIT))
    odds = left_out(rows)
    model = calibrated(fit(rows), odds, rows)
    report("fit, each place left out", rows, odds, bars)
    tests, more = told_apart(collect(args.places / "test", args.cache, None, seed=1))
    report("test", tests, log_odds(model, tests), bars)
    report_pairs("test", tests, log_odds(model, tests), bars)
    report("wings on their twins, in neither", twins + more, log_odds(model, twins + more), bars)
    for folder in args.also:
        judged = collect(folder, args.cache, None, seed=1)
        report_pairs(folder.name, judged, log_odds(model, judged), bars)
    target = Path(__file__).resolve().parents[2] / "gsmap" / "register" / "probability.json"
    stored = {
        "curves": {
            name: {
                "knots": [round(k, 4) for k in c.knots],
                "worth": [round(w, 3) for w in c.worth],
                "missing": round(c.missing, 3),
            }
            for name, c in model.curves.items()
        },
        "base": round(model.base, 3),
        "least": float(f"{model.least:.2g}"),
    }
    target.write_text(json.dumps(stored, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
