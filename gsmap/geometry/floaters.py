"""Detect floaters: points and Gaussians that do not belong to a surface."""

from __future__ import annotations

import numpy as np

from gsmap._native import unlike
from gsmap.geometry.neighbours import chunks_of_neighbours, nearest_of, neighbours_of
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.types import Gaussians

_FAR = 4.0  # in multiples of the median distance to the 8th neighbour

# Constants of linked Gaussians, chosen by ``python -m tools.bench.clean`` on synthetic places. Distances are multiples
# of the median distance to the 8th neighbour.
_NEIGHBOURS = 16
_MAX_LINK = 3.0
_MIN_SIGMA = 0.1
_MAX_SIGMAS = 4.0
_MAX_SIGMAS_ALIKE = 8.0  # of Gaussians of similar colour
_MAX_COLOUR = 0.15
_MIN_PATCH = 8  # number of linked Gaussians below which they are floaters
_MIN_SURFACE = 100  # number of linked Gaussians from which they are a surface
_MAX_GAP = 6.0  # from a surface to a patch between both
_FAR_AWAY = 3.0  # the background begins at this multiple of the radius of the surfaces before it
_MIN_LINKED = 0.5  # share of the Gaussians that must belong to surfaces for the others to be judged
_SAMPLE = 20_000


def find_floaters(points: np.ndarray, colours: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Detect points that are isolated or differ in colour from their surroundings.

    A point is isolated if the distance to its 8th neighbour exceeds 4 times the median of these distances. Floaters
    that touch a surface are detected by colour: at most one of the 8 neighbours has a similar colour.

    Args:
        points: (N, 3) points in any unit.
        colours: (N, 3) colours in any space with a Euclidean distance.
        max_difference: largest distance between similar colours.

    Returns:
        An (N,) mask of floaters, and the (N,) distance to the 8th neighbour. With fewer than 9 points the mask is all
        False and the distances are 0.
    """
    if len(points) < 9:
        return np.zeros(len(points), bool), np.zeros(len(points))
    both = (np.ascontiguousarray(array, np.float32) for array in (points, colours))
    spacing, foreign = unlike(*both, 8)
    return (spacing > _FAR * np.median(spacing)) | (foreign >= max_difference), spacing


def find_detached(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray] | None:
    """Detect Gaussians that belong to no surface, and the background around all surfaces.

    Two Gaussians are linked if each lies within a few standard deviations of the other. Linked Gaussians form patches.
    Tiny patches are floaters, and so are small patches away from every surface. The background, such as a shell that a
    trainer puts around a scene for the sky, begins where nothing but a wide gap lies before it.

    Args:
        gaussians: N valid Gaussians in any unit.

    Returns:
        Two disjoint (N,) masks: floaters and background; None if most Gaussians are not linked, so that nothing can be
        said.
    """
    if len(gaussians) < _MIN_SURFACE:
        return None
    points = gaussians.means.astype(np.float64)
    spacing = _typical_spacing(points)
    patch = _linked_patches(gaussians, spacing)
    size = np.bincount(patch)[patch]
    if (size >= _MIN_SURFACE).mean() < _MIN_LINKED:
        return None
    radius = np.linalg.norm(points - np.median(points[size >= _MIN_SURFACE], axis=0), axis=1)
    background = radius > _FAR_AWAY * _foreground_radius(patch, size, radius)
    surface = (size >= _MIN_SURFACE) & ~background
    small = np.flatnonzero((size < _MIN_SURFACE) & ~background)
    gap = np.full(len(np.bincount(patch)), np.inf)  # smallest, of each patch
    np.minimum.at(gap, patch[small], nearest_of(points[surface], points[small])[0])
    floaters = np.zeros(len(points), bool)
    floaters[small] = (size[small] < _MIN_PATCH) | (gap[patch[small]] > _MAX_GAP * spacing)
    return floaters, background


def _typical_spacing(points: np.ndarray) -> float:
    """Return the median distance to the 8th neighbour, over a sample of the points."""
    rows = np.linspace(0, len(points) - 1, min(len(points), _SAMPLE)).astype(int)
    distances, _ = neighbours_of(points, points[rows], 9)
    return float(np.median(distances[:, 8]))


def _linked_patches(gaussians: Gaussians, spacing: float) -> np.ndarray:
    """Return the (N,) numbers of the patches of linked Gaussians."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    sigmas = np.maximum(gaussians.scales, np.float32(_MIN_SIGMA * spacing))
    whiten = (quats_to_matrices(gaussians.quats.astype(np.float64)) / sigmas[:, None]).astype(np.float32)
    colours = np.clip(rgb_of_sh0(gaussians.sh[:, 0]), 0, 1)
    firsts, seconds = [], []
    for rows, distances, near in chunks_of_neighbours(gaussians.means, _NEIGHBOURS + 1):
        ahead = (near > rows[:, None]) & (near < len(gaussians)) & (distances <= _MAX_LINK * spacing)
        at, column = np.nonzero(ahead)
        a, b = rows[at], near[at, column]
        offset = gaussians.means[a] - gaussians.means[b]
        apart = np.maximum(*(np.linalg.norm(np.einsum("ni,nij->nj", offset, whiten[end]), axis=1) for end in (a, b)))
        alike = np.linalg.norm(colours[a] - colours[b], axis=1) < _MAX_COLOUR
        linked = apart <= np.where(alike, _MAX_SIGMAS_ALIKE, _MAX_SIGMAS)
        firsts.append(a[linked])
        seconds.append(b[linked])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    links = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(gaussians),) * 2)
    patches: np.ndarray = connected_components(links, directed=False)[1]
    return patches


def _foreground_radius(patch: np.ndarray, size: np.ndarray, radius: np.ndarray) -> float:
    """Return the largest radius of the surfaces before the first gap that is wide enough for a background behind it."""
    surface = size >= _MIN_SURFACE
    names, rows = np.unique(patch[surface], return_inverse=True)
    nearest, farthest = np.full(len(names), np.inf), np.zeros(len(names))
    np.minimum.at(nearest, rows, radius[surface])
    np.maximum.at(farthest, rows, radius[surface])
    order = np.argsort(nearest, kind="stable")
    reach = np.maximum.accumulate(farthest[order])
    beyond = np.flatnonzero(nearest[order][1:] > _FAR_AWAY * reach[:-1])
    return float(reach[beyond[0] if len(beyond) else -1])
