"""What several scenes of a map say of where a scan lies, as one answer or as a contradiction."""

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
class Support:
    """Where one scene of the map puts a scan.

    Args:
        scene: its id.
        component: of the map, whose frame the pose is in.
        S_map_scan: the pose.
        covariance: (7, 7) over [rot_rad, trans, log_scale] on the scan's side, its unit: of the match, and of where the
            scene itself lies.
        probability: that the match is right.
        tentative: the scene's own place rests on edges that no cycle confirms.
    """

    scene: str
    component: int
    S_map_scan: Sim3
    covariance: np.ndarray
    probability: float
    tentative: bool = False

    @classmethod
    def of(cls, pose: ScenePose, found: Registration) -> Support:
        """From where a scene lies, and an accepted registration of the scan in it."""
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
class Joined:
    """What all supporters say together.

    Args:
        S_map_scan, covariance: the pose (see `Support`); None where they contradict each other.
        reason: why there is none; else empty.
        probability: that the place is right; that of the surest supporter.
    """

    S_map_scan: Sim3 | None
    covariance: np.ndarray | None
    reason: str
    probability: float


@dataclass(frozen=True)
class OnePlace:
    """How far apart two poses of a scan may lie that are one.

    Args:
        rotation_deg, distance, log_scale: nearer than this they are, whatever their covariances say; the distance is
            that of the scan's middle, in the map's unit.
        sigmas: and as far as so many standard deviations of their difference.
    """

    rotation_deg: float
    distance: float
    log_scale: float
    sigmas: float


def join(supports: Sequence[Support], middle: np.ndarray, one_place: OnePlace, names: dict[str, str]) -> Joined:
    """One pose of all supporters, unless two of them contradict each other: then none.

    Poses of scenes of one map are not independent of each other, and how they hang together is not known here, so
    their mean is that of covariance intersection with equal weights (Julier and Uhlmann 1997): however they are
    correlated, its covariance is not too small. It is wider where they scatter more than they should.

    Args:
        supports: at least one.
        middle: (3,) of the scan, its frame.
        names: of scenes, for people.
    """
    best = max(supports, key=lambda s: (s.probability, s.scene))
    for other in supports:
        if other.component != best.component:
            return _contradiction(best, other, names, "which nothing ties together")
        if not _agree(best, other, middle, one_place):
            apart = np.linalg.norm(best.S_map_scan.apply(middle) - other.S_map_scan.apply(middle))
            turned = np.degrees(angle_between(best.S_map_scan.rotation, other.S_map_scan.rotation))
            return _contradiction(best, other, names, f"{apart:.2f} units and {turned:.0f} deg apart")
    S, covariance = _mean(supports, best)
    return Joined(S, covariance, "", best.probability)


def _contradiction(a: Support, b: Support, names: dict[str, str], how: str) -> Joined:
    places = " and ".join(f"where {names[s.scene]} shows it (component {s.component})" for s in (a, b))
    return Joined(None, None, reason("ambiguous", f"it fits two places, {how}: {places}"), 0.5)


def _agree(a: Support, b: Support, middle: np.ndarray, one: OnePlace) -> bool:
    S, Q = a.S_map_scan, b.S_map_scan
    near = np.linalg.norm(S.apply(middle) - Q.apply(middle)) < one.distance
    near &= np.degrees(angle_between(S.rotation, Q.rotation)) < one.rotation_deg
    near &= abs(np.log(S.scale / Q.scale)) < one.log_scale
    if near:
        return True
    xi = (Similarities.stack([S.inverse()]) @ Similarities.stack([Q])).log()[0]
    squared = float(xi @ np.linalg.solve(a.covariance + b.covariance, xi))
    return bool(squared < 7 * one.sigmas**2)


def _mean(supports: Sequence[Support], best: Support) -> tuple[Sim3, np.ndarray]:
    """The weighted mean on Sim(3), rigid where all are, and its covariance (7, 7)."""
    informations = np.linalg.inv(np.array([s.covariance for s in supports]))
    rigid = all(s.S_map_scan.scale == best.S_map_scan.scale for s in supports)
    weights = without_scale(informations) if rigid else informations
    free = weights.shape[-1]
    poses = Similarities.stack([s.S_map_scan for s in supports])
    S, total = Similarities.stack([best.S_map_scan]), weights.sum(0)
    for _ in range(_ROUNDS):
        xi = (Similarities.stack([S.item(0).inverse()] * len(supports)) @ poses).log()[:, :free]
        step = np.linalg.solve(total, np.einsum("nij,nj->i", weights, xi))
        S = S @ exp(step[None])
    pose = S.item(0)
    if rigid:
        pose = Sim3(pose.rotation, pose.translation, best.S_map_scan.scale)
    off = (Similarities.stack([pose.inverse()] * len(supports)) @ poses).log()[:, :free]
    chi2 = float(np.einsum("ni,nij,nj->", off, weights, off))
    count = free * (len(supports) - 1)
    covariance = np.linalg.inv(informations.mean(0)) * max(1.0, chi2 / count if count else 1.0)
    return pose, 0.5 * (covariance + covariance.T)
