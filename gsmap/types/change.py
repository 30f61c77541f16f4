"""What changed between two captures of one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsmap.types.sim3 import Sim3

ChangeKind = Literal["appeared", "disappeared", "moved", "recoloured", "replaced", "lighting"]
"""``appeared`` and ``disappeared``: a thing where the other capture looked through. ``moved``: both, and one thing.
``recoloured``: the same surface in another colour. ``replaced``: another thing where one stood. ``lighting``: the same
surfaces, lit otherwise; of the place, never of a thing."""

Symmetry = Literal["none", "half", "any"]
"""The turn about the vertical that nothing tells apart: none, half a turn, any."""

SYMMETRIES: tuple[Symmetry, ...] = ("none", "half", "any")
CHANGE_KINDS: tuple[ChangeKind, ...] = ("appeared", "disappeared", "moved", "recoloured", "replaced", "lighting")


@dataclass(frozen=True, eq=False)
class Change:
    """One change from an older capture to a newer one; all lengths and frames are those of the comparison.

    Args:
        kind: what happened.
        box: (2, 3) float64 lowest and highest corner around all that changed.
        voxels: (K, 3) float32 centres of the cells that changed, those left and those taken.
        before: (I,) int32 Gaussians of the older capture that are no longer there or no longer look so.
        after: (J,) int32 Gaussians of the newer capture that were not there or did not look so.
        S_after_before: of a thing that moved: takes a point of it from where it stood to where it stands.
        symmetry: of a thing that moved: ``none``, or the turn about the vertical that nothing tells apart, ``half`` or
            ``any``; its yaw is known up to that.
        confidence: in [0, 1], how probable it is that something changed here, of as many right ones as wrong.
        evidence: numbers behind it, by name, such as the views that looked through.
    """

    kind: ChangeKind
    box: np.ndarray
    voxels: np.ndarray
    before: np.ndarray
    after: np.ndarray
    S_after_before: Sim3 | None = None
    symmetry: Symmetry = "none"
    confidence: float = 0.0
    evidence: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ChangeReport:
    """What two captures say of each other.

    Args:
        changes: what changed, surest first.
        seen_share: share of the older capture's surface that the newer one looked at; of the rest nothing is said.
        gains: (3,) by which the older capture's colours are to be multiplied to look like the newer's.
        notes: what a person should know.
    """

    changes: tuple[Change, ...]
    seen_share: float
    gains: np.ndarray
    notes: tuple[str, ...] = ()
