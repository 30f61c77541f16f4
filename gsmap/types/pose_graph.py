"""The global pose graph: edges in, one pose per scene out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured pose between two scenes, as the optimiser takes it.

    Args:
        target, source: scene ids.
        S_target_source: measured pose.
        information: (7, 7) SPD over xi = [rot_rad, trans, log_scale] applied on the source side,
            ``S = S_hat * Exp(xi)`` with the exact Sim(3) exponential (`gsmap.geometry.similarities`), translation in
            the source's unit; a rigid edge carries a stiff scale row.
        confirmed: a person vouches for it: it joins components by itself and is never voted out.
        strong: the pairwise verdict alone may attach a scene or a small component.
    """

    target: str
    source: str
    S_target_source: Sim3
    information: np.ndarray
    confirmed: bool = False
    strong: bool = True


@dataclass(frozen=True, eq=False)
class Prior:
    """Outside knowledge of one scene's pose (GPS, survey, anchor, a known scale, gravity).

    The three parts are independent, so that any of them may be unknown: rotation ``Log(R_hat^T R)``, translation
    ``R_hat^T (t - t_hat) / s_hat`` and ``log(s / s_hat)``. With an identity rotation in ``S_map_scene`` the
    translation's axes are the map's: a GPS position of the scene's origin is ``sigmas = [inf] * 3 + [x, y, z, inf]``.

    Args:
        scene: scene id.
        S_map_scene: expected pose.
        sigmas: (7,) standard deviations [rot_rad (3), trans_m (3), log_scale], inf where nothing is known.
        up: (3,) direction against gravity in the scene's frame, if it is known; +z of the map should look that way.
        up_sigma_rad: standard deviation of that direction.
    """

    scene: str
    S_map_scene: Sim3
    sigmas: np.ndarray
    up: np.ndarray | None = None
    up_sigma_rad: float = 0.02


@dataclass(frozen=True, eq=False)
class ScenePose:
    """Where one scene lies after optimising.

    Args:
        scene: scene id.
        S_map_scene: the pose in the frame of its component; an isolated scene is its own frame.
        component: index of its island, largest first; islands share no frame.
        status: ``placed``, ``tentative`` (placed by edges in no agreeing cycle), or ``isolated``.
        covariance: (7, 7) marginal over [rot_rad, trans, log_scale] on the scene side, or None.
    """

    scene: str
    S_map_scene: Sim3
    component: int
    status: str
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """The answer of one optimisation.

    Args:
        poses: by scene id.
        used: by (target, source): True, False or ``"tentative"``.
        residuals: by (target, source): chi-square of the edge under the answer (7 dof), where it could be computed.
        reasons: by (target, source): why an edge was not used, or why it is tentative.
        undecided: (target, source) of the edges that nothing could decide.
        parameters: what it was computed with, and how (``method`` ``batch`` or ``incremental``, ``batch_scenes``).
    """

    poses: dict[str, ScenePose]
    used: dict[tuple[str, str], bool | str] = field(default_factory=dict)
    residuals: dict[tuple[str, str], float] = field(default_factory=dict)
    reasons: dict[tuple[str, str], str] = field(default_factory=dict)
    undecided: tuple[tuple[str, str], ...] = ()
    parameters: dict[str, object] = field(default_factory=dict)
