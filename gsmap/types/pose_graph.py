"""Types of the global pose graph, which takes edges and gives one pose per scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.reason_codes import reason_code
from gsmap.types.sim3 import Sim3
from gsmap.types.world import Georeference


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured relative pose between two scenes.

    Args:
        target, source: scene ids.
        S_target_source: measured pose.
        information: (7, 7) SPD over xi = [rot_rad, trans, log_scale] applied on the source side,
            ``S = S_hat * Exp(xi)`` with the exact Sim(3) exponential (`gsmap.geometry.similarities`), translation in
            the source's unit; that of a rigid edge says how surely its scale is 1.
        confirmed: a person vouches for it: it joins components by itself and is never voted out.
        disagreement: of the surface that both scenes saw under this pose, the share that is not the same in both; NaN
            where nobody looked. Ranks edges of unknown likelihood.
        same_visit: both were captured so shortly after each other that next to nothing can have changed.
        log_odds_wrong: natural log-odds that the pose is wrong, by the evidence of registration and up to a constant
            that all edges share (`gsmap.optimize.edge_likelihood`); NaN where that is not known.
        duplicate: both scenes were made from one capture, so each repeats the measurements of the other.
        look_alike: the probability that both scenes show two places that look alike, rather than one; NaN if
            unknown.
    """

    target: str
    source: str
    S_target_source: Sim3
    information: np.ndarray
    confirmed: bool = False
    disagreement: float = float("nan")
    same_visit: bool = False
    log_odds_wrong: float = float("nan")
    duplicate: bool = False
    look_alike: float = float("nan")


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose prior of one scene, from GPS, a survey, an anchor, a known scale or gravity.

    The three parts are independent, so that any of them may be unknown: rotation ``Log(R_hat^T R)``, translation
    ``R_hat^T (t - t_hat) / s_hat`` and ``log(s / s_hat)``. With an identity rotation in ``S_map_scene`` the
    translation's axes are the map's: a GPS position of the scene's origin is ``sigmas = [inf] * 3 + [x, y, z, inf]``.

    Args:
        scene: scene id.
        S_map_scene: expected pose.
        sigmas: (7,) standard deviations [rotation (3, rad), translation (3, the scene's unit), log scale], infinite (in
            JSON null) if unconstrained.
        up: (3,) direction against gravity in the scene's frame; None if it is unknown.
        up_sigma_rad: standard deviation of that direction.
    """

    scene: str
    S_map_scene: Sim3
    sigmas: np.ndarray
    up: np.ndarray | None = None
    up_sigma_rad: float = 0.02


@dataclass(frozen=True, eq=False)
class ScenePose:
    """The optimized pose of one scene.

    Args:
        scene: scene id.
        S_map_scene: the pose in the frame of its component; an isolated scene is its own frame.
        component: index of its connected component, largest first; components share no frame.
        status: ``placed``, ``tentative`` (placed by edges in no agreeing cycle), or ``isolated``.
        covariance: (7, 7) marginal over [rot_rad, trans, log_scale] on the scene side, or None.
    """

    scene: str
    S_map_scene: Sim3
    component: int
    status: str
    covariance: np.ndarray | None = None

    def __repr__(self) -> str:
        at = f"scene={self.scene[:12]!r}, component={self.component}, status={self.status!r}"
        return f"ScenePose({at}, S_map_scene={self.S_map_scene!r})"


EDGE_USES = ("used", "tentative", "unused")


@dataclass(frozen=True)
class EdgeOutcome:
    """The result of an optimization for one edge.

    Args:
        use: ``used``, ``tentative`` (no agreeing cycle confirms it) or ``unused``.
        residual_chi2: chi-square of the edge under the solution (7 dof); None if it could not be computed.
        reason: reason why it is unused or tentative; empty if it is used.
        undecided: true if another group of edges contradicts it and nothing decides between them.
    """

    use: str
    residual_chi2: float | None = None
    reason: str = ""
    undecided: bool = False

    @property
    def reason_code(self) -> str:
        """Code of the reason, a key of `gsmap.reason_codes.REASONS`; empty without a reason."""
        return reason_code(self.reason)

    def __post_init__(self) -> None:
        if self.use not in EDGE_USES:
            raise InputError(
                f"an edge outcome must be one of {', '.join(EDGE_USES)}, got {self.use!r}", code="invalid_choice"
            )


@dataclass(frozen=True)
class Provenance:
    """The method and inputs of a pose graph solution.

    Args:
        method: ``batch`` (all poses solved) or ``incremental`` (new scenes added to the last solution).
        recipe: digest of its recipe (`gsmap.optimize.recipe_key`), or empty; incremental solutions need the same
            recipe.
        batch_scenes: number of scenes of the last batch solution.
        measured: fingerprint of the edges and priors (`gsmap.optimize`), or empty.
        contradicted_priors: scenes whose prior contradicts the edges.
    """

    method: str = "batch"
    recipe: str = ""
    batch_scenes: int = 0
    measured: str = ""
    contradicted_priors: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """The solution of one run of the pose graph optimization.

    Args:
        poses: by scene id.
        outcomes: result for every edge, by (target, source).
        settings: parameters as plain values.
        provenance: method and inputs.
        notes: remarks (covariances that could not be computed, ...).
        world: georeferences of the components with observations of the world.
    """

    poses: dict[str, ScenePose]
    outcomes: dict[tuple[str, str], EdgeOutcome] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)
    notes: tuple[str, ...] = ()
    world: tuple[Georeference, ...] = ()

    def __repr__(self) -> str:
        components = len({pose.component for pose in self.poses.values()})
        return f"PoseGraph({len(self.poses)} poses in {components} components, {len(self.outcomes)} edges)"

    def tie(self, component: int) -> Georeference | None:
        """Return the georeference of a component; None if the component has no observations of the world."""
        return next((tie for tie in self.world if tie.component == component), None)

    def use(self, target: str, source: str) -> str:
        """Return the use of an edge in the solution; ``unused`` if the optimization did not get the edge."""
        outcome = self.outcomes.get((target, source))
        return "unused" if outcome is None else outcome.use

    @property
    def undecided(self) -> tuple[tuple[str, str], ...]:
        """Pairs (target, source) of undecided edges."""
        return tuple(pair for pair, outcome in self.outcomes.items() if outcome.undecided)


POSE_CHANGES = ("added", "removed", "moved", "same")


@dataclass(frozen=True)
class PoseChange:
    """The difference of one scene's pose between two pose graphs.

    Args:
        scene: scene id.
        kind: ``added``, ``removed``, ``moved`` or ``same`` (pose and component both as before).
        rotation_deg: rotation angle; None if the scene is in only one of the two.
        translation: displacement of the scene's centre in map units; None if the scene is in only one of the two.
        scale_ratio: new scale divided by old; None if the scene is in only one of the two.
        components: component before and after, None if absent.
        statuses: status before and after, None if absent.
    """

    scene: str
    kind: str
    rotation_deg: float | None
    translation: float | None
    scale_ratio: float | None
    components: tuple[int | None, int | None]
    statuses: tuple[str | None, str | None]

    def __post_init__(self) -> None:
        if self.kind not in POSE_CHANGES:
            raise InputError(
                f"a scene's change must be one of {', '.join(POSE_CHANGES)}, got {self.kind!r}", code="invalid_choice"
            )
