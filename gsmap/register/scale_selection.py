"""Refine a pose to its final accuracy and select its scale: exactly 1 or the measured scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.register import refinement
from gsmap.register.covariance import PoseUncertainty, condition, find_colour_motion
from gsmap.register.metric_scene import MetricPair
from gsmap.register.params import Params
from gsmap.register.unit_scale import ScaleDecision, bending_note, decide_scale
from gsmap.types import Sim3


def refine_and_select_scale(
    pair: MetricPair, pose: Sim3, params: Params, *, with_scale: bool
) -> tuple[Sim3, PoseUncertainty | None, ScaleDecision | None]:
    """Refine a pose, estimate its uncertainty and decide on its scale.

    The scale is always measured, by refining it with the pose. Where both scenes may be in metres the measurement
    decides between the scaled pose and a rigid pose refined from it.

    Args:
        with_scale: the scale of ``pose`` was already refined; otherwise it may be some percent off.

    Returns:
        The pose (metres), its uncertainty (None where the overlap is too small) and the decision on its scale. The
        decision is None if a scene's unit is unknown or there is no uncertainty; then the pose has the measured scale.
    """
    surfaces = pair.target.surface(), pair.source.surface()
    start = pose if with_scale else refinement.refine_coarse(pair, pose, params, with_scale=True)
    scaled = refinement.refine_fine(pair, start, params, with_scale=True)
    conditioned = condition(*surfaces, scaled, pair.correspondences)
    if conditioned is None:
        return scaled, None, None
    if "unknown" in pair.policies:
        return scaled, conditioned.uncertainty(scaled), None
    # The units of ``pair`` may contain a voted scale, so the scale between the scenes is the product of both.
    log_scale = float(np.log(scaled.scale * pair.scale))
    decision = decide_scale(log_scale, conditioned.log_scale_sigma, specified=pair.policies == {"known"})
    if not decision.rigid:
        return scaled, conditioned.uncertainty(scaled), decision
    residual_sigma = float(np.sqrt(conditioned.scaled[6, 6]))
    extent_m = 2.0 * conditioned.radius_m / pair.target.unit_m  # not in working metres: both units are the metre
    bends = bending_note(decision, residual_sigma, extent_m)
    decision = replace(decision, note=decision.note or bends)
    rigid = refinement.refine_fine(pair, conditioned.rescaled(scaled, 1.0 / pair.scale), params, with_scale=False)
    colour_motion = find_colour_motion(*surfaces, rigid, conditioned.centroid, with_scale=False)
    return rigid, conditioned.uncertainty(rigid, decision, colour_motion), decision
