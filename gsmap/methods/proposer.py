"""The contract of proposers, which propose poses of a pair of scenes without an initial pose."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

from gsmap.methods.surface import Surface
from gsmap.types import SceneGraph
from gsmap.types.registration import Proposal

__all__ = ["Proposal", "Proposer", "Scene", "Surface"]


class Scene(Protocol):
    """A scene as proposers see it."""

    @property
    def graph(self) -> SceneGraph:
        """Scene graph, in the scene's own frame and unit."""

    @property
    def unit_m(self) -> float:
        """Metres per unit of the scene, known or guessed."""

    def surface(self) -> Surface:
        """Return the surface in metres, computed on first use."""


class Proposer(Protocol):
    """The interface of a proposer module or object, beside ``Params`` and ``VERSION``."""

    Params: ClassVar[type]
    VERSION: ClassVar[int]

    SCALES: ClassVar[bool]
    """Whether it can find a pose whose scale is not known; where not, it is only asked for rigid ones."""

    PACKAGES: ClassVar[tuple[str, ...]]
    """Python packages that it needs and that may be missing, or whose version may change its answers: all of them are
    named, with their versions, in the key of every registration that might have asked it."""

    def propose(self, target: Scene, source: Scene, params: Any = None, *, with_scale: bool = False) -> list[Proposal]:
        """Propose poses to refine and verify, most promising first; empty if there are none.

        Args:
            target, source: the scenes. Where no scale is sought both have the same ``unit_m``.
            params: an instance of ``Params``; None for the defaults.
            with_scale: the scale is not known: estimate it.

        Returns:
            Proposals in the scenes' own units, the same bits in every run where the system allows. Raises nothing for
            scenes that do not match.

        Raises:
            MissingDependencyError: a package it needs is not installed; the registration then says so in its notes.
        """
