"""Gauge (datum) of a component: the freedom that its priors leave open, and the anchor scene that fixes it.

`gsmap.optimize.gravity` aligns solved components with the vertical.
"""

from __future__ import annotations

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.directions import rotation_between
from gsmap.geometry.similarities import Similarities, exp, rotation_vectors
from gsmap.geometry.umeyama import umeyama
from gsmap.optimize.priors import UP, PriorTerms
from gsmap.types import PoseGraph, Sim3

_LOOSE = 10.0  # the anchor fixes directions in which priors are looser (radians, component sizes)
_OUTLIER_SIGMAS = 5.0  # a prior is an outlier if its residual exceeds this many of its standard deviations,
_OUTLIER_ROTATION_DEG = 10.0  # and this angle (or the length of an edge), so that drift is no outlier
_OUTLIER_DRAWS = 200  # number of random triples of position priors from which the frame of a component is tried


def choose_anchor(scenes: np.ndarray, scene_ids: tuple[str, ...], previous: PoseGraph | None) -> int:
    """Choose the scene that fixes the component's frame: its oldest scene that was in the largest previous component.

    Scenes come oldest first, so a component that absorbs another component keeps its frame, and solving again moves no
    scene without need.
    """
    if previous is None:
        return int(scenes[0])
    known = [s for s in scenes.tolist() if scene_ids[s] in previous.poses]
    if not known:
        return int(scenes[0])
    components = [previous.poses[scene_ids[s]].component for s in known]
    counts = {component: components.count(component) for component in components}
    surviving = min(counts, key=lambda component: (-counts[component], component))
    return int(known[components.index(surviving)])


def free_gauge_directions(
    poses: Similarities, scenes: np.ndarray, anchor: int, priors: PriorTerms, dim: int
) -> np.ndarray:
    """Compute the directions (K, dim), as steps of the anchor, in which the component moves without changing the
    residuals of its priors.

    Without priors these are all directions (K = dim); none if the priors fix rotation, position and, in a graph of
    similarities, scale.
    """
    if not len(priors):
        return np.eye(dim)
    start = poses[np.array([anchor])]
    size = max(1e-9, float(np.ptp(poses.translations[scenes], axis=0).max())) * float(np.exp(-start.log_scales[0]))
    unit = np.array([1.0] * 3 + [size] * 3 + [1.0])[:dim]
    _, J = priors.linearize(poses)
    carry = (poses[priors.scenes].inverse() @ poses[np.full(len(priors), anchor)]).adjoint()
    moved = (J @ carry)[:, :, :dim] * unit
    values, vectors = np.linalg.eigh(np.einsum("pij,pik->jk", moved, moved))
    return vectors[:, values < _LOOSE**-2].T / unit


def move_onto_anchor(poses: Similarities, scenes: np.ndarray, anchor: int, pose: Sim3) -> Similarities:
    """Move a component as a whole so that its anchor has the given pose."""
    rows = np.full(len(scenes), anchor)
    move = Similarities.stack([pose] * len(scenes)) @ poses[rows].inverse()
    return poses.replaced(scenes, (move @ poses[scenes]).orthonormalised())


def move_onto_priors(
    poses: Similarities, scenes: np.ndarray, anchor: int, priors: PriorTerms, dim: int
) -> Similarities:
    """Move a component as a whole to fit its priors; it does not move along directions that the priors leave open.

    A closed-form estimate from full poses, positions or up directions is refined by Gauss-Newton over the component's
    own degrees of freedom.
    """
    if not len(priors):
        return poses
    poses = _guess(poses, scenes, priors, dim)
    for _ in range(20):
        held = free_gauge_directions(poses, scenes, anchor, priors, dim)
        r, J = priors.linearize(poses)
        carry = (poses[priors.scenes].inverse() @ poses[np.full(len(priors), anchor)]).adjoint()
        moved = (J @ carry)[:, :, :dim]
        H = np.einsum("pij,pik->jk", moved, moved) + held.T @ held
        step = -np.linalg.lstsq(H, np.einsum("pij,pi->j", moved, r), rcond=1e-14)[0]
        start = poses[np.array([anchor])]
        target = (start @ exp(step[None])).orthonormalised().item(0)
        poses = move_onto_anchor(poses, scenes, anchor, target)
        if np.abs(step).max() < 1e-10:
            break
    return poses


def find_outlier_priors(poses: Similarities, priors: PriorTerms, length: float) -> np.ndarray:
    """Return a (P,) mask of outlier priors: those with large residuals after the motion of the component that satisfies
    most priors.

    A residual is large if it exceeds `_OUTLIER_SIGMAS` and, for a rotation, `_OUTLIER_ROTATION_DEG` or, for a position,
    the length of a typical edge. The motions tried come from single full poses and from triples of positions, drawn
    with a fixed seed.

    Args:
        length: length of a typical edge in map units.
    """
    knows = priors.root_weights > 0
    motions = []
    for k in np.flatnonzero(knows[:, :6].all(1))[:100]:
        want, have = priors.expected.item(k), poses.item(int(priors.scenes[k]))
        motions.append(Sim3(want.rotation, want.translation, have.scale) @ have.inverse())
    placed = np.flatnonzero(knows[:, 3:6].all(1))
    rng = np.random.default_rng(0)
    for _ in range(_OUTLIER_DRAWS if len(placed) >= 4 else 0):
        three = placed[rng.choice(len(placed), 3, replace=False)]
        try:
            motions.append(umeyama(priors.expected.translations[three], poses.translations[priors.scenes[three]]))
        except InputError:  # all three at one place
            continue
    best, most = np.zeros(len(priors), dtype=bool), 0.0
    for S in motions:
        moved = Similarities.stack([S] * len(priors)) @ poses[priors.scenes]
        shift = np.linalg.norm(moved.translations - priors.expected.translations, axis=1)
        with np.errstate(divide="ignore"):
            allowed = np.maximum(length, _OUTLIER_SIGMAS / priors.root_weights[:, 3:6].min(1))
            turn = np.maximum(np.radians(_OUTLIER_ROTATION_DEG), _OUTLIER_SIGMAS / priors.root_weights[:, :3].min(1))
        angle = np.linalg.norm(rotation_vectors(priors.expected.rotations.transpose(0, 2, 1) @ moved.rotations), axis=1)
        good = (shift < allowed) & (angle < turn)
        # Of motions that satisfy equally many priors, take the closer one: positions along a line allow two motions.
        worth = good.sum() - 0.5 * float(((shift / allowed) ** 2)[good].mean()) if good.any() else 0.0
        best, most = (good, worth) if worth > most else (best, most)
    return ~best if best.any() else best


def _guess(poses: Similarities, scenes: np.ndarray, priors: PriorTerms, dim: int) -> Similarities:
    knows = priors.root_weights > 0
    full = np.flatnonzero(knows[:, :6].all(1))
    if len(full):
        best = full[np.argmax(priors.root_weights[full, :3].sum(1))]
        pose = priors.expected.item(best)
        scene = int(priors.scenes[best])
        if dim == 6 or not knows[best, 6]:
            pose = Sim3(pose.rotation, pose.translation, float(np.exp(poses.log_scales[scene])))
        return move_onto_anchor(poses, scenes, scene, pose)
    placed = np.flatnonzero(knows[:, 3:6].all(1))
    rows = priors.scenes[placed]
    if len(np.unique(rows)) >= 3:
        try:
            S = umeyama(priors.expected.translations[placed], poses.translations[rows], with_scale=dim == 7)
        except InputError:  # all at one place: orientation is undetermined
            S = Sim3.identity()
        return _moved(poses, scenes, S)
    upright = np.flatnonzero(knows[:, 7:].all(1))
    if len(upright):
        ups = np.einsum("pij,pj->pi", poses.rotations[priors.scenes[upright]], priors.ups[upright])
        poses = _moved(poses, scenes, Sim3(rotation_between(ups.mean(0), UP), np.zeros(3)))
    if len(placed):
        shift = (priors.expected.translations[placed] - poses.translations[rows]).mean(0)
        poses = _moved(poses, scenes, Sim3(np.eye(3), shift))
    return poses


def _moved(poses: Similarities, scenes: np.ndarray, S: Sim3) -> Similarities:
    move = Similarities.stack([S] * len(scenes))
    return poses.replaced(scenes, (move @ poses[scenes]).orthonormalised())
