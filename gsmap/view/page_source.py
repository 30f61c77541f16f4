"""Interface of a map to the page's server, read anew for each request so that other processes' changes are seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from gsmap.types import GaussianSource
from gsmap.view.content import ViewMap

Action = Callable[[Mapping[str, Any]], None]
"""Does what a person asked for, by the names of `contract.ts`; raises a `gsmap.errors.GsmapError` that says why not."""


@dataclass(frozen=True, eq=False)
class PairPictures:
    """Both captures of a pair from the same cameras.

    Args:
        cameras: what each is called.
        target, source, difference: (H, W, 3) uint8 of each camera.
    """

    cameras: tuple[str, ...] = ()
    target: tuple[np.ndarray, ...] = ()
    source: tuple[np.ndarray, ...] = ()
    difference: tuple[np.ndarray, ...] = ()


class PageSource(Protocol):
    """A map as the page sees it. Every method may be called from any thread, and may raise `GsmapError`; what is named
    and not there is a `NotFoundError`. What is returned as a dict is JSON of `contract.ts`."""

    def state(self) -> str:
        """Another text whenever the map has changed; quick."""
        ...

    def content(self) -> ViewMap:
        """The map as it is now."""
        ...

    def source(self, scene: str) -> GaussianSource:
        """The Gaussians of a living scene, by id, along their Morton curve."""
        ...

    def extras(self, scene: str) -> dict[str, Any]: ...

    def revision(self, number: int) -> dict[str, Any]: ...

    def edge(self, target: str, source: str) -> dict[str, Any]:
        """`EdgeDetail` without its views."""
        ...

    def pair_pictures(self, target: str, source: str) -> PairPictures: ...

    def pair_cameras(self, target: str, source: str) -> tuple[str, ...]:
        """Of `pair_pictures`, without drawing: what each camera is called."""
        ...

    def change_picture(self, change: str) -> np.ndarray: ...

    def graph(self) -> dict[str, Any]: ...

    def history(self, at: str, component: int) -> dict[str, Any]: ...

    def merged(self, component: int) -> Path:
        """The folder of merged tiles of a component."""
        ...

    @property
    def actions(self) -> Mapping[str, Action]:
        """Return the allowed actions by name; none if the page is read-only."""
        ...
