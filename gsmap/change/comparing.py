"""From two captures to a report of what changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap import compare as comparison
from gsmap import render
from gsmap.change.finding import find_changes
from gsmap.change.params import Params
from gsmap.change.reporting import change_of, lighting, with_pieces
from gsmap.change.sides import sides
from gsmap.change.things import judge, light
from gsmap.errors import InputError
from gsmap.geometry.boxes import moved_box
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.methods import RecipeKey
from gsmap.types import PlacedScene, Sim3
from gsmap.types.change import Change, ChangeReport
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 2
"""Raised whenever a report comes out otherwise for the same two captures."""


def recipe_key(params: Params | None = None) -> RecipeKey:
    """What names every report that is made in this way; the two captures are added by whoever knows them."""
    version = {"change": VERSION, "compare": comparison.VERSION}
    return RecipeKey("change", "evidence", version, plain(params or Params()), render.backend())


def compare(
    older: PlacedScene,
    newer: PlacedScene,
    params: Params | None = None,
    progress: Progress | None = None,
    *,
    up: np.ndarray | None = None,
) -> ChangeReport:
    """What changed from an older capture of a place to a newer one.

    Only what both captures saw is judged. What one of them hides behind something, or never looked at, has not changed
    as far as anybody can tell, and is not reported.

    Args:
        older, newer: both in one metric frame.
        params: see `Params`.
        progress: told the fraction done in [0, 1] and what is being done.
        up: (3,) the frame's vertical; z for None. Things move along the floor and turn about it.

    Returns:
        The report, in the frame of the captures.

    Raises:
        InputError: a vertical of length zero, or not finite.
    """
    params, report = params or Params(), progress or silent
    upright = _upright(up)
    if upright is not None:
        older, newer = (_turned(scene, upright) for scene in (older, newer))
    report(0.0, "looking at the older capture")
    looks_older = comparison.look(older, longest_side_px=params.longest_side_px, max_views=params.max_views)
    report(0.15, "looking at the newer capture")
    looks_newer = comparison.look(newer, longest_side_px=params.longest_side_px, max_views=params.max_views)
    report(0.3, "comparing what both show")
    found = comparison.compare(looks_older, looks_newer)
    report(0.7, "finding what changed")
    both = sides(looks_older, looks_newer, found)
    cells = judge(both)
    unlike = light(both)
    ones = find_changes(both, cells, unlike, (looks_older, looks_newer), params)
    changes = [change_of(one, both, cells, params) for one in ones]
    changes = with_pieces([c for c in changes if c.confidence >= params.min_confidence], params)
    other_light = lighting(both, found.balance, unlike)
    changes += [other_light] if other_light is not None else []
    changes.sort(key=lambda c: (-c.confidence, c.box.tolist()))
    if upright is not None:
        changes = [_back(change, upright.inverse()) for change in changes]
    report(1.0, "changes found")
    seen = float(cells[0].judged.mean()) if len(both[0]) else 0.0
    return ChangeReport(tuple(changes), seen, found.balance.gains(), _notes(older, newer, seen))


def _notes(older: PlacedScene, newer: PlacedScene, seen: float) -> tuple[str, ...]:
    notes = []
    for when, scene in (("older", older), ("newer", newer)):
        if scene.cameras is None or not len(scene.cameras):
            notes.append(f"the {when} capture has no cameras: nobody knows what it looked at, so little can be said")
    if seen < _LITTLE and not notes:
        notes.append(f"the newer capture looked at only {100 * seen:.0f} % of what the older one shows")
    return tuple(notes)


_LITTLE = 0.2


def _upright(up: np.ndarray | None) -> Sim3 | None:
    """The turn that brings a vertical to z; None where it is z already."""
    if up is None:
        return None
    up = np.asarray(up, dtype=np.float64).reshape(-1)
    length = np.linalg.norm(up)
    if up.shape != (3,) or not np.isfinite(length) or length < 1e-9:
        raise InputError(f"up must be three finite numbers that are not all zero, got {up.tolist()}")
    z = up / length
    if z[2] > 1 - 1e-9:
        return None
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Sim3(np.stack([x, np.cross(z, x), z]), np.zeros(3))


def _turned(scene: PlacedScene, S: Sim3) -> PlacedScene:
    cameras = None if scene.cameras is None else transform_cameras(scene.cameras, S)
    return replace(scene, gaussians=transform_gaussians(scene.gaussians, S), cameras=cameras)


def _back(change: Change, S: Sim3) -> Change:
    """A change in another frame; its box is the one around the turned box."""
    moved = change.S_after_before
    return replace(
        change,
        box=moved_box(change.box, S),
        voxels=S.apply(change.voxels).astype(np.float32),
        S_after_before=None if moved is None else S @ moved @ S.inverse(),
    )
