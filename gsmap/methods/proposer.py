"""The contract of proposers, which propose relative poses of two scenes without an initial pose."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

from gsmap.methods.surface import Surface
from gsmap.types import SceneGraph
from gsmap.types.registration import Proposal

__all__ = ["Proposal", "Proposer", "Scene", "Surface"]


class Scene(Protocol):
    """The data of a scene that a proposer gets."""

    @property
    def graph(self) -> SceneGraph:
        """Scene graph, in the scene's own frame and unit."""

    @property
    def unit_m(self) -> float:
        """Metres per unit of the scene, known or estimated."""

    def surface(self) -> Surface:
        """Return the surface in metres, computed on first use."""


class Proposer(Protocol):
    """The interface of a proposer, which is a module or an object."""

    Params: ClassVar[type]
    VERSION: ClassVar[int]

    SCALES: ClassVar[bool]
    """True if the proposer can find poses of unknown scale; otherwise it is called for rigid poses only."""

    PACKAGES: ClassVar[tuple[str, ...]]
    """Optional Python packages that the proposer needs, which recipe keys name with their versions."""

    def propose(self, target: Scene, source: Scene, params: Any = None, *, with_scale: bool = False) -> list[Proposal]:
        """Propose poses to refine and verify, most promising first; return an empty list without a proposal.

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
