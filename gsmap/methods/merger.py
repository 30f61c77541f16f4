"""The contract of mergers, which merge scenes in one frame to one set of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from gsmap.types import MergeResult, PosedScene
from gsmap.types.progress import Progress


class Merger(Protocol):
    """A method that merges scenes: a module of `gsmap.merge.mergers`, or an entry point in ``gsmap.mergers``.

    All lengths are in metres of the map frame. Importing a merger must not import torch: recipes are computed of
    settings alone. The same scenes, params and bounds give the same bits, whatever the order of the scenes was and for
    any number of threads; ``budget_s`` is the one exception, and a result that it cut short says so.

    One that reproduces kept photographs (`PosedScene.photos`) has ``photos_m(params)`` as well: how far beyond a tile
    they are looked for, in metres, or None. The others are given none, and a photograph makes no tile of theirs
    dirty.
    """

    Params: type
    """Frozen dataclass of the merger's settings, all with defaults."""

    VERSION: int
    """Raised whenever the output changes for the same input; all tiles of this merger are then made again."""

    STEPS: str | None
    """The field of ``Params`` that sets the number of optimization steps; None for a closed-form merger."""

    RENDERS: bool
    """True if the merger renders; the render backend, which may change the last bits, is then part of the recipe."""

    def reach_m(self, params: Any) -> float:
        """Return the distance beyond a tile's bounds within which Gaussians affect the tile, in metres.

        A tile depends only on the scenes within this distance.
        """
        ...

    def reading_m(self, params: Any, dated: bool) -> float:
        """Return the distance beyond a tile's bounds within which Gaussians are read, in metres; at least `reach_m`.

        The distance is larger than `reach_m` if Gaussians farther away may occlude the tile from cameras, and
        `PosedScene.reference_views` does not suffice.

        Args:
            dated: true if captures of several dates come near the tile.
        """
        ...

    def looking_m(self, params: Any) -> float:
        """Return the distance beyond a tile's bounds within which cameras are used, in metres."""
        ...

    def min_cameras(self, params: Any) -> int:
        """Return the number of a scene's cameras, nearest first, that are used however far they are.

        0 where those within `looking_m` are enough. Where more is read than `reach_m`, so are the Gaussians between
        such cameras and the tile.
        """
        ...

    def uses_dates(self, params: Any) -> bool:
        """Return true if capture dates affect the result, so that a new date makes a tile dirty."""
        ...

    def merge(
        self,
        scenes: Sequence[PosedScene],
        params: Any,
        bounds: np.ndarray | None,
        budget_s: float | None,
        progress: Progress,
    ) -> MergeResult:
        """Merge scenes.

        Args:
            scenes: at least one, in the order of their ids, map frame. For a tile each holds at least its Gaussians
                within `reading_m` of the bounds, and its cameras within `looking_m`; what must be known of the whole
                capture it can be asked for (`PosedScene.whole_centroid`), and what its views show
                (`PosedScene.reference_views`).
            params: an instance of ``Params``.
            bounds: (2, 3) float64 lowest and highest corner of the tile; None for everything.
            budget_s: ceiling on the wall seconds it may take (None for no ceiling); closed forms ignore it.
            progress: to be told the fraction done in [0, 1] and what is being done.

        Returns:
            The Gaussians whose mean lies in the bounds (others may be among them: they are dropped), with ``origin``
            counted in ``scenes``. ``num_input`` is filled in by the caller.
        """
        ...
