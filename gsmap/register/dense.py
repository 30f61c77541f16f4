"""Poses from the surfaces alone, for scenes whose graphs are too poor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.surface import Surface
from gsmap.types import Sim3


@dataclass(frozen=True)
class Params:
    """Args:
    voxel_m: cell size at which features are computed.
    min_inliers: fewer agreeing features propose nothing.
    """

    voxel_m: float = 0.15
    min_inliers: int = 5


def match_surfaces(target: Surface, source: Surface, params: Params | None = None) -> tuple[Sim3, int] | None:
    """Rigid ``T_target_source`` (metres) by KISS-Matcher on the surfaces' points, and its number of inliers.

    Its own confidence is worth little (measured: most of its wrong answers look sure), so it only proposes.
    None where it found no pose, and where the package is missing (it has no wheel for Python 3.13).
    """
    try:
        import kiss_matcher
    except ImportError:
        return None

    params = params or Params()
    if len(target.coarse[0]) < 50 or len(source.coarse[0]) < 50:
        return None
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(params.voxel_m))
    # Frames may lie far from their content; float32 inside the matcher does not forgive that.
    centre_t, centre_s = target.coarse[0].mean(0), source.coarse[0].mean(0)
    solution = matcher.estimate(
        (source.coarse[0] - centre_s).astype(np.float32), (target.coarse[0] - centre_t).astype(np.float32)
    )
    inliers = int(matcher.get_num_final_inliers())
    if not solution.valid or inliers < params.min_inliers:
        return None
    u, _, vt = np.linalg.svd(np.asarray(solution.rotation, dtype=np.float64))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    translation = np.asarray(solution.translation, dtype=np.float64).reshape(3)
    return Sim3(rotation, translation + centre_t - rotation @ centre_s), inliers
