"""Pairs of places that repeat: which poses are accepted, and how far these are off.

    python -m tools.bench.repetitive --cache FOLDER [--kinds corridor facade ...] [--seeds 201 202 ...] [--pairs]

Façades, corridors, colonnades, parking decks, stairwells, rooms that look alike from several sides, and flats of one
make with other furniture (`gsmap_synthetic`): five captures of each seed, with the faults that captures have, and all
pairs of them. In one of three places nothing is unique, in the others some bays or most have things of their own. Truth
is exact. A pose is wrong if it puts the source's middle more than 0.3 m or 3 degrees off; it is over 5 sigma off if one
of the axes of its covariance is. Two flats of one make are different places: every pose between them is wrong. Of
changed flats two captures show what is left after 30 and 60 % of the furniture changed, and one shows another flat of
the make. "Used" are edges that are neither refused nor tentative in the map of the five captures. Seeds from 200 on had
no part in any fit.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, print_table, say

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "GSMAP_WORKERS"):
    os.environ.setdefault(_name, "1")

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

import gsmap.map
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.similarities import Similarities
from gsmap.types import Sim3
from gsmap_synthetic import make_captures
from gsmap_synthetic.edits import edit_place
from gsmap_synthetic.facade import front_captures, make_front
from gsmap_synthetic.halls import Kind, hall_captures, make_hall
from gsmap_synthetic.make import DemoCapture
from gsmap_synthetic.script import random_edits
from gsmap_synthetic.streets import make_street
from tools.bench.front import worse

KINDS = (*get_args(Kind), "facade", "twin flats", "changed flats")
_ROUTES = ((0, 1), (1, 2), (3, 4), (4, 5), (2, 3))  # rooms 3 to 5 are decorated as rooms 0 to 2 are
_CHANGED_SHARES = 0.3, 0.6  # of the furniture of rooms 0 and 1
_TOLD = "probability", "log_nfa", "look_alike", "similarity"
_FLAT: dict[str, Any] = {"steps": 0, "num_gaussians": 20_000, "num_frames": 48}
WRONG_M, WRONG_DEG, SIGMAS = 0.3, 3.0, 5.0


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keep maps here")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[201, 202, 203, 204, 205])
    parser.add_argument("--pairs", action="store_true", help="print every accepted pair, and every missed one")
    options = parser.parse_args()
    rows = []
    for kind in options.kinds:
        pairs: list[dict[str, Any]] = []
        for seed in options.seeds:
            folder = options.cache / f"{kind.replace(' ', '_')}_{seed}"
            found = registered_pairs(folder, kind, seed)
            if options.pairs:
                tell(found)
            pairs += found
        rows.append((kind, *summary(pairs)))
    heads = (
        "place",
        "pairs",
        "accepted",
        "wrong",
        "over 5 sigma",
        "wrong and used",
        "over 25 %",
        "right",
        "unique",
        "right",
    )
    print_table(heads, rows)


def captures_of(kind: str, seed: int) -> tuple[list[DemoCapture], float]:
    """Return the captures of a place, and how many unique things its bays have."""
    rng = np.random.default_rng([seed, 71])
    unique = (0.0, 0.3, 1.0)[seed % 3]
    if kind == "twin flats":
        place = make_street(seed, rooms=6, decorations=3, texel_m=0.02)
        made = make_captures(seed, 5, place=place, routes=_ROUTES, **_FLAT)
        unique = 1.0
    elif kind == "changed flats":
        place = make_street(seed, rooms=6, decorations=3, texel_m=0.02)
        made = make_captures(seed, 3, place=place, routes=_ROUTES[:3], **_FLAT)
        for k, share in enumerate(_CHANGED_SHARES, start=3):
            edits = random_edits(place, np.random.default_rng([seed, k, 72]), rooms=_ROUTES[0], share=share)
            changed = edit_place(place, edits, texel_m=0.02)
            made += make_captures(seed, 1, place=changed, routes=_ROUTES[:1], first=k, **_FLAT)
        unique = 1.0
    elif kind == "facade":
        starts = [k * 10.0 + float(rng.uniform(-1, 1)) * (k > 0) for k in range(5)]
        place = make_front(
            seed, length_m=64, pitch_m=rng.uniform(2.5, 4.2), curtains=unique / 2, things_per_m=unique / 3
        )
        made = front_captures(place, starts, num_gaussians=20_000)
    else:
        made = hall_captures(make_hall(kind, seed, unique=unique), kind)  # type: ignore[arg-type]
    return [worse(capture, rng) for capture in made], unique


def registered_pairs(folder: Path, kind: str, seed: int) -> list[dict[str, Any]]:
    """Return what is true of each pair of a place; its map is made where it is missing, and registered anew."""
    truths = folder / "truth.json"
    if not truths.exists():
        folder.mkdir(parents=True, exist_ok=True)
        captures, unique = captures_of(kind, seed)
        with gsmap.map.open_or_create(folder / "map.gsmap") as m:
            for capture in captures:
                m.ingest(capture.gaussians, cameras=capture.cameras, name=capture.name)
        truth = {capture.name: capture.T_scene_world.tolist() for capture in captures}
        truths.write_text(json.dumps({"unique": unique, "truth": truth}))
        say(f"made {folder.name}")
    stored = json.loads(truths.read_text())
    with gsmap.map.open(folder / "map.gsmap") as m:
        m.describe()
        m.register("all")
        m.optimize()
        used = {frozenset((row.target, row.source)): row.used for row in m.edge_rows()}
        scenes = {scene.id: scene for scene in m.scenes()}
        truth = {name: Sim3.from_matrix(np.array(T)) for name, T in stored["truth"].items()}
        centres = {s.name: solid_centres(m.store.scenes.gaussians(s.id), truth[s.name]) for s in scenes.values()}
        overlaps = true_overlaps(sorted(centres), centres.__getitem__)
        out = []
        for one in m.store.registrations.current():
            r = one.registration
            a, b = scenes[r.target].name, scenes[r.source].name
            row: dict[str, Any] = {"place": folder.name, "unique": stored["unique"] > 0, "pair": f"{a}:{b}"}
            row |= {"overlap": overlaps[frozenset((a, b))], "accepted": r.status == "accepted", "reason": r.reason}
            row |= {
                "evidence": r.evidence,
                "p": r.evidence.get("probability"),
                "nfa": r.evidence.get("log_nfa"),
                "m": np.nan,
                "deg": np.nan,
            }
            row["used"] = used.get(frozenset((r.target, r.source)), False)
            if r.S_target_source is not None:
                true = truth[a] @ truth[b].inverse()
                error = pose_error(r.S_target_source, true, scene_centroid(m.store.scenes.gaussians(r.source)))
                off = (Similarities.stack([r.S_target_source]).inverse() @ Similarities.stack([true])).log()[0]
                row |= {"m": error.centroid_m, "deg": error.rre_deg}
                if r.information is not None:
                    values, axes = np.linalg.eigh(r.information)
                    row["sigmas"] = float(np.abs(np.sqrt(np.maximum(values, 0)) * (axes.T @ off)).max())
            row["right"] = bool(row["accepted"] and row["m"] < WRONG_M and row["deg"] < WRONG_DEG)
            out.append(row)
    return out


def summary(pairs: Sequence[dict[str, Any]]) -> tuple[int, ...]:
    """Count pairs, accepted ones, wrong ones, those over 5 sigma off, wrong ones that the map uses, and right ones."""
    accepted = [row for row in pairs if row["accepted"]]
    wrong = [row for row in accepted if not row["right"]]
    off = sum(row.get("sigmas", 0) > SIGMAS for row in accepted)
    seen = [row for row in pairs if row["overlap"] > 0.25]
    unique = [row for row in seen if row["unique"]]
    used = sum(row["used"] is True for row in wrong)
    right, told = sum(row["right"] for row in seen), sum(row["right"] for row in unique)
    return len(pairs), len(accepted), len(wrong), off, used, len(seen), right, len(unique), told


def tell(pairs: Sequence[dict[str, Any]]) -> None:
    """Print accepted pairs, and those over 25 % overlap that are missed."""
    for row in pairs:
        if row["accepted"] or row["overlap"] > 0.25:
            answer = ("right" if row["right"] else "wrong") if row["accepted"] else "missed"
            error = f"{row['m']:.3f} m {row['deg']:.2f} deg {row.get('sigmas', np.nan):.1f} sigma"
            print(
                f"{row['place']} {row['pair']} overlap {row['overlap']:.2f}: {answer}, used {row['used']}, {error}, "
                + ", ".join(f"{name} {row['evidence'].get(name, np.nan):.3g}" for name in _TOLD)
                + f", {row['reason']}",
                flush=True,
            )


if __name__ == "__main__":
    main()
