"""Settings of georeferencing."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range

PIXEL_SIGMA_PX = 1.0
"""Standard deviation in pixels of a control point in a photo, due to picking and to the camera."""

DEPTH_SIGMA_FRACTION = 0.005
"""Standard deviation of a rendered depth, relative to the depth: splats are scattered around surfaces."""

BAR_SIGMA_FRACTION = 0.002
"""Standard deviation of a scale bar without a specified one, relative to its length."""


@dataclass(frozen=True)
class Params:
    """Default uncertainties of georeferencing; ``optimize.survey`` holds the settings of the solver.

    Args:
        area_margin_deg: Largest distance in degrees, positive, at which points may lie outside the area of use of their
            CRS; larger values accept more points, including more points with swapped axes.
        gcp_sigma_m: Standard deviation in metres, positive, of control points for which none is specified; larger
            values lower the weight of these points.
        gnss_sigma_m: Standard deviation in metres, positive, of the independent error of each EXIF position that
            specifies none; larger values lower the weight of these positions.
        gnss_common_sigma_m: Standard deviation in metres, positive, of the error that all EXIF positions of a scene
            share; larger values lower the weight of these positions.
        survey_sigma_m: Standard deviation in metres, positive, of surveyed scene positions for which none is specified;
            larger values lower the weight of these positions.
    """

    area_margin_deg: float = 2.0
    gcp_sigma_m: float = 0.01
    gnss_sigma_m: float = 1.5
    gnss_common_sigma_m: float = 3.0
    survey_sigma_m: float = 1.0

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", *vars(self))
