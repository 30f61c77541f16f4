"""The settings of georeferencing."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """How observations of the world are read. How they are weighed in the solve is in ``optimize.survey``.

    Args:
        area_margin_deg: points may lie this far outside the area that a CRS is meant for: maps of Bavaria go beyond
            their zone by two degrees; swapped axes and wrong systems go by more.
        gcp_sigma_m: standard deviation of a control point where nobody gives one, horizontal and vertical.
        pixel_sigma_px: of a control point in a photo: picking, and the camera that it was picked in.
        depth_sigma_share: of a depth that was rendered, as a share of it: splats lie around surfaces, not on them.
        gnss_sigma_m: of a position in EXIF that does not say how good it is, from photo to photo.
        gnss_common_sigma_m: what all positions of a capture are off by together.
        gnss_height_factor: heights by satellites are worse by this.
        sea_level_sigma_m: EXIF gives heights above sea level, which lies up to this far from the ellipsoid.
        survey_sigma_m: of a scene's surveyed position where nobody gives one.
        bar_sigma_share: of a scale bar, as a share of it, where nobody gives its sigma.
    """

    area_margin_deg: float = 2.0
    gcp_sigma_m: float = 0.01
    pixel_sigma_px: float = 1.0
    depth_sigma_share: float = 0.005
    gnss_sigma_m: float = 1.5
    gnss_common_sigma_m: float = 3.0
    gnss_height_factor: float = 2.0
    sea_level_sigma_m: float = 40.0
    survey_sigma_m: float = 1.0
    bar_sigma_share: float = 0.002

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ConfigError(f"{name} must be positive, got {value}")
