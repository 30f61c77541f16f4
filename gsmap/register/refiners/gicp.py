"""Generalised ICP, coarse to fine: the default for scenes whose scale is known."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.register.surface import Surface
from gsmap.types import Sim3


@dataclass(frozen=True)
class Params:
    """Args:
    radii_m: correspondence distances, one GICP run each, coarse to fine.
    max_iterations: of each run.
    """

    radii_m: tuple[float, ...] = (0.35, 0.12, 0.06)
    max_iterations: int = 20


def refine(target: Surface, source: Surface, start: Sim3, params: Params | None = None) -> Sim3:
    """Rigid pose of two surfaces by GICP (Segal et al. 2009; small_gicp) from a start within about 8 degrees.

    Surfaces are in metres. A start that carries a scale keeps it. Returns the start where too little overlaps.
    """
    import small_gicp

    params = params or Params()
    source = source.scaled(start.scale)
    pose = Sim3(start.rotation, start.translation)
    (target_cloud, target_tree), (source_cloud, _) = target.cloud, source.cloud
    if target_cloud.size() < 10 or source_cloud.size() < 10:
        return start
    for radius in params.radii_m:
        result = small_gicp.align(
            target_cloud,
            source_cloud,
            target_tree,
            init_T_target_source=pose.matrix(),
            registration_type="GICP",
            max_correspondence_distance=radius,
            num_threads=1,
            max_iterations=params.max_iterations,
        )
        if result.num_inliers < 10:
            break
        pose = Sim3.from_matrix(result.T_target_source)
    return Sim3(pose.rotation, pose.translation, start.scale)
