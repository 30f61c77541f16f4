"""When a placed photograph differs from the map."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Params:
    """When a photograph differs from the map.

    Args:
        half_px: differences are means over patches that reach so far from their middle, at the size that photos are
            worked on.
        min_chroma: a difference of hue below this is none, ...
        chroma_spreads: ... nor one below so many robust standard deviations of what light and noise leave over.
        min_lightness, lightness_spreads: the same of lightness, after a smooth field of light is taken off.
        light_px: width of that field (standard deviation of a Gaussian).
        same_pattern: where patterns correlate by this much, lightness alone tells nothing.
        min_area: share of the picture that a region must have.
        min_strength: mean difference of a region, in units of the bars above.
        eyes: of a scene's own cameras, which tell what it has looked at.
        eyes_px: longest side of their renders.
        tolerance_m: a surface so near to a point is its own, beside
        tolerance: this share of its distance.
        max_turn_deg: a surface that cameras saw from a direction farther off than this is not known from here.
        min_share: scenes in which a smaller share of the picture is known than this say nothing.
        min_agreeing: ... and neither do those of which less than this share agrees: they show another place.
    """

    half_px: int = 6
    min_chroma: float = 0.1
    chroma_spreads: float = 4.0
    min_lightness: float = 0.11
    lightness_spreads: float = 5.0
    light_px: float = 40.0
    same_pattern: float = 0.4
    min_area: float = 0.003
    min_strength: float = 1.6
    eyes: int = 32
    eyes_px: int = 128
    tolerance_m: float = 0.05
    tolerance: float = 0.03
    max_turn_deg: float = 60.0
    min_share: float = 0.05
    min_agreeing: float = 0.5
