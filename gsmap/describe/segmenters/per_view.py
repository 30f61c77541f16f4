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


@dataclass(frozen=True)
class Params(builtin.Params):
    """How coarse the parts are.

    Args:
        num_samples: about how many points the surface is thinned to before it is cut.
        scale: Felzenszwalb's k: larger makes larger parts.
        min_share: parts of less than this share of the samples join their most similar neighbour.
        min_area: masks of a smaller share of the image are dropped.
        lightness_weight: of a difference in L*, against one in a* or b*: light and shade part a surface less than a
            change of hue.
        lab_scale: the difference of colour, L*a*b* units, that counts as much as an edge of weight 1.
        turn_weight: of an edge between normals at a right angle.
    """


def make(context: SceneContext, params: Params) -> PerViewSegmenter:
    """Cut the surface of a scene; see `gsmap.methods.segmenter`."""
    return PerViewSegmenter(builtin.make(context, params))


@dataclass(frozen=True)
class PerViewSegmenter:
    """Masks of the surface's parts that do not say of which."""

    parts: builtin.BuiltinSegmenter

    def segment(self, view: View) -> list[Mask]:
        """The built-in segmenter's masks of a view, without their parts."""
        return [replace(mask, part=None) for mask in self.parts.segment(view)]
