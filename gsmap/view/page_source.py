"""The interface of a map to the page's server, which reads it on each request to see changes of other processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from gsmap.types import GaussianSource
from gsmap.view.content import ViewMap
from gsmap.view.contract import FloorPlan, GraphEntry, PlacedPairDetail, PlaceHistory, RevisionPoses, SceneExtras

Action = Callable[[Mapping[str, Any]], None]
"""Applies an action of the page, with the fields of `gsmap.view.contract`; raises `gsmap.errors.GsmapError`."""


@dataclass(frozen=True, eq=False)
class PairPictures:
    """Both captures of a pair from the same cameras.

    Args:
        cameras: Names of the cameras.
        target, source, difference: One picture (H, W, 3) uint8 per camera.
    """

    cameras: tuple[str, ...] = ()
    target: tuple[np.ndarray, ...] = ()
    source: tuple[np.ndarray, ...] = ()
    difference: tuple[np.ndarray, ...] = ()


class PageSource(Protocol):
    """The content of a map for the page.

    Every method is thread-safe and may raise `GsmapError`, for missing items `NotFoundError`.
    """

    def state(self) -> str:
        """Return quickly a text that differs after every change of the map."""
        ...

    def content(self) -> ViewMap:
        """Return the current content of the map."""
        ...

    def source(self, scene: str) -> GaussianSource:
        """Return the Gaussians of a scene by id, in Morton order."""
        ...

    def extras(self, scene: str) -> SceneExtras: ...

    def revision(self, number: int) -> RevisionPoses: ...

    def edge(self, target: str, source: str) -> PlacedPairDetail:
        """Return the `EdgeDetail` of a pair, without its views."""
        ...

    def pair_pictures(self, target: str, source: str) -> PairPictures: ...

    def pair_cameras(self, target: str, source: str) -> tuple[str, ...]:
        """Return the names of the cameras that `pair_pictures` would use, without drawing."""
        ...

    def change_pictures(self, change: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the place before and after a change from the same camera, (H, W, 3) uint8 each."""
        ...

    def plan(self, component: int) -> FloorPlan:
        """Return the floor plan of a component with poses."""
        ...

    def graph(self) -> GraphEntry: ...

    def object_picture(self, id: str) -> np.ndarray: ...

    def history(self, at: str, component: int) -> PlaceHistory: ...

    def merged(self, component: int) -> Path:
        """Return the folder of merged tiles of a component."""
        ...

    @property
    def actions(self) -> Mapping[str, Action]:
        """Return the allowed actions by name; none if the page is read-only."""
        ...
