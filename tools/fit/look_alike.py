"""Fit the weights by which a pair shows one place or two that look alike (`gsmap.register.look_alike`).

    python -m tools.bench.repetitive --cache FLATS --kinds "twin flats" "changed flats" --seeds 101 102 103 104
    python -m tools.bench.alike --cache STREETS --seed 7 --steps 60 --rooms 11
    python -m tools.make.verdict_places PLACES --set fit
    python -m tools.fit.look_alike FLATS/*flats* STREETS/* PLACES/fit/*

Each folder holds captures or their map (map.gsmap), and their true poses. Counted are aligned pairs that nothing but a
likeness of places speaks against, but not those of places with two wings that are exactly equal. One place and two
count equally; the errors are those of weights fitted without the pair's folder.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

import gsmap.map
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.register.look_alike import WEIGHTS, features
from gsmap.types import Sim3
from tools.harness import argument_parser
from tools.make.verdict_places import twin_m

_SAME_M, _SAME_DEG = 0.3, 5.0  # poses nearer to the truth show one place
_RIDGE = 0.05


class Pair(NamedTuple):
    """An aligned pair: its folder, whether it shows two places, and what it is told by."""

    folder: str
    is_two: bool
    similarity: float
    free_space_violation: float


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    folders_given = [folder for folder in parser.parse_args().folders if not _has_equal_wings(folder)]
    pairs = [pair for folder in folders_given for pair in aligned_pairs(folder)]
    is_two, folders = np.array([pair.is_two for pair in pairs]), np.array([pair.folder for pair in pairs])
    print(f"{len(pairs)} pairs, {is_two.sum()} of two places")
    known = np.array([features(pair.similarity, pair.free_space_violation) for pair in pairs])
    for has, in_use in WEIGHTS.items():
        rows = np.isfinite(known[:, has]).all(1)
        X, y = np.hstack([np.ones((rows.sum(), 1)), known[rows][:, has]]), is_two[rows]
        log_odds = np.zeros(len(X))
        for folder in np.unique(folders[rows]):
            left_out = folders[rows] == folder
            log_odds[left_out] = X[left_out] @ weights(X[~left_out], y[~left_out])
        wrong = [int(((log_odds > 0) & ~y).sum()), int(((log_odds <= 0) & y).sum())]
        print(
            f"{np.round(weights(X, y), 1)} (in use {in_use}): of {(~y).sum()} pairs of one place {wrong[0]} are taken"
        )
        print(f"    for two, of {y.sum()} of two {wrong[1]} for one")


def aligned_pairs(folder: Path) -> list[Pair]:
    """Return the pairs of a folder that are aligned, registered where they are not yet."""
    told = folder / "truth.json"
    truth = json.loads(told.read_text())["truth"] if told.exists() else _true_poses(folder / "truth")
    out = []
    with gsmap.map.open_or_create(folder / "map.gsmap") as m:
        if not m.scenes():
            m.ingest(*sorted(folder.glob("*.ply")))
        m.describe()
        m.register("all")
        names = {scene.id: scene.name for scene in m.scenes()}
        for registration in (one.registration for one in m.store.registrations.current()):
            S, evidence = registration.S_target_source, registration.evidence
            if S is None or registration.reason_code not in ("", "look_alike"):
                continue
            a, b = (Sim3.from_matrix(np.array(truth[names[id_]])) for id_ in (registration.target, registration.source))
            off = pose_error(S, a @ b.inverse(), scene_centroid(m.store.scenes.gaussians(registration.source)))
            is_two = not (off.centroid_m < _SAME_M and off.rre_deg < _SAME_DEG)
            out.append(Pair(str(folder), is_two, evidence["similarity"], evidence["free_space_violation"]))
    return out


def _has_equal_wings(folder: Path) -> bool:
    """Return whether a place of `tools.make.verdict_places` has a second wing that is equal to the first."""
    return folder.name.isdigit() and bool(np.isfinite(twin_m(int(folder.name))))


def _true_poses(folder: Path) -> dict[str, list[list[float]]]:
    """Return the true poses of captures by name."""
    told = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    return {name: one["T_scene_world"] for name, one in told.items() if "T_scene_world" in one}


def weights(X: np.ndarray, is_two: np.ndarray) -> np.ndarray:
    """Return the weights of a logistic regression in which both classes count equally."""
    sign, share = np.where(is_two, 1.0, -1.0), np.where(is_two, 0.5 / is_two.mean(), 0.5 / (~is_two).mean())

    def loss(w: np.ndarray) -> float:
        return float((share * np.logaddexp(0.0, -sign * (X @ w))).sum() + _RIDGE * (w[1:] ** 2).sum())

    found: np.ndarray = minimize(loss, np.zeros(X.shape[1])).x
    return found


if __name__ == "__main__":
    main()
