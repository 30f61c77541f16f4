"""Scores of merging and of change detection against the truth that tools/make_change.py writes.

All takes plain arrays, in the place's frame (metres) unless it says otherwise; `Truth.T_place_scene` brings things of a
capture there. Only what both captures observed counts as a change: nobody can know the rest.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from gsmap import formats
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic.change import PIXEL_KINDS, pixel_kinds, true_changes

VOXEL_M = 0.1
_SEEN_M = 0.05  # so far before a surface counts as seen; half a voxel
_MIN_VOXELS = 5  # of which less was seen by both captures is no change that must be found
_MIN_POINTS = 2  # in a voxel, of pixels thinned to 2.5 cm


@dataclass(frozen=True, eq=False)
class Views:
    """What all cameras of one capture look at, at one time: ids (C, H, W) and depths (C, H, W), 0 for nothing."""

    ids: np.ndarray
    depths_m: np.ndarray


@dataclass(eq=False)
class Truth:
    """The folder of one place of tools/make_change.py, read as it is asked for."""

    folder: Path
    _views: dict[tuple[str, str], Views] = field(default_factory=dict)
    _clouds: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @cached_property
    def times(self) -> list[str]:
        """Names of the captures, oldest first."""
        return list(json.loads((self.folder / "truth" / "changes.json").read_text())["times"])

    @cached_property
    def _facts(self) -> dict[str, dict[str, Any]]:
        return {t: json.loads((self.folder / "truth" / f"{t}.json").read_text()) for t in self.times}

    def states(self, time: str) -> list[dict[str, Any]]:
        """See `gsmap_synthetic.change.states`."""
        return self._facts[time]["objects"]

    def T_place_scene(self, time: str) -> Sim3:
        """From a capture's frame to the place's."""
        return Sim3.from_matrix(np.array(self._facts[time]["T_scene_world"])).inverse()

    def gaussians(self, time: str) -> Gaussians:
        """A capture's Gaussians, place frame."""
        return transform_gaussians(formats.read(self.folder / f"{time}.ply"), self.T_place_scene(time))

    def cameras(self, time: str) -> Cameras:
        """A capture's cameras, place frame."""
        cameras = formats.read_cameras(self.folder / f"{time}.cameras.json")
        return transform_cameras(cameras, self.T_place_scene(time))

    def held_out(self, time: str) -> np.ndarray:
        """(C,) bool, which cameras of a capture it was not trained on."""
        return np.isin(self.cameras(time).names, self._facts[time]["held_out"])

    def photographs(self, time: str) -> np.ndarray:
        """(C, H, W, 3) float32 in [0, 1]."""
        names = self.cameras(time).names
        pictures = [np.asarray(Image.open(self.folder / "frames" / f"{name}.jpg")) for name in names]
        return np.stack(pictures) / np.float32(255)

    def views(self, time: str, of: str | None = None) -> Views:
        """What the cameras of a capture would have seen at the time ``of`` (by default their own)."""
        key = time, of or time
        if key not in self._views:
            files = [np.load(self.folder / "truth" / "masks" / f"{name}.npz") for name in self.cameras(time).names]
            ids = np.stack([f[f"ids_{key[1]}"] for f in files])
            self._views[key] = Views(ids, np.stack([f[f"depth_mm_{key[1]}"] for f in files]) / np.float32(1000))
        return self._views[key]

    def changes(self, before: str, after: str) -> list[dict[str, Any]]:
        """See `gsmap_synthetic.change.true_changes`."""
        return true_changes(self.states(before), self.states(after))


# --- what was seen ----------------------------------------------------------------------------------------------------


def observed(truth: Truth, time: str, points: np.ndarray) -> np.ndarray:
    """(n,) whether a capture looked at points or through them."""
    views, seen = truth.views(time), np.zeros(len(points), bool)
    for row, pixels, depth in _projected(truth.cameras(time), points):
        at = views.depths_m[row][pixels[:, 1], pixels[:, 0]]
        seen |= (depth > 0.05) & (depth < at + _SEEN_M) & (pixels >= 0).all(1)
    return seen


def owners(truth: Truth, time: str, points: np.ndarray) -> np.ndarray:
    """(n,) ids of the objects that points of a capture (its Gaussians' means, say) lie on, by its own views."""
    views = truth.views(time)
    votes = np.zeros((len(points), max(s["id"] for s in truth.states(time)) + 1), np.uint16)
    for row, pixels, depth in _projected(truth.cameras(time), points):
        ids = views.ids[row][pixels[:, 1], pixels[:, 0]]
        on = np.abs(depth - views.depths_m[row][pixels[:, 1], pixels[:, 0]]) < _SEEN_M
        rows = np.flatnonzero(on & (ids >= 0) & (pixels >= 0).all(1))
        votes[rows, ids[rows]] += 1
    return np.where(votes.any(1), votes.argmax(1), -1)


def _projected(cameras: Cameras, points: np.ndarray):
    """For each camera its row, the pixels (n, 2) that points fall on, -1 where outside, and their depths (n,)."""
    for row in range(len(cameras)):
        T = np.linalg.inv(cameras.T_frame_camera[row])
        local = points @ T[:3, :3].T + T[:3, 3]
        depth = local[:, 2]
        fx, fy, cx, cy = cameras.intrinsics_px[row]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.stack([fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy], axis=1)
        inside = (depth > 0.05) & (at >= 0).all(1) & (at < cameras.sizes_px[row]).all(1)
        yield row, np.where(inside[:, None], at, -1).astype(np.int64), depth


def changed_voxels(truth: Truth, before: str, after: str) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Each true change and the centres (n, 3) of the voxels of `VOXEL_M` where both captures could see it.

    The surfaces it had as the older capture saw them where the newer looked, and those it has as the newer sees them
    where the older looked.
    """
    out = []
    clouds = {time: _cloud(truth, time) for time in (before, after)}
    changes = truth.changes(before, after)
    for change in changes:
        parts = []
        for time, key, other in ((before, "before", after), (after, "after", before)):
            points, ids = clouds[time]
            own = points[ids == change[key]] if change[key] is not None else points[:0]
            parts.append(own[observed(truth, other, own)])
        cells, counts = np.unique(np.floor(np.concatenate(parts) / VOXEL_M), axis=0, return_counts=True)
        out.append((change, (cells[counts >= _MIN_POINTS] + 0.5) * VOXEL_M))
    return out


def _cloud(truth: Truth, time: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) that a capture saw, thinned to 2.5 cm, and the ids of their objects."""
    if time not in truth._clouds:
        views, cameras = truth.views(time), truth.cameras(time)
        height, width = views.ids.shape[1:]
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        points, ids = [], []
        for row in range(len(cameras)):
            fx, fy, cx, cy = cameras.intrinsics_px[row]
            depth = views.depths_m[row]
            local = np.stack([(x - cx) / fx * depth, (y - cy) / fy * depth, depth], axis=-1)[depth > 0]
            T = cameras.T_frame_camera[row]
            cloud, owner = _thinned(local @ T[:3, :3].T + T[:3, 3], views.ids[row][depth > 0])
            points.append(cloud)
            ids.append(owner)
        truth._clouds[time] = _thinned(np.concatenate(points), np.concatenate(ids))
    return truth._clouds[time]


def _thinned(points: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One point of each object in each cube of 2.5 cm."""
    cells = np.floor(points / 0.025).astype(np.int64) + (1 << 15)
    keys = ((cells[:, 0] << 48) | (cells[:, 1] << 32) | (cells[:, 2] << 16)) + ids
    _, first = np.unique(keys, return_index=True)
    return points[first], ids[first]


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
    right = [bool((_distances(c.voxels_m, all_true) <= 0.15).mean() >= 0.5) for c in claims]
    objects, moves = [], {"moved_true": 0, "moved_right": 0, "moved_symmetric": 0, "moved_symmetric_right": 0}
    moves["moved_symmetric_said"] = 0
    answered = set()
    for change, voxels in must:
        near = [(_distances(voxels, c.voxels_m) <= VOXEL_M).mean() for c in claims]
        covered = float((_distances(voxels, all_claimed) <= VOXEL_M).mean())
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
    precision = float((_distances(all_claimed, all_true) <= VOXEL_M).mean()) if len(all_claimed) else 1.0
    must_voxels = _stacked([v for _, v in must])
    recall = float((_distances(must_voxels, all_claimed) <= VOXEL_M).mean()) if len(must_voxels) else 1.0
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


def _distances(points: np.ndarray, to: np.ndarray) -> np.ndarray:
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
        any thing that changed; and how many each is a share of (``n_gone, n_painted, n_false``).
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
    out = {name: float(dropped[p].mean()) if p.any() else float("nan") for name, p in picks.items()}
    return out | {f"n_{name}": int(p.sum()) for name, p in picks.items()}


def kept_of(older: Gaussians, merged_means: np.ndarray, within_m: float = 0.02) -> np.ndarray:
    """(n,) whether a merged map still has a Gaussian where an older capture's stood; both in one frame.

    For maps that do not tell: what optimisation moved by more than ``within_m`` counts as dropped.
    """
    return np.asarray(cKDTree(merged_means).query(older.means, distance_upper_bound=within_m)[0] <= within_m)
