"""Note how much overlapping captures without dates differ, since merging cannot tell which of them is newer."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from gsmap.store import Store
from gsmap.store.scenes import SceneSummary
from gsmap.types import Scene
from gsmap.types.registration import DEFORMATION_NOTES

_MIN_DIFFERENCE = 0.005  # smaller fractions of the surface would be printed as 0 %


def undated_notes(store: Store, scenes: Collection[Scene | SceneSummary]) -> tuple[str, ...]:
    """Return a note if registered pairs of the scenes differ and a scene of the pair has no date.

    Pairs that no rigid pose aligns do not count, as surfaces that lie apart are measured as a difference.
    """
    names = {scene.id: scene.name for scene in scenes}
    undated = {scene.id for scene in scenes if scene.captured_at is None}
    if not undated:
        return ()
    differences = {
        f"{names[edge.target]}:{names[edge.source]}": edge.disagreement
        for edge in store.registrations.summaries(usable=True)
        if {edge.target, edge.source} <= names.keys() and {edge.target, edge.source} & undated
    }
    differences = {pair: share for pair, share in differences.items() if share >= _MIN_DIFFERENCE}
    if differences:
        deformed = (one.registration for one in store.registrations.current_with_note(*DEFORMATION_NOTES))
        ends = {f"{names.get(one.target)}:{names.get(one.source)}" for one in deformed}
        differences = {pair: share for pair, share in differences.items() if pair not in ends}
    if not differences:
        return ()
    worst = max(differences, key=lambda pair: differences[pair])
    count, middle = len(differences), float(np.median(list(differences.values())))
    return (
        f"{count} pair{'s' * (count != 1)} of overlapping captures without dates differ{'s' * (count == 1)}: on "
        f"{middle:.1%} of the surface that both show (median), at most on {differences[worst]:.1%} ({worst}); where "
        "they differ a merge shows any of them; set dates with gsmap edit MAP SCENE --captured-at DATE",
    )
