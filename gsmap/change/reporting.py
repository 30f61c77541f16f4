"""Assemble reported changes: boxes, voxels, members, confidence and evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.confidence import confidence
from gsmap.change.kinds import DetectedChange
from gsmap.change.params import Params
from gsmap.change.segments import LIT_OTHERWISE, CellLabels
from gsmap.change.surface_cells import SurfaceCells
from gsmap.compare import Balance
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.types.change import Change

_GAIN = 0.08  # logarithm of an exposure gain that counts as different lighting
_BY_M = 0.15  # a change is a piece of a larger change of its kind if half of it is within this distance
_PRIOR_PIXELS = 10  # the mean difference of appearance is drawn to none as if by so many further pixels
_SLIVER_M = 0.07  # changes thinner than this in two directions are edges that two trainings place differently


def make_change(
    one: DetectedChange, both: tuple[SurfaceCells, SurfaceCells], cells: tuple[CellLabels, CellLabels], params: Params
) -> Change:
    """Convert a detected change to an entry of the report."""
    rows, seen = [], []
    for k in (0, 1):
        segment = one.segments[k]
        parts = [one.paint.cells[k]] if one.paint is not None else []
        parts += [segment.cells, segment.behind] if segment is not None else []
        rows.append(np.unique(np.concatenate(parts)) if parts else np.zeros(0, np.int64))
        seen.append(rows[k][cells[k].judged[rows[k]]])
    members = [side.rows[np.isin(side.label, r)] for side, r in zip(both, rows, strict=True)]
    points = np.concatenate([side.points[r] for side, r in zip(both, seen, strict=True)])
    grid = np.floor(points / params.voxel_m)
    voxels = (group_means(grid, *cell_labels(grid)) + 0.5) * params.voxel_m
    moved = [t.moved if t is not None else np.zeros(0, np.int64) for t in one.segments]
    through = sum(float(side.through[m].sum()) for side, m in zip(both, moved, strict=True))
    on = sum(float(side.on[m].sum()) for side, m in zip(both, moved, strict=True))
    count = sum(len(m) for m in moved)
    evidence = {
        "cells": float(len(points)),
        "looked_through": float(count),
        "views_through": through / max(count, 1),
        "views_on": on / max(count, 1),
        "strength": float(np.mean(np.concatenate([c.strength[r] for c, r in zip(cells, rows, strict=True)]))),
        "appearance": _appearance(both, moved if count else seen),
        "offset_m": float(np.median(np.r_[cells[0].offset_m[rows[0]], -cells[1].offset_m[rows[1]]])),
    } | one.evidence
    if one.paint is not None:
        evidence |= {"strength": one.paint.strength, "leak": one.paint.leak}
    evidence["slender"] = float(np.sort(np.ptp(points, axis=0))[1] < _SLIVER_M)
    return Change(
        one.kind,
        np.stack([points.min(0), points.max(0)]),
        voxels.astype(np.float32),
        members[0].astype(np.int32),
        members[1].astype(np.int32),
        one.S_after_before,
        one.symmetry,
        _confidence(one, evidence),
        evidence,
    )


def _appearance(both: tuple[SurfaceCells, SurfaceCells], rows: list[np.ndarray]) -> float:
    """Return how much cells differ from the other capture, relative to the smallest difference that counts, from the
    cameras of the capture that shows the smaller difference.

    Args:
        rows: cells of each capture.
    """
    strength = np.sum([side.appearance[r].sum(0) for side, r in zip(both, rows, strict=True)], axis=0)
    pixels = np.sum([side.appearance_pixels[r].sum(0) for side, r in zip(both, rows, strict=True)], axis=0)
    return float((strength / (pixels + _PRIOR_PIXELS)).min())


def merge_pieces(changes: Sequence[Change], params: Params) -> list[Change]:
    """Merge changes into nearby larger changes of the same kind; the pieces of moved objects are already merged."""
    out: list[Change] = []
    for change in sorted(changes, key=lambda c: (-len(c.voxels), c.box.tolist())):
        if change.kind != "moved" and len(change.voxels):
            for k, other in enumerate(out):
                near = cKDTree(other.voxels).query(change.voxels, distance_upper_bound=_BY_M)[0]
                if other.kind == change.kind and np.isfinite(near).mean() >= 0.5:
                    out[k] = _joined(other, change, params)
                    break
            else:
                out.append(change)
        else:
            out.append(change)
    return out


def _joined(whole: Change, piece: Change, params: Params) -> Change:
    """Merge a piece into a change; the confidence of the change stays."""
    every = np.concatenate([whole.voxels, piece.voxels])
    _, first = np.unique(np.floor(every / params.voxel_m), axis=0, return_index=True)
    return replace(
        whole,
        box=np.stack([np.minimum(whole.box[0], piece.box[0]), np.maximum(whole.box[1], piece.box[1])]),
        voxels=every[np.sort(first)],
        before=np.union1d(whole.before, piece.before),
        after=np.union1d(whole.after, piece.after),
    )


def _confidence(one: DetectedChange, evidence: dict[str, float]) -> float:
    """Return the confidence in [0, 1]; for a moved object it includes the fit at the new place."""
    sure = confidence(evidence)
    return sure * float(np.clip(evidence["fit"] / 0.8, 0, 1)) if one.kind == "moved" else sure


def detect_lighting_change(both: tuple[SurfaceCells, SurfaceCells], line: Balance, spread: float) -> Change | None:
    """Detect a change of lighting or exposure of the whole place; return None without one.

    Args:
        spread: spread of the lighting difference; see `gsmap.change.segments.lighting_spread`.
    """
    gains = np.abs(np.log(line.gains()))
    sure = float(1 - np.exp(-max(gains.max() / _GAIN, spread / LIT_OTHERWISE)))
    points = np.concatenate([side.points[side.pixels > 0] for side in both])
    if not len(points) or (gains.max() < _GAIN and spread < LIT_OTHERWISE):
        return None
    none = np.zeros(0, dtype=np.int32)
    evidence = {"gain": float(line.gains().mean()), "spread": spread}
    box = np.stack([points.min(0), points.max(0)])
    return Change("lighting", box, np.zeros((0, 3), np.float32), none, none, confidence=sure, evidence=evidence)
