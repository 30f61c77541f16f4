"""The final refinement of a pose, and whether its scale is 1 or what was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.register import refinement
from gsmap.register.covariance import Known, condition, swayed
from gsmap.register.metres import Belief, believe, bending
from gsmap.register.metric import MetricPair
from gsmap.register.params import Params
from gsmap.types import Sim3


def scaled_or_rigid(
    pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool
) -> tuple[Sim3, Known | None, Belief | None]:
    """The refined pose (metres), how well it is known, and what was measured of the scale.

    The scale is always measured, by refining it along. Where both sources may be in metres it decides which pose is
    taken: the scaled one, or a rigid one refined from there.

    Args:
        with_scale: the scale of ``pose`` was refined before; otherwise it may be some percent off.

    Returns:
        No `Known` where too little overlaps to tell; no `Belief` where a source's unit is unknown, or no `Known`: the
        pose is the scaled one then.
    """
    surfaces = pair.target.surface(), pair.source.surface()
    start = pose if with_scale else refinement.coarse(pair, pose, params, with_scale=True)
    scaled = refinement.fine(pair, start, params, with_scale=True)
    conditioned = condition(*surfaces, scaled, pair.ties)
    if conditioned is None:
        return scaled, None, None
    if "unknown" in pair.policies:
        return scaled, conditioned.known(scaled), None
    # ``pair`` may have brought a voted scale into the units; what counts is the whole.
    log_scale = float(np.log(scaled.scale * pair.scale))
    belief = believe(log_scale, conditioned.log_scale_sigma, told=pair.policies == {"known"})
    if not belief.rigid:
        return scaled, conditioned.known(scaled), belief
    residual_sigma = float(np.sqrt(conditioned.scaled[6, 6]))
    extent_m = 2.0 * conditioned.radius_m / pair.target.unit_m  # not in working metres: both units are the metre
    bends = bending(belief, residual_sigma, extent_m)
    belief = replace(belief, note=belief.note or bends)
    rigid = refinement.fine(pair, conditioned.rescaled(scaled, 1.0 / pair.scale), params, with_scale=False)
    sway = swayed(*surfaces, rigid, conditioned.centroid, with_scale=False)
    return rigid, conditioned.known(rigid, belief, sway), belief
