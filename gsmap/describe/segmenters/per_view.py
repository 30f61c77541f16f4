"""Built-in segmenter that segments each view independently, as a network would.

The segmenter ``builtin`` numbers the parts of the surface, so its masks need no association over views. Here the part
numbers are dropped, and masks are associated by appearance and position, as in Graph-GSReg (``tau_asso``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsmap.describe.segmenters import builtin
from gsmap.types.views import Mask, SceneContext, View

VERSION = 2
MODELS: tuple[str, ...] = ()


@dataclass(frozen=True)
class Params:
    """Settings of the segmenter: none; parts are cut with the defaults of the segmenter ``builtin``."""


def make(context: SceneContext, params: Params) -> PerViewSegmenter:
    """Cut the surface of a scene; see `gsmap.methods.segmenter`."""
    return PerViewSegmenter(builtin.make(context, builtin.Params()))


@dataclass(frozen=True)
class PerViewSegmenter:
    """Masks of the surface's parts without their part numbers."""

    parts: builtin.BuiltinSegmenter
    is_thread_safe = True

    def segment(self, view: View) -> list[Mask]:
        """Return the masks of the segmenter ``builtin`` in a view, without their part numbers."""
        return [replace(mask, part=None) for mask in self.parts.segment(view)]
