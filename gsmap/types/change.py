"""Changes between two captures of one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsmap.types.sim3 import Sim3

ChangeKind = Literal["appeared", "disappeared", "moved", "recoloured", "replaced", "lighting"]
"""``appeared`` and ``disappeared``: an object in one capture where the other capture shows free space. ``moved``: an
object that disappeared at one place and appeared at another. ``recoloured``: the same surface in another colour.
``replaced``: an object where the older capture shows another object. ``lighting``: the same surfaces under another
light; a change of the whole place, never of one object.
"""

Symmetry = Literal["none", "half", "any"]
"""The rotation about the vertical that leaves an object looking the same: none, half a turn, or any."""

SYMMETRIES: tuple[Symmetry, ...] = ("none", "half", "any")
CHANGE_KINDS: tuple[ChangeKind, ...] = ("appeared", "disappeared", "moved", "recoloured", "replaced", "lighting")


@dataclass(frozen=True, eq=False)
class Change:
    """One change from an older capture to a newer one, in the frame and unit of the comparison.

    Args:
        kind: the kind of change.
        box: (2, 3) float64 lowest and highest corner around the change.
        voxels: (K, 3) float32 centres of the changed cells, old and new.
        before: (I,) int32 Gaussians of the older capture that disappeared or look different.
        after: (J,) int32 Gaussians of the newer capture that appeared or look different.
        S_after_before: old to new pose of an object that moved; None for other kinds.
        symmetry: symmetry of an object that moved: ``none``, or the rotation about the vertical up to which its yaw is
            known, ``half`` or ``any``.
        confidence: probability in [0, 1] that something changed here, with a prior of one half.
        evidence: evidence values by name, such as the number of views that looked through.
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
    """The comparison of two captures.

    Args:
        changes: the changes, most confident first.
        seen_share: fraction of the older capture's surface that the newer one observed.
        gains: (3,) factors from the older capture's colours to the newer's.
        notes: remarks.
    """

    changes: tuple[Change, ...]
    seen_share: float
    gains: np.ndarray
    notes: tuple[str, ...] = ()
