"""Measure the distance between two points of a map, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap import optimize
from gsmap.errors import ConfigError, NotFoundError
from gsmap.geometry.uncertainty import point_jacobian
from gsmap.map.metric_scales import map_metres
from gsmap.map.settings import Settings
from gsmap.map.stages.optimize import PoseInputs, pose_inputs
from gsmap.map.world.specified_points import SpecifiedPoint, parse_point
from gsmap.store import Store
from gsmap.types import PoseGraph
from gsmap.types.rows.world import MeasureReport, PointRow
from gsmap.types.world import Georeference, WorldFrame


@dataclass(frozen=True, eq=False)
class _LocatedPoint:
    """A point that the user specified, with its map and world coordinates.

    Args:
        component: component of ``map``; None for a point of the world.
        map, metric: (3,) coordinates in the map and in the world frame; None if unknown.
    """

    place: SpecifiedPoint
    component: int | None
    map: np.ndarray | None
    metric: np.ndarray | None


def measure(
    store: Store, a: str, b: str, settings: Settings, *, component: int | None = None, crs: str | None = None
) -> MeasureReport:
    """Measure the distance between two points in metres, with its standard deviation; see `specified_points`.

    Points of one component are measured in its frame, by its metre; those of two in the world, if both are tied to it.

    Args:
        component: of points given in the map, where it has several.
        crs: of the world coordinates that are shown; the map's own by default.

    Raises:
        ConfigError: a point that is none, or a map of several components of which none was named.
        NotFoundError: a scene without a pose, a component that does not exist, or points that no frame joins.
    """
    graph = store.revisions.get()
    if graph is None or not graph.poses:
        raise NotFoundError("the map has no poses to measure with: run gsmap update first", code="no_poses")
    components = _components(graph)
    if component is not None and component not in components:
        raise NotFoundError(
            f"the map has no component {component}: it has {', '.join(map(str, components))}",
            code="component_not_found",
        )
    solved = _PoseUncertainty(store, settings, graph)
    said = [parse_point(store, text) for text in (a, b)]
    placed = [_where(store, one, graph, component) for one in said]
    frame = next((tie.frame for tie in graph.world if tie.S_world_map is not None), None)
    notes = []
    if any(one.scene is None for one in said):
        notes.append(
            "points given in the map or the world count as exact, so that sigma contains only the errors of the map"
        )
    one, two = placed
    in_world = any(end.place.crs is not None for end in placed)
    if one.component is not None and one.component == two.component and not in_world:
        tie = graph.tie(one.component)
        metres, sigma_log, known_by = _metre(store, graph, one.component, tie)
        span = _apart(one.map, two.map)
        variance = _pose_variance(solved, placed) * metres**2 + (span * metres * sigma_log) ** 2
        distance = span * metres
        if known_by in ("assumed", "guessed", "unknown"):
            notes.append(
                f"the metric scale is {known_by}: measure it with gsmap georeference MAP --scale-bar A B METRES"
            )
    elif one.metric is not None and two.metric is not None:
        distance, known_by = _apart(one.metric, two.metric), "world"
        variance = _world_variance(solved, placed)
    else:
        raise NotFoundError(
            "the two points lie in different components, and not both of them are tied to the world: gsmap "
            "georeference does so",
            code="conflicting_options",
        )
    rows = [_row(solved, one, frame, crs) for one in placed]
    named = crs or (frame.crs if frame else None)
    sigma = float(np.sqrt(max(0.0, variance)))
    heights = None
    if named is not None:
        from gsmap.geodesy.crs import crs as crs_of

        heights = crs_of(named).heights
    return MeasureReport(
        distance_m=distance,
        sigma_m=sigma,
        known_by=known_by,
        a=rows[0],
        b=rows[1],
        crs=named,
        heights=heights,
        notes=tuple(notes),
    )


def _components(graph: PoseGraph) -> list[int]:
    return sorted({pose.component for pose in graph.poses.values()})


def _where(store: Store, one: SpecifiedPoint, graph: PoseGraph, component: int | None) -> _LocatedPoint:
    if one.crs is not None:
        tied = [tie for tie in graph.world if tie.S_world_map is not None and tie.frame is not None]
        if not tied:
            raise NotFoundError(
                "the map is not tied to the world: gsmap georeference does so", code="not_georeferenced"
            )
        from gsmap.geodesy.frame import to_frame

        frame = tied[0].frame
        assert frame is not None
        metric = to_frame(frame, one.point[None], None if one.crs == "world" else one.crs)[0]
        tie = tied[0] if len(tied) == 1 else next((t for t in tied if t.component == component), None)
        if tie is None or tie.S_world_map is None:
            return _LocatedPoint(one, None, None, metric)
        return _LocatedPoint(one, tie.component, tie.S_world_map.inverse().apply(metric), metric)
    if one.scene is not None:
        pose = graph.poses.get(one.scene)
        if pose is None or pose.S_map_scene is None:
            raise NotFoundError(
                f"scene {store.scenes.get(one.scene).name} has no place in the map: run gsmap update",
                code="scene_unplaced",
            )
        at, of = pose.S_map_scene.apply(one.point), pose.component
    else:
        components = _components(graph)
        if component is None and len(components) > 1:
            raise ConfigError(
                f"{one.said} is in the map's frame, of which there are {len(components)}: name one with --component",
                code="component_required",
            )
        of, at = components[0] if component is None else component, one.point
    tie = graph.tie(of)
    metric = None if tie is None or tie.S_world_map is None else tie.S_world_map.apply(at)
    return _LocatedPoint(one, of, at, metric)


def _metre(store: Store, graph: PoseGraph, component: int, tie: Georeference | None) -> tuple[float, float, str]:
    """Return metres per unit of a component, the standard deviation of its logarithm, and how it is known."""
    metre = map_metres(store, graph)[component]
    if metre.known_by == "surveyed" and tie is not None and tie.metres_per_unit is not None:  # without rounding
        return tie.metres_per_unit, tie.scale_sigma, "world" if tie.S_world_map is not None else "measured"
    return metre.metres_per_unit, metre.sigma, metre.known_by


def _apart(a: np.ndarray | None, b: np.ndarray | None) -> float:
    assert a is not None
    assert b is not None
    return float(np.linalg.norm(a - b))


def _variance_along(to: np.ndarray | None, of: np.ndarray | None, covariance: np.ndarray) -> float:
    """Return the variance of the distance between two points from the covariance (3, 3) of their difference.

    Points nearer to each other than their uncertainty have no known direction: theirs is that of the largest variance.
    """
    assert to is not None
    assert of is not None
    if not np.isfinite(covariance).all():
        return float("inf")
    span = to - of
    square, largest = float(span @ span), max(0.0, float(np.linalg.eigvalsh(covariance)[-1]))
    return largest if square <= largest else float(span @ covariance @ span) / square


@dataclass(frozen=True, eq=False)
class _PoseUncertainty:
    """The newest poses with their joint covariance."""

    store: Store
    settings: Settings
    graph: PoseGraph

    @cached_property
    def _given(self) -> PoseInputs:
        return pose_inputs(self.store, self.settings)

    def joint(self, component: int | None, scenes: list[str]) -> np.ndarray | None:
        """Return the joint covariance of the georeference and these scenes; None if it cannot be computed."""
        given = self._given
        return optimize.joint_covariance(self.graph, given.edges, given.priors, given.survey, scenes, component or 0)


def _pose_variance(solved: _PoseUncertainty, placed: list[_LocatedPoint]) -> float:
    """Return the variance of the distance in the map frame from poses and picking."""
    one, two = placed
    covariance = np.zeros((3, 3))
    for end in placed:
        turn = _turn(solved.graph, end)
        covariance += turn @ end.place.covariance @ turn.T
    if one.place.scene != two.place.scene:  # else both move with it
        moved = [(end, sign) for end, sign in zip(placed, (1.0, -1.0), strict=True) if end.place.scene is not None]
        joint = solved.joint(one.component, [str(end.place.scene) for end, _ in moved])
        if joint is None:
            return float("inf")
        J = np.zeros((3, joint.shape[0]))
        for k, (end, sign) in enumerate(moved):
            J[:, 7 + 7 * k : 14 + 7 * k] = sign * _turn(solved.graph, end) @ point_jacobian(end.place.point)
        covariance += J @ joint @ J.T
    return _variance_along(one.map, two.map, covariance)


def _world_variance(solved: _PoseUncertainty, placed: list[_LocatedPoint]) -> float:
    """Return the variance of the distance between points of different components or of the world, whose errors are
    independent."""
    one, two = placed
    covariances = [_world_covariance(solved, end) for end in placed]
    if any(found is None for found in covariances):
        return float("inf")
    return _variance_along(one.metric, two.metric, sum((c for c in covariances if c is not None), np.zeros((3, 3))))


def _world_covariance(solved: _PoseUncertainty, end: _LocatedPoint) -> np.ndarray | None:
    """Return the covariance (3, 3) of a point in the world frame: zeros if it was given there, None if unknown."""
    if end.place.crs is not None:
        return np.zeros((3, 3))
    tie = None if end.component is None else solved.graph.tie(end.component)
    if tie is None or tie.S_world_map is None or end.map is None:
        return None
    W = tie.S_world_map
    big = W.scale * W.rotation
    if end.place.scene is None:
        J = big @ point_jacobian(end.map)
        out: np.ndarray = J @ tie.covariance @ J.T
        return out
    turn = _turn(solved.graph, end)
    joint = solved.joint(end.component, [end.place.scene])
    if joint is None or not np.isfinite(joint).all():  # as in a part of a map without its control points
        return None
    picked = big @ turn @ end.place.covariance @ turn.T @ big.T
    J = np.concatenate([big @ point_jacobian(end.map), big @ turn @ point_jacobian(end.place.point)], axis=1)
    found: np.ndarray = J @ joint @ J.T + picked
    return found


def _turn(graph: PoseGraph, end: _LocatedPoint) -> np.ndarray:
    """Return the matrix (3, 3) of scale and rotation of the frame in which a point was given."""
    if end.place.scene is None:
        return np.eye(3)
    S = graph.poses[end.place.scene].S_map_scene
    return S.scale * S.rotation


def _row(solved: _PoseUncertainty, end: _LocatedPoint, frame: WorldFrame | None, crs: str | None) -> PointRow:
    from gsmap.geodesy.frame import from_frame

    scene = end.place.scene
    covariance = None if end.metric is None else _world_covariance(solved, end)
    world = None if end.metric is None or frame is None else from_frame(frame, end.metric[None], crs)[0]
    return PointRow(
        said=end.place.said,
        scene=scene,
        scene_name=None if scene is None else solved.store.scenes.get(scene).name,
        component=end.component,
        map=end.map,
        metric=end.metric,
        world=world,
        sigma_m=None if covariance is None else np.sqrt(np.diag(covariance)),
    )
