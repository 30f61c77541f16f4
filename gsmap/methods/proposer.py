"""The contract of proposers: ways to find poses of a pair of scenes without knowing any."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

from gsmap.methods.surface import Surface
from gsmap.types import SceneGraph
from gsmap.types.registration import Proposal

__all__ = ["Proposal", "Proposer", "Scene", "Surface"]


class Scene(Protocol):
    """What a proposer is given of one scene."""

    @property
    def graph(self) -> SceneGraph:
        """Its nodes, in the scene's own frame and unit."""

    @property
    def unit_m(self) -> float:
        """Metres per unit of the scene, as far as that is known or guessed."""

    def surface(self) -> Surface:
        """Its surface in metres; prepared when first asked for."""


class Proposer(Protocol):
    """A module or object beside whose ``Params`` and ``VERSION`` stand these."""

    Params: ClassVar[type]
    VERSION: ClassVar[int]

    SCALES: ClassVar[bool]
    """Whether it can find a pose whose scale is not known; where not, it is only asked for rigid ones."""

    PACKAGES: ClassVar[tuple[str, ...]]
    """Python packages that it needs and that may be missing, or whose version may change its answers: all of them are
    named, with their versions, in the key of every registration that might have asked it."""

    def propose(self, target: Scene, source: Scene, params: Any = None, *, with_scale: bool = False) -> list[Proposal]:
        """Poses worth refining and judging, most promising first; empty where nothing is suggested.

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
