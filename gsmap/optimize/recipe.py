"""Recipe of an answer: the versions, settings and solver that determine it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from gsmap.methods import RecipeKey
from gsmap.optimize.params import Params
from gsmap.types.plain import plain

VERSIONS = {
    "optimize": 4,
    "optimize.incremental": 4,
    "perceptual_aliasing": 1,
    "gravity_align": 1,
    "keep_unchanged_poses": 1,
    "survey": 2,
}
"""Version by part, raised whenever its answer changes for the same input. Here, because the modules load solvers."""


def recipe_key(params: Params) -> RecipeKey:
    """Return the recipe of a solve without its inputs (scenes, edges, reviews, priors); every setting takes part."""
    return RecipeKey("optimize", "pose_graph", dict(VERSIONS), plain(params), _gtsam())


def _gtsam() -> str:
    """Return the release of the solver of the exact step: another one may round differently."""
    try:
        return f"gtsam {version('gtsam')}"
    except PackageNotFoundError:
        return ""
