"""Scores of merging and of change detection against the truth that tools/make/change.py writes.

All takes plain arrays, in the place's frame (metres) unless it says otherwise; `Truth.T_place_scene` brings things of a
capture there. Only what both captures observed counts as a change: nobody can know the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsmap.geometry.transforms import transform_gaussians
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic.change import PIXEL_KINDS, pixel_kinds
from tools.make.change_truth import VOXEL_M, Truth, changed_voxels, looked_through, observed, owners, projected

_MIN_VOXELS = 5  # of which less was seen by both captures is no change that must be found


# --- changes ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Claim:
    """A change that something claims to have found.

    Args:
        kind: appeared, disappeared, moved, recoloured, replaced or lighting (which claims no change of any thing).
        voxels_m: (n, 3) centres of the voxels that changed, of `VOXEL_M` or smaller; of what moved, before and after.
        S_after_before: (4, 4) of what moved, else None.
        symmetry: of what moved, what it says of itself: "none", "half" or "any".
    """

    kind: str
    voxels_m: np.ndarray
    S_after_before: np.ndarray | None = None
    symmetry: str = "none"


def read_claims(entries: Sequence[Mapping[str, Any]], S_place_frame: Sim3) -> list[Claim]:
    """Claims from rows (``kind``, ``voxels_m``, perhaps ``S_after_before``) in another frame, say the newest's."""
    S = S_place_frame.matrix()
    claims = []
    for entry in entries:
        moved = entry.get("S_after_before")
        T = None if moved is None else S @ np.array(moved) @ np.linalg.inv(S)
        voxels = S_place_frame.apply(np.array(entry["voxels_m"], np.float64).reshape(-1, 3))
        claims.append(Claim(entry["kind"], voxels, T, entry.get("symmetry", "none")))
    return claims


def claims_of(changes: Iterable[Any], S_place_frame: Sim3) -> list[Claim]:
    """The same from gsmap's own changes."""
    rows = (
        {
            "kind": c.kind,
            "voxels_m": c.voxels,
            "S_after_before": None if c.S_after_before is None else c.S_after_before.matrix(),
            "symmetry": c.symmetry,
        }
        for c in changes
    )
    return read_claims(list(rows), S_place_frame)


def score_changes(truth: Truth, before: str, after: str, claims: Sequence[Claim]) -> dict[str, Any]:
    """How right claims are; counts, so that places can be added up, and the rates of this pair.

    An object is found where 30 % of its voxels lie within 10 cm of any claim; a claim is right where 50 % of its voxels
    lie within 15 cm of any true change, else false. ``iou`` takes 10 cm as the same place. The kind of a found object
    is that of the claim which covers most of it. What moved is right within 10 cm and 10 degrees, for symmetric things
    up to their symmetry.
    """
    true = changed_voxels(truth, before, after)
    must = [(change, voxels) for change, voxels in true if len(voxels) >= _MIN_VOXELS]
    claims = [c for c in claims if c.kind != "lighting" and len(c.voxels_m)]
    all_true = _stacked([v for _, v in true])
    all_claimed = _stacked([c.voxels_m for c in claims])
    right = [bool((distances(c.voxels_m, all_true) <= 0.15).mean() >= 0.5) for c in claims]
    objects, moves = [], {"moved_true": 0, "moved_right": 0, "moved_symmetric": 0, "moved_symmetric_right": 0}
    moves["moved_symmetric_said"] = 0
    answered = set()
    for change, voxels in must:
        near = [(distances(voxels, c.voxels_m) <= VOXEL_M).mean() for c in claims]
        covered = float((distances(voxels, all_claimed) <= VOXEL_M).mean())
        best = int(np.argmax(near)) if near and max(near) > 0 else -1
        found = covered >= 0.3
        named = claims[best].kind if found and best >= 0 else None
        row = {"name": change["name"], "kind": change["kind"], "voxels": len(voxels), "covered": covered}
        row |= {"found": found, "named": named, "kind_right": named in _accepted(change)}
        if change["kind"] == "moved":
            symmetric = change["symmetry"] != "none"
            errors = [
                (k, *move_error(change, c.S_after_before))
                for k, c in enumerate(claims)
                if c.S_after_before is not None and near[k] > 0.1
            ]
            good = [k for k, metres, degrees in errors if metres <= 0.1 and degrees <= 10]
            answered |= set(good)
            moves["moved_symmetric" if symmetric else "moved_true"] += 1
            moves["moved_symmetric_right" if symmetric else "moved_right"] += bool(good)
            moves["moved_symmetric_said"] += symmetric and any(claims[k].symmetry != "none" for k in good)
            row["move_errors"] = [(round(metres, 3), round(degrees, 1)) for _, metres, degrees in errors]
        objects.append(row)
    claimed = [k for k, c in enumerate(claims) if c.S_after_before is not None]
    precision = float((distances(all_claimed, all_true) <= VOXEL_M).mean()) if len(all_claimed) else 1.0
    must_voxels = _stacked([v for _, v in must])
    recall = float((distances(must_voxels, all_claimed) <= VOXEL_M).mean()) if len(must_voxels) else 1.0
    both = precision * recall
    return {
        "objects": len(must),
        "found": sum(o["found"] for o in objects),
        "kind_right": sum(o["kind_right"] for o in objects),
        "claims": len(claims),
        "right": sum(right),
        "false": len(claims) - sum(right),
        "precision": precision,
        "recall": recall,
        "iou": both / (precision + recall - both) if both else 0.0,
        **moves,
        "moved_claimed": len(claimed),
        "moved_wrong": len([k for k in claimed if k not in answered]),
        "rows": objects,
        "claim_rows": [
            {"kind": c.kind, "voxels": len(c.voxels_m), "right": r, "middle_m": c.voxels_m.mean(0).round(2).tolist()}
            for c, r in zip(claims, right, strict=True)
        ],
    }


def move_error(change: Mapping[str, Any], S_after_before: np.ndarray | None) -> tuple[float, float]:
    """Metres at the thing's middle, and degrees, between the true move and another; the best its symmetry allows."""
    if S_after_before is None:
        return float("inf"), float("inf")
    true, middle = np.array(change["S_after_before"]), np.append(change["middle_m"], 1.0)
    metres = float(np.linalg.norm(((S_after_before - true) @ middle)[:3]))
    turn = S_after_before[:3, :3] @ true[:3, :3].T
    upright = float(np.degrees(np.arccos(np.clip(turn[2, 2] / np.cbrt(np.linalg.det(turn)), -1, 1))))
    if change["symmetry"] == "any":
        return metres, upright
    turns = [np.eye(3), np.diag([-1.0, -1, 1])] if change["symmetry"] == "half" else [np.eye(3)]
    return metres, min(_degrees(turn @ t) for t in turns)


def _degrees(R: np.ndarray) -> float:
    R = R / np.cbrt(np.linalg.det(R))
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _accepted(change: Mapping[str, Any]) -> set[str]:
    """What a change may be called: what is replaced by a thing of the same shape may be called recoloured."""
    if change["kind"] == "replaced":
        sizes = [np.ptp(np.array(change[key]), axis=0) for key in ("box_before_m", "box_after_m")]
        if np.abs(sizes[0] - sizes[1]).max() < 0.05:
            return {"replaced", "recoloured"}
    return {change["kind"]}


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(parts) if len(parts) else np.zeros((0, 3))


def distances(points: np.ndarray, to: np.ndarray) -> np.ndarray:
    if not len(to) or not len(points):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(to).query(points, distance_upper_bound=1.0)[0])


# --- merging ----------------------------------------------------------------------------------------------------------


def masks(truth: Truth, time: str, others: Sequence[str]) -> np.ndarray:
    """(C, H, W) indices into `PIXEL_KINDS` of a capture's pixels against any of the other times."""
    views = truth.views(time)
    kinds = [pixel_kinds(views.ids, truth.views(time, of).ids, truth.states(time), truth.states(of)) for of in others]
    order = np.array([0, 3, 2, 1])  # new before recoloured before vacated before same
    return order[np.max([order[k] for k in kinds], axis=0)]


def pictures(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """(C, H, W, 3) renders in [0, 1]; both in one frame."""
    rows = (render(gaussians, cameras[[i]], depth=False, dominant_id=False).colour[0] for i in range(len(cameras)))
    return np.clip(np.stack(list(rows)), 0, 1)


def psnr_by_kind(pictures: np.ndarray, photographs: np.ndarray, kinds: np.ndarray) -> dict[str, float]:
    """PSNR over all pixels of each of `PIXEL_KINDS`, of all that changed, and of all; NaN where there are none."""
    error = ((pictures - photographs) ** 2).mean(-1)
    picks = {name: kinds == k for k, name in enumerate(PIXEL_KINDS)} | {"changed": kinds > 0, "all": kinds >= 0}
    with np.errstate(divide="ignore", invalid="ignore"):
        return {n: float(-10 * np.log10(error[p].mean())) if p.any() else float("nan") for n, p in picks.items()}


def old_mix_new(merged: np.ndarray, old: np.ndarray, new: np.ndarray, kinds: np.ndarray) -> tuple[float, float, float]:
    """Of changed pixels where the captures alone clearly differ, the shares in which a merged map shows which.

    ``old`` and ``new`` are the captures' own pictures. A pixel's colour is projected on the line from old to new: below
    a quarter it shows the old, above three quarters the new, else a mix.
    """
    way = new - old
    length = (way**2).sum(-1)
    clear = (kinds > 0) & (length > 0.2**2)
    along = ((merged - old) * way).sum(-1)[clear] / length[clear]
    if not len(along):
        return 0.0, 0.0, 1.0
    return float((along < 0.25).mean()), float(((along >= 0.25) & (along <= 0.75)).mean()), float((along > 0.75).mean())


def score_merge(
    truth: Truth, newest: str, older: Sequence[str], merged: Gaussians, S_place_merged: Sim3 | None = None
) -> dict[str, Any]:
    """A merged map at the newest photographs: `psnr_by_kind` of all and of the held-out ones, and `old_mix_new`.

    ``S_place_merged`` brings the map to the place's frame; without it it is there already.
    """
    placed = merged if S_place_merged is None else transform_gaussians(merged, S_place_merged)
    cameras, photographs, held = truth.cameras(newest), truth.photographs(newest), truth.held_out(newest)
    kinds = masks(truth, newest, older)
    shown = pictures(placed, cameras)
    own = {time: pictures(truth.gaussians(time), cameras) for time in (older[-1], newest)}
    shares = old_mix_new(shown, own[older[-1]], own[newest], masks(truth, newest, older[-1:]))
    return {
        "psnr": psnr_by_kind(shown, photographs, kinds),
        "held": psnr_by_kind(shown[held], photographs[held], kinds[held]),
        "old_mix_new": shares,
        "gaussians": len(merged),
    }


def score_drops(truth: Truth, newest: str, older: str, dropped: np.ndarray) -> dict[str, float]:
    """Of an older capture's Gaussians (in the order of its file), which were rightly or falsely dropped.

    Args:
        dropped: (n,) bool.

    Returns:
        ``gone``: of those on things that went (disappeared, moved, replaced) where the newest looked, the share
        dropped; ``painted``: of those on what was painted; ``false``: of those on what stayed and more than 10 cm from
        any thing that changed; ``false_unlit``: of these without those that the two captures' photographs show in two
        colours, as what was painted or taken away near by lights them otherwise; and how many each is a share of
        (``n_gone, n_painted, n_false, n_false_unlit``).
    """
    means = truth.gaussians(older).means
    owner, seen = owners(truth, older, means), observed(truth, newest, means)
    changes = truth.changes(older, newest)
    gone = [c["before"] for c in changes if c["kind"] in ("disappeared", "moved", "replaced")]
    painted = [c["before"] for c in changes if c["kind"] == "recoloured"]
    near = np.zeros(len(means), bool)
    for change in changes:
        for box in (change["box_before_m"], change["box_after_m"]):
            if box is not None:
                low, high = np.array(box)
                near |= ((means > low - 0.1) & (means < high + 0.1)).all(1)
    picks = {
        "gone": np.isin(owner, gone) & seen,
        "painted": np.isin(owner, painted) & seen,
        "false": (owner >= 0) & ~near,
    }
    picks["false_unlit"] = picks["false"].copy()
    wrong = np.flatnonzero(picks["false"] & dropped)
    picks["false_unlit"][wrong] = ~lit_otherwise(truth, older, newest, means[wrong])
    out = {name: float(dropped[p].mean()) if p.any() else float("nan") for name, p in picks.items()}
    return out | {f"n_{name}": int(p.sum()) for name, p in picks.items()}


_LIT = 0.035  # difference of colour, of [0, 1] and exposure balanced, that photographs of one surface seldom have


def lit_otherwise(truth: Truth, older: str, newest: str, points: np.ndarray) -> np.ndarray:
    """(n,) whether the photographs of two captures show points on surfaces that stayed in two colours."""
    shown = [photographed(truth, time, points) for time in (older, newest)]
    seen = np.isfinite(shown[0]).all(1) & np.isfinite(shown[1]).all(1)
    # Exposure: the median ratio over the capture's own surfaces.
    sample = truth.gaussians(older).means[::20]
    a, b = (photographed(truth, time, sample) for time in (older, newest))
    gain = np.nanmedian(b / np.maximum(a, 0.02), axis=0)
    out = np.zeros(len(points), bool)
    out[seen] = np.abs(shown[1][seen] - shown[0][seen] * gain).max(1) > _LIT
    return out


def photographed(truth: Truth, time: str, points: np.ndarray) -> np.ndarray:
    """(n, 3) mean colour in [0, 1] of points in the photographs of a capture that see them, NaN where none does."""
    views, photographs = truth.views(time), truth.photographs(time)
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for row, pixels, depth in projected(truth.cameras(time), points):
        at = pixels[:, 1], pixels[:, 0]
        on = (pixels >= 0).all(1) & (np.abs(depth - views.depths_m[row][at]) < 0.05)
        total[on] += photographs[row][at][on]
        count[on] += 1
    with np.errstate(invalid="ignore"):
        return np.where(count[:, None] > 0, total / count[:, None], np.nan)


def score_ghosts(truth: Truth, newest: str, older: str, merged_means: np.ndarray) -> dict[str, float]:
    """How much stands in the air that things left: of an older capture's Gaussians there, what share a map still has.

    The air that was left: within the box of what went (disappeared, moved, replaced), and looked through by the newest
    capture. ``left`` counts what the map has there beyond the newest capture's own, as a share of the older's.
    """
    gone = [c for c in truth.changes(older, newest) if c["kind"] in ("disappeared", "moved", "replaced")]

    def count(means: np.ndarray) -> int:
        boxes = [np.array(c["box_before_m"]) for c in gone]
        inside = np.any([((means > low) & (means < high)).all(1) for low, high in boxes], axis=0)
        return int(looked_through(truth, newest, means[inside]).sum())

    if not gone:
        return {"left": float("nan"), "n": 0}
    before, now, own = (count(m) for m in (truth.gaussians(older).means, merged_means, truth.gaussians(newest).means))
    return {"left": max(0, now - own) / max(1, before), "n": before}


def kept_rows(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(n,) whether rows of means (n, 3) are still there, unmoved, among others (m, 3)."""
    return np.asarray(cKDTree(after).query(before, distance_upper_bound=1e-6)[0] < 1e-6)
