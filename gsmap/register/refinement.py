"""Run the refiners named in the settings."""

from __future__ import annotations

from typing import Any

from gsmap.methods import family
from gsmap.register.metric_scene import MetricPair
from gsmap.register.params import Params
from gsmap.types import Sim3

SCALE_REFINER = "colored_icp"
"""For pairs of unknown scale, this refiner replaces a refiner that cannot refine the scale."""


def refine_coarse(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """Refine a proposed pose until it is near enough to be verified."""
    return _refine(pair, pose, refiner_for(params.coarse_refiner, with_scale), params, with_scale, "coarse")


def refine_fine(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """Refine a pose to its final accuracy."""
    return _refine(pair, pose, refiner_for(params.refiner, with_scale), params, with_scale, "fine")


def polish(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """Run the polisher on a pose; return the same object if the polisher changes nothing."""
    return _refine(pair, pose, params.polisher, params, with_scale, "fine")


def refiner_for(name: str, with_scale: bool) -> str:
    """Return ``name``; or `SCALE_REFINER` if the scale is free and the refiner ``name`` cannot refine scales."""
    return SCALE_REFINER if with_scale and not family("refiner").get(name).SCALES else name


def _refine(pair: MetricPair, pose: Sim3, name: str, params: Params, with_scale: bool, stage: str) -> Sim3:
    refiner = family("refiner").get(name)
    extra: dict[str, Any] = (
        {"correspondences": pair.correspondences} if getattr(refiner, "USES_CORRESPONDENCES", False) else {}
    )
    if stage in getattr(refiner, "SCHEDULES", {}):
        extra["schedule"] = refiner.SCHEDULES[stage]
    found: Sim3 = refiner.refine(
        pair.target.surface(), pair.source.surface(), pose, params.refiners[name], with_scale=with_scale, **extra
    )
    return found
