"""The contract of refiners, which refine an approximate pose."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np

from gsmap.methods.surface import Surface
from gsmap.types import Sim3

__all__ = ["Correspondences", "Refiner", "Surface"]

Correspondences = tuple[np.ndarray, np.ndarray]
"""Points (K, 3) of the target and the corresponding points (K, 3) of the source, in metres."""


class Refiner(Protocol):
    """The interface of a refiner, which is a module or an object."""

    Params: ClassVar[type]
    VERSION: ClassVar[int]

    SCALES: ClassVar[bool]
    """True if the refiner can refine the scale as well; otherwise ``colored_icp`` refines pairs of unknown scale."""

    def refine(
        self, target: Surface, source: Surface, start: Sim3, params: Any = None, *, with_scale: bool = False
    ) -> Sim3:
        """Refine an approximate pose.

        A refiner whose module or object has ``USES_CORRESPONDENCES = True`` takes one more keyword,
        ``correspondences``: those that the start rests on (`Correspondences`), or None. One that has ``SCHEDULES``, a
        mapping from ``coarse`` or ``fine`` to any value, takes that of the pass as the keyword ``schedule``.

        Args:
            target, source: surfaces, both in metres.
            start: takes the source's metres to the target's; within about 8 degrees and 0.4 m of the answer after
                ``register.coarse_refiner``, and its scale, where one was estimated, within some percent of 1.
            params: an instance of ``Params``; None for the defaults.
            with_scale: refine the scale too; only ever asked of a refiner that `SCALES`. Otherwise the start's is kept.

        Returns:
            The pose between the same frames; ``start`` itself where too little overlaps. The same input gives the same
            bits in every run. Raises nothing for surfaces that do not match.
        """
