"""Run an alignment of the small_gicp library at several correspondence distances."""

from __future__ import annotations

from gsmap.methods.refiner import Surface
from gsmap.types import Sim3

_MIN_PAIRS = 10  # of pairs and of points; fewer do not constrain a pose


def align(
    kind: str,
    target: Surface,
    source: Surface,
    start: Sim3,
    *,
    radii_m: tuple[float, ...],
    max_iterations: int,
    every_point: bool = False,
) -> Sim3:
    """Refine a rigid pose by one run at each correspondence distance; return the start where the overlap is too small.

    Args:
        kind: registration type of small_gicp.
        start: initial pose, whose scale is kept.
        every_point: align all points instead of their means over cells; only for kinds that need no normals.
    """
    import small_gicp

    source = source.scaled(start.scale)
    if every_point:
        target_cloud, source_cloud = (small_gicp.PointCloud(surface.points) for surface in (target, source))
        target_tree = small_gicp.KdTree(target_cloud, num_threads=1)
    else:
        (target_cloud, target_tree), (source_cloud, _) = target.cloud, source.cloud
    if target_cloud.size() < _MIN_PAIRS or source_cloud.size() < _MIN_PAIRS:
        return start
    pose = Sim3(start.rotation, start.translation)
    for radius in radii_m:
        result = small_gicp.align(
            target_cloud,
            source_cloud,
            target_tree,
            init_T_target_source=pose.matrix(),
            registration_type=kind,
            max_correspondence_distance=radius,
            num_threads=1,
            max_iterations=max_iterations,
        )
        if result.num_inliers < _MIN_PAIRS:
            break
        pose = Sim3.from_matrix(result.T_target_source)
    return Sim3(pose.rotation, pose.translation, start.scale)
