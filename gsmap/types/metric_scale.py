"""The metric scale of a component of the map, with its uncertainty and source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gsmap.errors import InputError

KnownBy = Literal["surveyed", "measured", "told", "assumed", "guessed", "unknown"]

_ROUGH_SIGMA = 0.2  # above it, an error is reported as a factor, not in percent

KNOWN_BY: tuple[KnownBy, ...] = get_args(KnownBy)


def as_known_by(text: str) -> KnownBy:
    """Check that a text read from a file is one of `KNOWN_BY`, and return it.

    Raises:
        InputError: another word.
    """
    for known in KNOWN_BY:
        if text == known:
            return known
    raise InputError(
        f"the source of a metric scale must be one of {', '.join(KNOWN_BY)}, got {text!r}", code="invalid_metre"
    )


@dataclass(frozen=True)
class MetricScale:
    """The metric scale of a component; each component has a unit of its own.

    Args:
        metres_per_unit: metres per unit of the component's frame.
        sigma: standard deviation of its logarithm, 0.01 is one percent; infinite if unknown.
        known_by: ``surveyed`` (control points, positions or scale bars), ``measured`` (captures specified to be in
            metres), ``told`` (metres per unit specified by the user), ``assumed`` (the captures' unit may be the
            metre), ``guessed`` (from distances between cameras and surfaces, good to a factor of about two),
            ``unknown`` (1 is used).
        note: remark for the user, or empty.
    """

    metres_per_unit: float = 1.0
    sigma: float = float("inf")
    known_by: KnownBy = "unknown"
    note: str = ""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.metres_per_unit) and self.metres_per_unit > 0):
            raise InputError(f"metres per unit must be positive, got {self.metres_per_unit}", code="invalid_metre")
        as_known_by(self.known_by)

    @property
    def is_known(self) -> bool:
        """True unless the scale is unknown."""
        return self.known_by != "unknown"

    @property
    def is_rough(self) -> bool:
        """True if the scale is unknown, or known only to within a factor."""
        return self.sigma > _ROUGH_SIGMA

    def text(self) -> str:
        """Return a text such as ``0.3 m per unit, told, to within 1 %``."""
        if not self.is_known:
            return "unknown, 1 m per unit is used"
        if self.is_rough:
            bar = f"a factor of {np.exp(self.sigma):.2g}"
            return f"{self.metres_per_unit:.2g} m per unit, {self.known_by}, to within {bar}"
        return f"{self.metres_per_unit:.4g} m per unit, {self.known_by}, to within {100 * self.sigma:.2g} %"
