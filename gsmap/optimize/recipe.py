"""Name an answer by its recipe: the versions, settings and solver that determine it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from gsmap.methods import RecipeKey
from gsmap.optimize.params import Params
from gsmap.types.plain import plain

VERSIONS = {
    "optimize": 8,
    "optimize.incremental": 7,
    "perceptual_aliasing": 1,
    "gravity_align": 1,
    "keep_unchanged_poses": 1,
    "survey": 3,
}
"""Version of each part of the optimization, raised whenever the part's result changes for the same input. The versions
are here because the modules of the parts load solvers."""


def recipe_key(params: Params) -> RecipeKey:
    """Return the recipe of a solve without its inputs (scenes, edges, reviews, priors); it includes every setting."""
    return RecipeKey("optimize", "pose_graph", dict(VERSIONS), plain(params), _gtsam())


def _gtsam() -> str:
    """Return the version of GTSAM, because another version may round differently."""
    try:
        return f"gtsam {version('gtsam')}"
    except PackageNotFoundError:
        return ""
