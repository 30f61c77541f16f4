"""The built-in segmenter's masks as a network would give them: of one view each, the same thing in two views unknown.

The built-in segmenter knows which masks of two views are one part of the surface, so nothing is associated. Here that
is forgotten, and masks become objects by what they show and where it lies (``tau_asso``), as Graph-GSReg has it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsmap.describe.segmenters import builtin
from gsmap.types.views import Mask, SceneContext, View

VERSION = 1
MODELS: tuple[str, ...] = ()
Params = builtin.Params


def make(context: SceneContext, params: builtin.Params) -> PerViewSegmenter:
    """Cut the surface of a scene; see `gsmap.methods.segmenter`."""
    return PerViewSegmenter(builtin.make(context, params))


@dataclass(frozen=True)
class PerViewSegmenter:
    """Masks of the surface's parts that do not say of which."""

    parts: builtin.BuiltinSegmenter

    def segment(self, view: View) -> list[Mask]:
        """The built-in segmenter's masks of a view, without their parts."""
        return [replace(mask, part=None) for mask in self.parts.segment(view)]
