"""Evaluate the edges and poses of a map against the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from gsmap.evaluate.calibration import (
    Nees,
    nees_of_edge,
    nees_of_pose,
    nees_rows,
    relative_covariance,
    truth_covariance,
)
from gsmap.evaluate.registration import absolute_trajectory_error, pose_error
from gsmap.settings.ranges import require_range
from gsmap.types import PoseGraph, Sim3
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.evaluation import (
    BandRow,
    ComponentErrorRow,
    EdgeErrorRow,
    EvaluationReport,
    NeesRow,
    PoseErrorRow,
)
from gsmap.types.rows.pairs import EdgeRow, PairRef

_METRIC = 1e-6  # largest log scale of a true pose of a scene in metres


@dataclass(frozen=True)
class Params:
    """Settings of the evaluation.

    Args:
        max_rre_deg: Largest rotation error in degrees, positive, of an edge that counts as correct; a larger value
            counts more edges as correct.
        max_rte_m: Largest translation error in metres, positive, at the source's centroid, of an edge that counts as
            correct; a larger value counts more edges as correct.
        truth_sigma_deg: Standard deviation in degrees, at least 0, of the rotation that the truth states for each
            scene; a larger value lowers normalized errors (NEES).
        truth_sigma_m: Standard deviation in metres, at least 0, of the centroid position that the truth states for each
            scene; a larger value lowers normalized errors (NEES).
        bands: Limits in (0, 1), increasing, that divide pairs into bands by their true overlap; recall and precision
            are reported for each band.
    """

    max_rre_deg: float = 1.0
    max_rte_m: float = 0.05
    truth_sigma_deg: float = 0.0
    truth_sigma_m: float = 0.0
    bands: tuple[float, ...] = (0.1, 0.25, 0.5)

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "max_rre_deg", "max_rte_m")
        require_range(self, "[0, inf)", "truth_sigma_deg", "truth_sigma_m")


@dataclass(frozen=True, eq=False)
class EvaluatedScene:
    """A scene of the map with its truth.

    Args:
        id, name: id and name of the scene.
        S_scene_world: true pose, with the world in metres; None if unknown.
        centroid: (3,) point at which errors are measured, in the scene's frame; arbitrary without a true pose.
        centers: (C, 3) camera centres in the scene's frame; arbitrary without a true pose.
    """

    id: str
    name: str
    S_scene_world: Sim3 | None
    centroid: np.ndarray
    centers: np.ndarray


def evaluate_map(
    scenes: Sequence[EvaluatedScene],
    edges: Sequence[EdgeRow],
    graph: PoseGraph | None,
    overlaps: Mapping[frozenset[str], float],
    params: Params | None = None,
    metres: Mapping[int, MetricScale] | None = None,
) -> EvaluationReport:
    """Evaluate the edges and the newest poses of a map.

    Args:
        scenes: all scenes, in the map's order.
        edges: the current edge of every registered pair.
        graph: the newest poses; None if the map has no poses yet.
        overlaps: true overlap of all pairs of scenes with a true pose.
        metres: metric scale of each component; None if it is not to be evaluated.
    """
    return _MapErrors(scenes, edges, graph, overlaps, params or Params(), metres or {}).report()


class _MapErrors:
    def __init__(
        self,
        scenes: Sequence[EvaluatedScene],
        edges: Sequence[EdgeRow],
        graph: PoseGraph | None,
        overlaps: Mapping[frozenset[str], float],
        params: Params,
        metres: Mapping[int, MetricScale],
    ) -> None:
        self.scenes = {scene.id: scene for scene in scenes}
        self.truth = {scene.id: scene.S_scene_world for scene in scenes if scene.S_scene_world is not None}
        self.all_edges = edges
        self.graph = graph
        self.overlaps = overlaps
        self.params = params
        self.metres = metres
        poses = {} if graph is None else {s: pose for s, pose in graph.poses.items() if s in self.scenes}
        sizes: dict[int, int] = {}
        for pose in poses.values():
            if pose.status != "isolated":
                sizes[pose.component] = sizes.get(pose.component, 0) + 1
        # A scene is isolated if all its neighbours were removed since the last solve.
        self.connected = {
            s: poses[s]
            for s in self.scenes
            if s in poses and poses[s].status != "isolated" and sizes[poses[s].component] > 1
        }
        self.components: dict[int, list[str]] = {}
        for s, pose in self.connected.items():
            self.components.setdefault(pose.component, []).append(s)
        self.nees = {component: self._nees_of_component(component) for component in sorted(self.components)}

    def report(self) -> EvaluationReport:
        accepted = [edge for edge in self.all_edges if edge.status == "accepted" and edge.S_target_source is not None]
        known = [edge for edge in accepted if edge.target in self.truth and edge.source in self.truth]
        edges = tuple(self._edge(edge) for edge in known)
        pairs = tuple(
            self._error(a, b, self.connected[a].S_map_scene.inverse() @ self.connected[b].S_map_scene)
            for members in self.components.values()
            for a, b in combinations([s for s in members if s in self.truth], 2)
        )
        components = tuple(self._component(k, members) for k, members in sorted(self.components.items()))
        ate_m, ate_reason = self._ate(components)
        statuses = [pose.status for pose in self.connected.values()]
        in_use = [edge for edge in edges if edge.used]
        return EvaluationReport(
            num_scenes=len(self.scenes),
            num_placed=statuses.count("placed"),
            num_tentative=statuses.count("tentative"),
            edges=edges,
            pairs=pairs,
            edges_in_use=len(in_use),
            edges_without_truth=len(accepted) - len(known),
            false_edges=tuple(
                PairRef(target=e.target, target_name=e.target_name, source=e.source, source_name=e.source_name)
                for e in in_use
                if not e.right
            ),
            max_rre_deg=self.params.max_rre_deg,
            max_rte_m=self.params.max_rte_m,
            truth_sigma_deg=self.params.truth_sigma_deg,
            truth_sigma_m=self.params.truth_sigma_m,
            bands=self._bands(edges),
            components=components,
            nees=self._nees(edges),
            notes=self._notes(),
            ate_m=ate_m,
            ate_reason=ate_reason,
            **_summary("edges", edges),
            **_summary("pairs", pairs),
        )

    # --- edges and pairs ---------------------------------------------------------------------------------------------

    def _true(self, target: str, source: str) -> Sim3:
        return self.truth[target] @ self.truth[source].inverse()

    def _truth_covariance(self, source: str) -> np.ndarray | None:
        """Return the (7, 7) covariance of a pair's true pose on the source's side; None if the truth is exact."""
        params, scene = self.params, self.scenes[source]
        if not (params.truth_sigma_deg or params.truth_sigma_m):
            return None
        sigma = params.truth_sigma_m * self.truth[source].scale
        return truth_covariance(float(np.radians(params.truth_sigma_deg)), sigma, scene.centroid)

    def _error(self, target: str, source: str, estimated: Sim3) -> PoseErrorRow:
        error = pose_error(estimated, self._true(target, source), self.scenes[source].centroid)
        return PoseErrorRow(
            target=target,
            target_name=self.scenes[target].name,
            source=source,
            source_name=self.scenes[source].name,
            **vars(error) | {"centroid_m": error.centroid_m / self.truth[target].scale},
        )

    def _edge(self, edge: EdgeRow) -> EdgeErrorRow:
        assert edge.S_target_source is not None
        error = self._error(edge.target, edge.source, edge.S_target_source)
        nees = None
        if edge.information is not None:
            true, of_truth = self._true(edge.target, edge.source), self._truth_covariance(edge.source)
            nees = nees_of_edge(edge.S_target_source, edge.information, true, of_truth)
        return EdgeErrorRow(
            **vars(error),
            true_overlap=self.overlaps[frozenset((edge.target, edge.source))],
            used=edge.used,
            right=error.rre_deg <= self.params.max_rre_deg and error.centroid_m <= self.params.max_rte_m,
            nees=None if nees is None else nees.value,
            nees_dof=None if nees is None else nees.dof,
        )

    def _bands(self, edges: Sequence[EdgeErrorRow]) -> tuple[BandRow, ...]:
        """Compute recall and precision by bands of true overlap; each band includes its lower end."""
        ends = (0.0, *self.params.bands, 1.0)
        pairs = np.array([self.overlaps[frozenset(pair)] for pair in combinations(self.truth, 2)])
        pair_band = np.searchsorted(self.params.bands, pairs, side="right")
        edge_band = np.searchsorted(self.params.bands, [e.true_overlap for e in edges], side="right")
        right = np.array([e.right for e in edges], dtype=bool)
        rows = []
        for k, (low, high) in enumerate(pairwise(ends)):
            num_pairs, num_accepted = int((pair_band == k).sum()), int((edge_band == k).sum())
            num_right = int(right[edge_band == k].sum())
            rows.append(
                BandRow(
                    overlap_from=low,
                    overlap_to=high,
                    num_pairs=num_pairs,
                    num_accepted=num_accepted,
                    num_right=num_right,
                    recall=num_right / num_pairs if num_pairs else None,
                    precision=num_right / num_accepted if num_accepted else None,
                )
            )
        return tuple(rows)

    # --- poses -------------------------------------------------------------------------------------------------------

    def _component(self, component: int, members: Sequence[str]) -> ComponentErrorRow:
        known = [s for s in members if s in self.truth]
        # If the captures are truly in metres, the map must be in metres as well, so a wrong scale counts as an error.
        metric = all(abs(self.truth[s].scale - 1) < _METRIC for s in known)
        alignment = "rigid" if metric else "similarity"
        reason, ate_m = "", None
        metre = self.metres.get(component)
        true_logs = [-float(np.log(self.truth[s].scale * self.connected[s].S_map_scene.scale)) for s in known]
        count = sum(len(self.scenes[s].centers) for s in known)
        if len(known) < 2:
            reason = f"{len(known)} of its {len(members)} scenes have a true pose, but two are needed"
        elif count < 3:
            reason = f"{count} cameras do not determine an alignment; three are needed"
        else:
            estimated = [self.connected[s].S_map_scene.apply(self.scenes[s].centers) for s in known]
            true = [self.truth[s].inverse().apply(self.scenes[s].centers) for s in known]
            ate_m = absolute_trajectory_error(np.concatenate(estimated), np.concatenate(true), align=alignment)
        return ComponentErrorRow(
            component=component,
            scene_names=tuple(self.scenes[s].name for s in members),
            num_cameras=count,
            alignment=alignment,
            ate_m=ate_m,
            ate_reason=reason,
            metres_per_unit=metre.metres_per_unit if metre else None,
            metre_sigma=metre.sigma if metre else None,
            metre_known_by=metre.known_by if metre else "",
            true_metres_per_unit=float(np.exp(np.median(true_logs))) if true_logs else None,
        )

    def _ate(self, components: Sequence[ComponentErrorRow]) -> tuple[float | None, str]:
        """Return the ATE over all components that have one, and the reason if none has one."""
        found = [(row.num_cameras, row.ate_m) for row in components if row.ate_m is not None]
        if found:
            squares = sum(count * ate_m**2 for count, ate_m in found)
            return float(np.sqrt(squares / sum(count for count, _ in found))), ""
        if self.graph is None:
            return None, "the map has no poses yet: run gsmap optimize"
        if not components:
            return None, "no two scenes are connected by edges"
        return None, "; ".join(f"component {row.component}: {row.ate_reason}" for row in components)

    def _nees(self, edges: Sequence[EdgeErrorRow]) -> tuple[NeesRow, ...]:
        of_edges = [Nees(e.nees, e.nees_dof) for e in edges if e.nees is not None and e.nees_dof is not None]
        of_poses = [one for found in self.nees.values() for one in found or ()]
        return (*nees_rows("edges", of_edges), *nees_rows("poses", of_poses))

    def _nees_of_component(self, component: int) -> list[Nees] | None:
        """Return the NEES of each scene relative to the anchor of its component; None if covariances are missing or
        unusable."""
        known = {
            s: covariance
            for s in self.components[component]
            if s in self.truth and (covariance := self.connected[s].covariance) is not None
        }
        if len(known) < 2:
            return None
        anchor = min(known, key=lambda s: float(np.trace(known[s][:3, :3])))
        inverse = self.connected[anchor].S_map_scene.inverse()
        found = []
        for s in (s for s in known if s != anchor):
            estimated = inverse @ self.connected[s].S_map_scene
            covariance = relative_covariance(estimated, known[s], known[anchor])
            if covariance is None:
                return None
            found.append(nees_of_pose(estimated, covariance, self._true(anchor, s), self._truth_covariance(s)))
        return found

    def _notes(self) -> tuple[str, ...]:
        notes = []
        lacking = [scene.name for scene in self.scenes.values() if scene.id not in self.truth]
        if lacking:
            notes.append(f"scenes without a true pose are not evaluated: {_join_names(lacking)}")
        if self.graph is not None:
            new = [scene.name for scene in self.scenes.values() if scene.id not in self.graph.poses]
            if new:
                notes.append(f"scenes newer than the newest poses: {_join_names(new)}; run gsmap optimize")
        without_nees = [str(component) for component, found in self.nees.items() if found is None]
        if without_nees:
            notes.append(
                f"no NEES of poses in component {_join_names(without_nees)}: covariances or true poses are missing, or "
                "priors fix its frame"
            )
        stale = [edge.pair for edge in self.all_edges if edge.used and edge.status != "accepted"]
        if stale:
            notes.append(
                f"the newest poses use edges that are no longer accepted: {_join_names(stale)}; run gsmap optimize"
            )
        return tuple(notes)


def _join_names(names: Sequence[str], most: int = 10) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _summary(of: str, rows: Sequence[PoseErrorRow]) -> dict[str, Any]:
    """Return medians and worst values of the given rows; None without rows."""

    def over(function: Callable[[list[float]], Any], name: str) -> float | None:
        return float(function([getattr(row, name) for row in rows])) if rows else None

    return {
        f"{of}_median_rre_deg": over(np.median, "rre_deg"),
        f"{of}_median_centroid_m": over(np.median, "centroid_m"),
        f"{of}_median_rte": over(np.median, "rte"),
        f"{of}_median_rse": over(np.median, "rse"),
        f"{of}_worst_rre_deg": over(max, "rre_deg"),
        f"{of}_worst_centroid_m": over(max, "centroid_m"),
    }
