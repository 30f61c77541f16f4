"""Detect changes: the steps from two captures to a report of changes."""

from __future__ import annotations

from dataclasses import replace

from gsmap import compare as comparison
from gsmap import render
from gsmap.change.candidates import find_changes
from gsmap.change.params import Params
from gsmap.change.reporting import detect_lighting_change, make_change, merge_pieces
from gsmap.change.segments import classify_cells, lighting_spread
from gsmap.change.surface_cells import compare_surfaces
from gsmap.methods import RecipeKey
from gsmap.types import PosedScene
from gsmap.types.change import ChangeReport
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 4
"""Version, raised whenever the report on the same two captures changes."""


def recipe_key(params: Params | None = None) -> RecipeKey:
    """Return the recipe of a report, without its inputs (the two captures)."""
    version = {"change": VERSION, "compare": comparison.VERSION}
    return RecipeKey("change", "evidence", version, plain(params or Params()), render.backend())


def compare(
    older: PosedScene, newer: PosedScene, params: Params | None = None, progress: Progress | None = None
) -> ChangeReport:
    """Detect the changes from an older capture of a place to a newer one.

    Only surfaces that both captures observed are judged; content that is occluded or unobserved in one of them is not
    reported.

    Args:
        older, newer: the captures, both in one metric frame whose z axis points up.
        params: see `Params`.
        progress: called with the fraction done in [0, 1] and the current step.

    Returns:
        The report, in the frame of the captures.
    """
    params, report = params or Params(), progress or silent
    # View-dependent colour is extrapolated where the other capture looks from, and most of the Gaussians' bytes.
    older, newer = (replace(scene, gaussians=scene.gaussians.degree_0()) for scene in (older, newer))
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
