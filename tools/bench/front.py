#!/usr/bin/env python
"""What a repeating street front with a gap does to a map: edges that are wrong and used, right and not used.

    python -m tools.bench.front --cache /tmp/fronts --seeds 101 102 103       # seeds from 100 on had no part in any fit
    python -m tools.bench.front --cache /tmp/fronts --seeds 11 12 13 14 --fit # fit `edge_likelihood`

Makes fronts (`gsmap_synthetic.facade`): the facade repeats after every window, the road does not. Captures five times
20 m of each in steps of 10 m, each capture with its own exposure, noise and floaters, and registers all pairs. Solves
the poses of all five and of every four of them (a gap) from the same edges, by gsmap and by disagreement alone. An edge
is right if it puts the source's middle within 0.5 m of the truth. Prints, over all solves, wrong edges by use, right
edges by use, and pairs of scenes in one component that lie more than 1 m off (folded); a wrong edge is contradicted
where right edges alone would tie its scenes. ``--fit`` prints the weights of `edge_likelihood` fitted on all
judged poses, and their errors on fronts left out.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from tools.harness import argument_parser

os.environ.setdefault("GSMAP_WORKERS", "1")

import networkx
import numpy as np
from scipy.optimize import minimize

import gsmap.map
import gsmap.register.pair as pair_module
from gsmap.evaluate.registration import pose_error
from gsmap.map.stages.optimize import pose_inputs
from gsmap.optimize import edge_likelihood, optimize
from gsmap.register.pose_selection import EvaluatedPose
from gsmap.types import Edge, Sim3
from gsmap_synthetic.facade import front_captures, make_front
from gsmap_synthetic.make import DemoCapture
from gsmap_synthetic.perturb import bent, strewn, tinted

RIGHT_M, FOLDED_M, REACH_M, STEP_M, COUNT = 0.5, 1.0, 20.0, 10.0, 5


@dataclass(frozen=True)
class Front:
    """The edges of a front and what is true of it.

    Args:
        ids: of its captures, in their order along the front.
        truth: by id, where a capture lies along the front.
        middles: (3,) of each capture's content.
        edges: that registration accepted.
        judged: (K, 5) of every pose that it judged: whether it is right, and `edge_likelihood.features`.
    """

    ids: list[str]
    truth: dict[str, Sim3]
    middles: dict[str, np.ndarray]
    edges: list[Edge]
    judged: np.ndarray

    def error_m(self, target: str, source: str, S_target_source: Sim3) -> float:
        true = self.truth[target].inverse() @ self.truth[source]
        return float(pose_error(S_target_source, true, self.middles[source]).centroid_m)

    def is_right(self, edge: Edge) -> bool:
        return self.error_m(edge.target, edge.source, edge.S_target_source) < RIGHT_M


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="maps of fronts are kept here")
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--fit", action="store_true", help="print weights instead")
    args = parser.parse_args()
    fronts = {seed: read(args.cache / f"front_{seed}", seed) for seed in args.seeds}
    if args.fit:
        fit([front.judged for front in fronts.values()])
    else:
        report(fronts)


def read(folder: Path, seed: int) -> Front:
    """The front of a seed, made where it is not there yet."""
    if not (folder / "judged.json").exists():
        make(folder, seed)
    stored = json.loads((folder / "judged.json").read_text())
    with gsmap.map.open(folder / "map.gsmap", "r") as m:
        scenes = {scene.name: scene for scene in m.scenes()}
        edges = pose_inputs(m.store, m.settings).edges
    ids = [scenes[name].id for name in sorted(scenes)]
    truth = {scenes[name].id: Sim3.from_matrix(np.array(T)).inverse() for name, T in stored["truth"].items()}
    middles = {scene.id: scene.bounds.mean(0) for scene in scenes.values()}
    front = Front(ids, truth, middles, edges, np.zeros((0, 6)))
    rows = []
    for target, source, S, evidence, overlap in stored["judged"]:
        error_m = front.error_m(target, source, Sim3.from_matrix(np.array(S)))
        rows.append(np.r_[error_m < RIGHT_M, edge_likelihood.features(evidence, overlap)])
    return replace(front, judged=np.array(rows).reshape(-1, 6))


def make(folder: Path, seed: int) -> None:
    """Make a front, capture it and register all pairs; poses that are judged on the way are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, 51])
    starts = [k * STEP_M + float(rng.uniform(-1, 1)) * (k > 0) for k in range(COUNT)]
    front = make_front(
        seed, length_m=starts[-1] + REACH_M + 4, pitch_m=rng.uniform(2.5, 4.2), curtains=rng.uniform(0.1, 0.5)
    )
    captures = front_captures(front, starts, reach_m=REACH_M, num_gaussians=int(rng.integers(15_000, 25_000)))
    captures = [worse(capture, rng) for capture in captures]
    judged: list[list[object]] = []
    select_pose = pair_module.select_pose

    def listening(target, source, poses: list[EvaluatedPose], params, **others):  # type: ignore[no-untyped-def]
        found = select_pose(target, source, poses, params, **others)
        for one in poses:
            figures = {
                name: float(getattr(one.evidence, name))
                for name in ("colour_correlation", "disagreement", "free_space_violation")
            }
            figures["log_nfa"] = one.proposal.log_nfa
            if one.evidence.num_seen:
                S = one.proposal.S_target_source.matrix().tolist()
                judged.append([target.id, source.id, S, figures, one.evidence.overlap])
        return found

    pair_module.select_pose = listening
    try:
        with gsmap.map.open_or_create(folder / "map.gsmap") as m:
            for capture in captures:
                m.ingest(capture.gaussians, cameras=capture.cameras, name=capture.name)
            m.describe()
            m.register("all")
    finally:
        pair_module.select_pose = select_pose
    truth = {capture.name: capture.T_scene_world.tolist() for capture in captures}
    (folder / "judged.json").write_text(json.dumps({"truth": truth, "judged": judged}))


def worse(capture: DemoCapture, rng: np.random.Generator) -> DemoCapture:
    """A capture as people have it."""
    found = tinted(capture.gaussians, rng.uniform(0.85, 1.15, 3), rng.uniform(0.85, 1.2))
    found = bent(found, rng, rng.uniform(0.002, 0.03), rng.uniform(0.0, 0.02))
    return replace(capture, gaussians=strewn(found, rng, rng.uniform(0, 0.15), size_m=0.06, opacity=0.6))


def report(fronts: dict[int, Front]) -> None:
    """Print what the pose graph makes of every front, whole and with gaps."""
    for name in ("by likelihood", "by disagreement"):
        total: Counter[str] = Counter()
        for front in fronts.values():
            for gone in [None, *front.ids]:
                total += solved(front, gone, by_likelihood=name == "by likelihood")
        print(f"{name:56}{'count':>6}")
        for what, count in sorted(total.items()):
            print(f"  {what:54}{count:6}")


def solved(front: Front, gone: str | None, *, by_likelihood: bool) -> Counter[str]:
    """Counts of one solve without the capture ``gone``."""
    ids = [scene for scene in front.ids if scene != gone]
    edges = [edge for edge in front.edges if {edge.target, edge.source} <= set(ids)]
    if not by_likelihood:
        edges = [replace(edge, log_odds_wrong=float("nan")) for edge in edges]
    answer, right = optimize(ids, edges), [edge for edge in edges if front.is_right(edge)]
    tied = networkx.Graph([(edge.target, edge.source) for edge in right])
    tied.add_nodes_from(ids)
    counts: Counter[str] = Counter(["solves"])
    for edge in edges:
        outcome = answer.outcomes[edge.target, edge.source]
        kind = "right"
        if edge not in right:
            known = networkx.has_path(tied, edge.target, edge.source)
            kind = "wrong, contradicted" if known else "wrong, nothing contradicts it"
        use = "undecided" if outcome.use == "unused" and outcome.undecided else outcome.use
        counts += Counter([f"{kind} edges", f"{kind} edges, {use}"])
    for a, b in combinations(ids, 2):
        first, second = answer.poses[a], answer.poses[b]
        if first.component == second.component:
            off_m = front.error_m(a, b, first.S_map_scene.inverse() @ second.S_map_scene)
            counts += Counter(["pairs of scenes in one component"])
            counts += Counter(["pairs of scenes in one component, folded"] * (off_m > FOLDED_M))
    return counts


def fit(judged: list[np.ndarray]) -> None:
    """Print the weights of a conditional logistic regression, and how sure these and those in use are."""
    print("fitted weights", np.round(weights(judged), 2), "in use", weights_now())
    left_out = [differences(rows) @ weights(judged[:k] + judged[k + 1 :]) for k, rows in enumerate(judged)]
    in_use = [differences(rows) @ weights_now() for rows in judged]
    for name, parts in (("fitted, on fronts left out", left_out), ("in use", in_use)):
        odds = np.concatenate(parts)
        sure, wrong = int((odds > np.log(9)).sum()), int((odds < -np.log(9)).sum())
        print(f"{name}: {len(odds)} pairs of a wrong and a right pose, {sure} surely told apart, {wrong} surely wrong,")
        print(f"  {int((odds < 0).sum())} in the wrong order")


def weights_now() -> list[float]:
    e = edge_likelihood
    return [e.COLOUR, e.DISAGREEMENT, e.FREE_SPACE, e.OVERLAP, 1.0]


def differences(judged: np.ndarray) -> np.ndarray:
    """(P, 5) figures of each wrong pose less those of each right one."""
    right, wrong = judged[judged[:, 0] > 0, 1:], judged[judged[:, 0] == 0, 1:]
    return np.asarray((wrong[:, None] - right[None]).reshape(-1, 5))


def weights(judged: list[np.ndarray], shrink: float = 0.05) -> np.ndarray:
    """(5,) weights, none below 0, fitted on pairs of a wrong and a right pose of one front; the last, of false alarms,
    is 1."""
    parts = [differences(rows) for rows in judged]
    count = [min(int(rows[:, 0].sum()), int((rows[:, 0] == 0).sum())) for rows in judged]
    share = np.concatenate([np.full(len(part), n / max(len(part), 1)) for part, n in zip(parts, count, strict=True)])
    x = np.concatenate(parts)
    found = minimize(
        lambda w: share @ np.logaddexp(0, -x @ w) + shrink * w @ w,
        np.r_[np.full(4, 0.5), 1.0],
        bounds=[*[(0, None)] * 4, (1, 1)],
    )
    return np.asarray(found.x)


if __name__ == "__main__":
    main()
