"""Edges and priors as arrays, validated before any solver uses them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.similarities import Similarities, without_scale
from gsmap.types import Edge, PoseGraph, Prior
from gsmap.types.sim3 import check_sim3


@dataclass(frozen=True, eq=False)
class Measurements:
    """E edges between N scenes.

    Args:
        scene_ids: N ids, in the caller's order.
        targets, sources: (E,) rows of ``scene_ids``.
        measured: E measured ``S_target_source``.
        information: (E, D, D) information matrices; D is 6 if every edge is rigid, otherwise 7.
        confirmed: (E,) mask of edges that a person confirmed.
        disagreement: (E,) share of the surface seen in both captures that differs; NaN if unknown.
        look_alike: (E,) probability that both captures show two places that look alike; NaN if unknown.
        same_visit: (E,) mask of edges whose captures are of one visit, so that nothing changed between them.
        log_odds_wrong: (E,) log-odds by the evidence that the edge is wrong, up to a constant; NaN if unknown.
        duplicate: (E,) mask of edges between two scenes made from one capture.
    """

    scene_ids: tuple[str, ...]
    targets: np.ndarray
    sources: np.ndarray
    measured: Similarities
    information: np.ndarray
    confirmed: np.ndarray
    disagreement: np.ndarray
    look_alike: np.ndarray
    same_visit: np.ndarray
    log_odds_wrong: np.ndarray
    duplicate: np.ndarray

    @property
    def num_scenes(self) -> int:
        return len(self.scene_ids)

    def __len__(self) -> int:
        return len(self.targets)

    @property
    def dim(self) -> int:
        return self.information.shape[1]

    @cached_property
    def covariance(self) -> np.ndarray:
        """(E, D, D) covariances, the inverse information."""
        return np.linalg.inv(self.information)

    @cached_property
    def keys(self) -> list[tuple[str, str]]:
        """(target, source) ids of each edge."""
        ids = self.scene_ids
        return [(ids[a], ids[b]) for a, b in zip(self.targets.tolist(), self.sources.tolist(), strict=True)]

    def __getitem__(self, rows: np.ndarray) -> Measurements:
        """Select some of the edges; the scenes stay."""
        return Measurements(
            self.scene_ids,
            self.targets[rows],
            self.sources[rows],
            self.measured[rows],
            self.information[rows],
            self.confirmed[rows],
            self.disagreement[rows],
            self.look_alike[rows],
            self.same_visit[rows],
            self.log_odds_wrong[rows],
            self.duplicate[rows],
        )


def measurements(scene_ids: Sequence[str], edges: Sequence[Edge], *, rigid: bool | None = None) -> Measurements:
    """Check the edges and stack them in arrays.

    Args:
        rigid: use 6 (True) or 7 (False) dimensions; None chooses 6 if every edge has scale 1.

    Raises:
        InputError: names the first edge that is unusable, and why: a scene that is missing, a self-edge, the same
            (target, source) twice, an information matrix of the wrong shape, not finite, not symmetric or not SPD.
    """
    ids = tuple(scene_ids)
    row = {scene: k for k, scene in enumerate(ids)}
    if len(row) != len(ids):
        twice = next(s for k, s in enumerate(ids) if row[s] != k)
        raise InputError(f"scene {twice!r} is listed twice: pass every scene once", code="duplicate")
    seen: set[tuple[str, str]] = set()
    for edge in edges:
        for scene in (edge.target, edge.source):
            if scene not in row:
                raise InputError(
                    f"edge {_name(edge)} names scene {scene!r}, which is not in the map", code="unknown_scene"
                )
        if edge.target == edge.source:
            raise InputError(f"edge {_name(edge)} connects a scene to itself: remove it", code="self_edge")
        if (edge.target, edge.source) in seen:
            raise InputError(
                f"edge {_name(edge)} is given twice: pass one measurement for a target and source", code="duplicate"
            )
        seen.add((edge.target, edge.source))
        if np.shape(edge.information) != (7, 7):
            raise InputError(
                f"edge {_name(edge)} needs a (7, 7) information matrix, got {np.shape(edge.information)}",
                code="invalid_information",
            )
    targets = np.array([row[e.target] for e in edges], dtype=np.int64)
    sources = np.array([row[e.source] for e in edges], dtype=np.int64)
    information = np.array([e.information for e in edges], dtype=np.float64).reshape(-1, 7, 7)
    _check_information(edges, information)
    measured = Similarities.stack([e.S_target_source for e in edges])
    information = (information + information.transpose(0, 2, 1)) / 2
    if rigid if rigid is not None else not measured.log_scales.any():
        information = without_scale(information)
    return Measurements(
        ids,
        targets,
        sources,
        measured,
        np.ascontiguousarray(information),
        np.array([e.confirmed for e in edges], dtype=bool),
        np.array([e.disagreement for e in edges], dtype=np.float64),
        np.array([e.look_alike for e in edges], dtype=np.float64),
        np.array([e.same_visit for e in edges], dtype=bool),
        np.array([e.log_odds_wrong for e in edges], dtype=np.float64),
        np.array([e.duplicate for e in edges], dtype=bool),
    )


def all_rigid(edges: Sequence[Edge], priors: Sequence[Prior], previous: PoseGraph | None) -> bool:
    """Return whether no measurement has a scale, so that six dimensions suffice."""
    return (
        all(e.S_target_source.is_rigid for e in edges)
        and all(p.S_map_scene.is_rigid for p in priors)
        and (previous is None or all(p.S_map_scene.is_rigid for p in previous.poses.values()))
    )


def check_priors(scene_ids: Sequence[str], priors: Sequence[Prior]) -> None:
    """Raise `InputError` that names the first prior that is unusable."""
    known = set(scene_ids)
    for prior in priors:
        check_sim3(prior.S_map_scene, f"S_map_scene of the prior of scene {prior.scene!r}")
        sigmas = np.asarray(prior.sigmas, dtype=np.float64)
        if prior.scene not in known:
            raise InputError(f"prior names scene {prior.scene!r}, which is not in the map", code="unknown_scene")
        if sigmas.shape != (7,) or np.isnan(sigmas).any() or (sigmas <= 0).any():
            raise InputError(
                f"prior of scene {prior.scene!r} needs 7 positive sigmas (inf for an unknown component), got "
                f"{sigmas.tolist()}",
                code="invalid_sigma",
            )
        if prior.up is not None:
            up = np.asarray(prior.up, dtype=np.float64)
            usable = up.shape == (3,) and np.isfinite(up).all() and np.linalg.norm(up) > 1e-9
            if not usable or not (np.isfinite(prior.up_sigma_rad) and prior.up_sigma_rad > 0):
                raise InputError(
                    f"prior of scene {prior.scene!r} needs a finite up direction and a positive sigma",
                    code="invalid_prior",
                )


def _check_information(edges: Sequence[Edge], information: np.ndarray) -> None:
    """Check the information matrices, because GTSAM's noise models silently accept NaN, singular and indefinite
    matrices."""
    if not len(information):
        return
    finite = np.isfinite(information).all((1, 2))
    if not finite.all():
        raise InputError(
            f"edge {_name(edges[int(np.argmin(finite))])} has NaN or infinity in its information matrix",
            code="not_finite",
        )
    size = np.abs(information).max((1, 2))
    skewed = np.abs(information - information.transpose(0, 2, 1)).max((1, 2)) > 1e-6 * size
    if skewed.any():
        raise InputError(
            f"edge {_name(edges[int(np.argmax(skewed))])} has an information matrix that is not symmetric",
            code="invalid_information",
        )
    # Scale to a unit diagonal first: a matrix with one very stiff row (the scale) is well posed after scaling.
    diagonal = np.einsum("eii->ei", information)
    bad = (diagonal <= 0).any(1)
    if not bad.any():
        root = np.sqrt(diagonal)
        bad = np.linalg.eigvalsh(information / root[:, :, None] / root[:, None, :])[:, 0] < 1e-9
    if bad.any():
        raise InputError(
            f"edge {_name(edges[int(np.argmax(bad))])} has an information matrix that is not positive definite: "
            "every direction needs some certainty. Reject the edge; if an older gsmap ingested its captures at map "
            "coordinates, remove and ingest them again",
            code="invalid_information",
        )


def _name(edge: Edge) -> str:
    return f"{edge.target}:{edge.source}"
