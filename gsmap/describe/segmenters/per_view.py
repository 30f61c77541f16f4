"""Built-in segmenter without association over views, as a network would segment each view.

The built-in segmenter numbers the parts of the surface, so that its masks need no association. Here the part numbers
are dropped, and masks are associated by appearance and position, as in Graph-GSReg (``tau_asso``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsmap.describe.segmenters import builtin
from gsmap.types.views import Mask, SceneContext, View

VERSION = 1
MODELS: tuple[str, ...] = ()


@dataclass(frozen=True)
class Params:
    """No settings: parts are cut as the built-in segmenter cuts them by default."""


def make(context: SceneContext, params: Params) -> PerViewSegmenter:
    """Cut the surface of a scene; see `gsmap.methods.segmenter`."""
    return PerViewSegmenter(builtin.make(context, builtin.Params()))


@dataclass(frozen=True)
class PerViewSegmenter:
    """Masks of the surface's parts without their part numbers."""

    parts: builtin.BuiltinSegmenter

    def segment(self, view: View) -> list[Mask]:
        """Return the built-in segmenter's masks of a view, without their parts."""
        return [replace(mask, part=None) for mask in self.parts.segment(view)]
