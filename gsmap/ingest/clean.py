"""Remove what is no surface from a capture: invalid values, impossible scales, floaters, background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.geometry.boxes import inside
from gsmap.geometry.floaters import find_detached
from gsmap.ingest.validate import invalid_rows, oversized_rows
from gsmap.types import Gaussians

_KINDS = {
    "invalid": "with invalid values",
    "oversized": "with impossible scales",
    "outside": "outside the box",
    "background": "of the background",
    "floaters": "floaters",
}


@dataclass(frozen=True, eq=False)
class CleanResult:
    """The cleaned Gaussians of a capture.

    Args:
        gaussians: remaining Gaussians, in their order.
        removed: number of removed Gaussians by kind: ``invalid`` (NaN, an infinity that is no value, a rotation of
            zero), ``oversized`` (a scale that no scene has), ``outside`` the box, ``background`` (a shell far around
            all surfaces), ``floaters`` (that belong to no surface).
        is_judged: false if the Gaussians do not overlap into surfaces, so that floaters and background cannot be told.
    """

    gaussians: Gaussians
    removed: dict[str, int]
    is_judged: bool

    @property
    def note(self) -> str:
        """One line that says how many Gaussians of each kind were removed."""
        listed = ", ".join(f"{count} {_KINDS[kind]}" for kind, count in self.removed.items() if count)
        total = sum(self.removed.values())
        note = f"cleaned: {total} of {total + len(self.gaussians)} Gaussians were removed"
        note += f" ({listed})" if listed else ""
        if not self.is_judged:
            note += "; floaters and background were not looked for, as its Gaussians do not overlap into surfaces"
        return note


def clean(gaussians: Gaussians, bbox: Sequence[float] | None = None, *, where: str = "the capture") -> CleanResult:
    """Remove invalid Gaussians, impossible scales, Gaussians outside a box, background and floaters, in this order.

    Args:
        bbox: lowest and highest corner, ``x0 y0 z0 x1 y1 z1`` in the coordinates of the file; None for no box.
        where: name of the capture in messages.

    Raises:
        ConfigError: the box is empty.
        InputError: no Gaussian remains.
    """
    box = None if bbox is None else _checked_box(bbox)
    left, removed = gaussians, dict.fromkeys(_KINDS, 0)
    for kind, find in (
        ("invalid", invalid_rows),
        ("oversized", oversized_rows),
        ("outside", lambda g: ~inside(g.positions, box)),
    ):
        bad = find(left)
        removed[kind] = int(bad.sum())
        left = left[~bad] if removed[kind] else left
        if not len(left):
            raise InputError(f"no Gaussian of {where} remains after cleaning", code="no_gaussians")
    detached = find_detached(left)
    if detached is None:
        return CleanResult(left, removed, is_judged=False)
    floaters, background = detached
    removed |= {"background": int(background.sum()), "floaters": int(floaters.sum())}
    return CleanResult(left[~(floaters | background)], removed, is_judged=True)


def _checked_box(bbox: Sequence[float]) -> np.ndarray:
    box: np.ndarray = np.reshape(np.asarray(bbox, np.float64), (2, 3))
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise ConfigError(
            f"the box {' '.join(f'{value:g}' for value in bbox)} is empty: x0 y0 z0 must be below x1 y1 z1 on every "
            "axis",
            code="invalid_box",
        )
    return box
