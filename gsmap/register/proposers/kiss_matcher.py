"""Propose a pose by KISS-Matcher on surface points, for scene graphs with few nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap import platform
from gsmap.errors import MissingDependencyError
from gsmap.methods.proposer import Proposal, Scene
from gsmap.settings.ranges import require_range
from gsmap.types import Sim3

VERSION = 1
SCALES = False
PACKAGES = ("kiss_matcher",)  # it has no wheel for Python 3.13


_MIN_INLIERS = 5  # with fewer matched features no pose is proposed
_MIN_CELLS = 50  # of each surface


@dataclass(frozen=True)
class Params:
    """Global matching of surfaces by KISS-Matcher.

    Args:
        voxel_m: Size of the cells at which features are computed, in metres, positive; a larger value is faster and
            more robust to noise, and misses details.
    """

    voxel_m: float = 0.15

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "voxel_m")


def propose(target: Scene, source: Scene, params: Params | None = None, *, with_scale: bool = False) -> list[Proposal]:
    """Propose at most one rigid pose by features of the surfaces' points.

    The confidence of KISS-Matcher is not used: most of its wrong poses have a high confidence.

    Raises:
        MissingDependencyError: the package is not installed.
    """
    params = params or Params()
    try:
        import kiss_matcher
    except ImportError as error:
        raise MissingDependencyError("the package kiss_matcher is not installed") from error

    points_t, points_s = target.surface().coarse[0], source.surface().coarse[0]
    if min(len(points_t), len(points_s)) < _MIN_CELLS:
        return []
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(params.voxel_m))
    # Centred, because the matcher computes in float32.
    centre_t, centre_s = points_t.mean(0), points_s.mean(0)
    # It sums in the order in which its threads finish, so on several processors its pose varies by centimetres between
    # runs. Systems that cannot pin a thread (macOS) are not reproducible.
    with platform.pinned_thread():
        solution = matcher.estimate((points_s - centre_s).astype(np.float32), (points_t - centre_t).astype(np.float32))
    inliers = int(matcher.get_num_final_inliers())
    if not solution.valid or inliers < _MIN_INLIERS:
        return []
    u, _, vt = np.linalg.svd(np.asarray(solution.rotation, dtype=np.float64))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    translation = np.asarray(solution.translation, dtype=np.float64).reshape(3)
    translation = translation + centre_t - rotation @ centre_s
    pose = Sim3(rotation, translation / target.unit_m)
    return [Proposal(proposer="kiss_matcher", S_target_source=pose, with_scale=False, num_inliers=inliers)]
