"""Detect changes: the steps from two captures to a report of changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap import compare as comparison
from gsmap import render
from gsmap.change.candidates import find_changes
from gsmap.change.params import Params
from gsmap.change.reporting import detect_lighting_change, make_change, merge_pieces
from gsmap.change.segments import classify_cells, lighting_spread
from gsmap.change.surface_cells import compare_surfaces
from gsmap.errors import InputError
from gsmap.geometry.boxes import moved_box
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.methods import RecipeKey
from gsmap.types import PosedScene, Sim3
from gsmap.types.change import Change, ChangeReport
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 4
"""Version, raised whenever the report on the same two captures changes."""


def recipe_key(params: Params | None = None) -> RecipeKey:
    """Return the recipe of a report, without its inputs (the two captures)."""
    version = {"change": VERSION, "compare": comparison.VERSION}
    return RecipeKey("change", "evidence", version, plain(params or Params()), render.backend())


def compare(
    older: PosedScene,
    newer: PosedScene,
    params: Params | None = None,
    progress: Progress | None = None,
    *,
    up: np.ndarray | None = None,
) -> ChangeReport:
    """Detect the changes from an older capture of a place to a newer one.

    Only surfaces that both captures observed are judged; content that is occluded or unobserved in one of them is not
    reported.

    Args:
        older, newer: the captures, both in one metric frame.
        params: see `Params`.
        progress: called with the fraction done in [0, 1] and the current step.
        up: (3,) vertical of the frame, about which objects rotate and perpendicular to which they move; None for z.

    Returns:
        The report, in the frame of the captures.

    Raises:
        InputError: the vertical has length zero, or is not finite.
    """
    params, report = params or Params(), progress or silent
    # View-dependent colour is extrapolated where the other capture looks from, and most of the Gaussians' bytes.
    older, newer = (replace(scene, gaussians=scene.gaussians.degree_0()) for scene in (older, newer))
    upright = _upright(up)
    if upright is not None:
        older, newer = (_rotated(scene, upright) for scene in (older, newer))
    report(0.0, "rendering the older capture")
    views_older = comparison.render_views(older, longest_side_px=params.longest_side_px, max_views=params.max_views)
    report(0.15, "rendering the newer capture")
    views_newer = comparison.render_views(newer, longest_side_px=params.longest_side_px, max_views=params.max_views)
    report(0.3, "comparing both captures")
    found = comparison.observe(views_older, views_newer)
    report(0.7, "detecting changes")
    both = compare_surfaces(views_older, views_newer, found)
    cells = classify_cells(both)
    unlike = lighting_spread(both)
    ones = find_changes(both, cells, unlike, (views_older, views_newer), params)
    changes = [make_change(one, both, cells, params) for one in ones]
    changes = merge_pieces([c for c in changes if c.confidence >= params.min_confidence], params)
    other_light = detect_lighting_change(both, found.balance, unlike)
    changes += [other_light] if other_light is not None else []
    changes.sort(key=lambda c: (-c.confidence, c.box.tolist()))
    if upright is not None:
        changes = [_transformed(change, upright.inverse()) for change in changes]
    report(1.0, "changes found")
    seen = float(cells[0].judged.mean()) if len(both[0]) else 0.0
    return ChangeReport(tuple(changes), seen, found.balance.gains(), _notes(older, newer, seen))


def _notes(older: PosedScene, newer: PosedScene, seen: float) -> tuple[str, ...]:
    notes = []
    for when, scene in (("older", older), ("newer", newer)):
        if scene.cameras is None or not len(scene.cameras):
            notes.append(f"the {when} capture has no cameras, so free space is unknown and few changes can be detected")
    if seen < _LITTLE and not notes:
        notes.append(f"the newer capture observed only {100 * seen:.0f} % of the older capture's surface")
    return tuple(notes)


_LITTLE = 0.2


def _upright(up: np.ndarray | None) -> Sim3 | None:
    """Return the rotation from a vertical to z; None if the vertical is z already."""
    if up is None:
        return None
    up = np.asarray(up, dtype=np.float64).reshape(-1)
    length = np.linalg.norm(up)
    if up.shape != (3,) or not np.isfinite(length) or length < 1e-9:
        raise InputError(
            f"up must be three finite numbers that are not all zero, got {up.tolist()}", code="invalid_vector"
        )
    z = up / length
    if z[2] > 1 - 1e-9:
        return None
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Sim3(np.stack([x, np.cross(z, x), z]), np.zeros(3))


def _rotated(scene: PosedScene, S: Sim3) -> PosedScene:
    cameras = None if scene.cameras is None else transform_cameras(scene.cameras, S)
    return replace(scene, gaussians=transform_gaussians(scene.gaussians, S), cameras=cameras)


def _transformed(change: Change, S: Sim3) -> Change:
    """Transform a change to another frame; its new box encloses the transformed box."""
    moved = change.S_after_before
    return replace(
        change,
        box=moved_box(change.box, S),
        voxels=S.apply(change.voxels).astype(np.float32),
        S_after_before=None if moved is None else S @ moved @ S.inverse(),
    )
