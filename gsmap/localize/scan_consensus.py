"""Combine the poses of a scan in several scenes of a map, or report that they contradict each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import angle_between
from gsmap.geometry.similarities import Similarities, exp, without_scale
from gsmap.reason_codes import reason
from gsmap.types import ScenePose, Sim3
from gsmap.types.registration import Registration

_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class ScanPose:
    """The pose of a scan that follows from one scene of the map.

    Args:
        scene: id of the scene.
        component: number of the component in whose frame the pose is.
        S_map_scan: the pose.
        covariance: (7, 7) over [rot_rad, trans, log_scale] on the scan's side, in the scan's unit; it includes the
            covariances of the registration and of the scene's own pose.
        probability: probability that the registration is correct.
        tentative: the scene's own pose depends on edges that no cycle confirms.
    """

    scene: str
    component: int
    S_map_scan: Sim3
    covariance: np.ndarray
    probability: float
    tentative: bool = False

    @classmethod
    def from_registration(cls, pose: ScenePose, found: Registration) -> ScanPose:
        """Compose the pose of a scene with an accepted registration of the scan in the scene."""
        S_scene_scan = found.S_target_source
        assert S_scene_scan is not None
        assert found.information is not None
        covariance = np.linalg.inv(found.information)
        if pose.covariance is not None:
            # S_map_scene Exp(xi) S_scene_scan = S_map_scan Exp(Ad(S_scan_scene) xi)
            carried = Similarities.stack([S_scene_scan.inverse()]).adjoint()[0]
            covariance = covariance + carried @ pose.covariance @ carried.T
        return cls(
            pose.scene,
            pose.component,
            pose.S_map_scene @ S_scene_scan,
            0.5 * (covariance + covariance.T),
            float(found.evidence["probability"]),
            pose.status == "tentative",
        )


@dataclass(frozen=True, eq=False)
class ConsensusPose:
    """The pose of a scan from all scenes that show it.

    Args:
        S_map_scan, covariance: the pose (see `ScanPose`); None if scenes contradict each other.
        reason: the contradiction; empty if there is none.
        probability: probability of the pose from the most probable scene.
    """

    S_map_scan: Sim3 | None
    covariance: np.ndarray | None
    reason: str
    probability: float


@dataclass(frozen=True)
class PoseTolerance:
    """Largest differences of two consistent poses of a scan.

    Args:
        rotation_deg, distance, log_scale: poses within all three limits are consistent, whatever their covariances; the
            distance is measured at the scan's middle, in the map's unit.
        sigmas: poses within this many standard deviations of their difference are consistent as well.
    """

    rotation_deg: float
    distance: float
    log_scale: float
    sigmas: float


def combine_poses(
    poses: Sequence[ScanPose], middle: np.ndarray, tolerance: PoseTolerance, names: dict[str, str]
) -> ConsensusPose:
    """Return the mean pose, or the contradiction if the poses from two scenes are inconsistent.

    The correlations of the poses are unknown, so the mean uses covariance intersection with equal weights (Julier and
    Uhlmann 1997), whose covariance is never too small. The scatter of the poses increases it further.

    Args:
        poses: at least one pose.
        middle: (3,) middle of the scan in its own frame.
        names: names of scenes, for messages.
    """
    best = max(poses, key=lambda s: (s.probability, s.scene))
    for other in poses:
        if other.component != best.component:
            return _contradiction(best, other, names, "in components that no edge joins")
        if not _consistent(best, other, middle, tolerance):
            apart = np.linalg.norm(best.S_map_scan.apply(middle) - other.S_map_scan.apply(middle))
            turned = np.degrees(angle_between(best.S_map_scan.rotation, other.S_map_scan.rotation))
            return _contradiction(best, other, names, f"{apart:.2f} units and {turned:.0f} deg apart")
    S, covariance = _mean(poses, best)
    return ConsensusPose(S, covariance, "", best.probability)


def _contradiction(a: ScanPose, b: ScanPose, names: dict[str, str], how: str) -> ConsensusPose:
    places = " and ".join(f"the place in scene {names[s.scene]} (component {s.component})" for s in (a, b))
    return ConsensusPose(None, None, reason("ambiguous", f"it fits two places, {how}: {places}"), 0.5)


def _consistent(a: ScanPose, b: ScanPose, middle: np.ndarray, one: PoseTolerance) -> bool:
    S, Q = a.S_map_scan, b.S_map_scan
    near = np.linalg.norm(S.apply(middle) - Q.apply(middle)) < one.distance
    near &= np.degrees(angle_between(S.rotation, Q.rotation)) < one.rotation_deg
    near &= abs(np.log(S.scale / Q.scale)) < one.log_scale
    if near:
        return True
    xi = (Similarities.stack([S.inverse()]) @ Similarities.stack([Q])).log()[0]
    squared = float(xi @ np.linalg.solve(a.covariance + b.covariance, xi))
    return bool(squared < 7 * one.sigmas**2)


def _mean(measured: Sequence[ScanPose], best: ScanPose) -> tuple[Sim3, np.ndarray]:
    """Return the weighted mean on Sim(3), which is rigid if all poses are, and its covariance (7, 7)."""
    informations = np.linalg.inv(np.array([s.covariance for s in measured]))
    rigid = all(s.S_map_scan.scale == best.S_map_scan.scale for s in measured)
    weights = without_scale(informations) if rigid else informations
    free = weights.shape[-1]
    poses = Similarities.stack([s.S_map_scan for s in measured])
    S, total = Similarities.stack([best.S_map_scan]), weights.sum(0)
    for _ in range(_ROUNDS):
        xi = (Similarities.stack([S.item(0).inverse()] * len(measured)) @ poses).log()[:, :free]
        step = np.linalg.solve(total, np.einsum("nij,nj->i", weights, xi))
        S = S @ exp(step[None])
    pose = S.item(0)
    if rigid:
        pose = Sim3(pose.rotation, pose.translation, best.S_map_scan.scale)
    off = (Similarities.stack([pose.inverse()] * len(measured)) @ poses).log()[:, :free]
    chi2 = float(np.einsum("ni,nij,nj->", off, weights, off))
    count = free * (len(measured) - 1)
    covariance = np.linalg.inv(informations.mean(0)) * max(1.0, chi2 / count if count else 1.0)
    return pose, 0.5 * (covariance + covariance.T)
