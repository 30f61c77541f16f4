"""Which refiner refines a pose, by name."""

from __future__ import annotations

from typing import Any

from gsmap.methods import family
from gsmap.register.metric import MetricPair
from gsmap.register.params import Params
from gsmap.types import Sim3

SCALE_REFINER = "colored_icp"
"""The refiner that replaces one that cannot refine the scale, for pairs of unknown scale."""


def coarse(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """The pose brought near enough to be looked at."""
    return _refined(pair, pose, refiner_for(params.coarse_refiner, with_scale), params, with_scale, "coarse")


def fine(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """The refined pose."""
    return _refined(pair, pose, refiner_for(params.refiner, with_scale), params, with_scale, "fine")


def polished(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """The pose by the polisher; the same object where it has nothing to say."""
    return _refined(pair, pose, params.polisher, params, with_scale, "fine")


def refiner_for(name: str, with_scale: bool) -> str:
    """The refiner that is asked: that of the name, unless it cannot refine the scale and has to."""
    return SCALE_REFINER if with_scale and not family("refiner").get(name).SCALES else name


def _refined(pair: MetricPair, pose: Sim3, name: str, params: Params, with_scale: bool, stage: str) -> Sim3:
    refiner = family("refiner").get(name)
    extra: dict[str, Any] = {"correspondences": pair.ties} if getattr(refiner, "USES_CORRESPONDENCES", False) else {}
    if stage in getattr(refiner, "SCHEDULES", {}):
        extra["schedule"] = refiner.SCHEDULES[stage]
    found: Sim3 = refiner.refine(
        pair.target.surface(), pair.source.surface(), pose, params.refiners[name], with_scale=with_scale, **extra
    )
    return found
