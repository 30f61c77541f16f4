"""Which refiner refines a pose, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsmap.methods import family
from gsmap.register.metric import MetricPair
from gsmap.register.params import Params
from gsmap.types import Sim3


def coarse(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """The pose brought near enough to be looked at."""
    return _refined(
        pair, pose, refiner_for(params.coarse_refiner, params, with_scale), params.coarse_refiners, with_scale
    )


def fine(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """The refined pose."""
    return _refined(pair, pose, refiner_for(params.refiner, params, with_scale), params.refiners, with_scale)


def polished(pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool) -> Sim3:
    """The pose by the polisher; the same object where it has nothing to say."""
    return _refined(pair, pose, params.polisher, params.refiners, with_scale)


def refiner_for(name: str, params: Params, with_scale: bool) -> str:
    """The refiner that is asked: that of the name, unless it cannot refine the scale and has to."""
    return params.scale_refiner if with_scale and not family("refiner").get(name).SCALES else name


def _refined(pair: MetricPair, pose: Sim3, name: str, settings: Mapping[str, Any], with_scale: bool) -> Sim3:
    refiner = family("refiner").get(name)
    extra = {"correspondences": pair.ties} if getattr(refiner, "USES_CORRESPONDENCES", False) else {}
    found: Sim3 = refiner.refine(
        pair.target.surface(), pair.source.surface(), pose, settings[name], with_scale=with_scale, **extra
    )
    return found
