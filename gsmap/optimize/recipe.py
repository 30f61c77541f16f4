"""What names an answer of the optimiser."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from gsmap.methods import RecipeKey
from gsmap.optimize.params import Params
from gsmap.types.plain import plain

VERSIONS = {
    "optimize": 3,
    "optimize.incremental": 3,
    "perceptual_aliasing": 1,
    "gravity_align": 1,
    "kept_still": 1,
    "survey": 2,
}
"""By piece: raised whenever its answer changes for the same input. They stand here, and not in the modules, because
those load solvers."""


def recipe_key(params: Params) -> RecipeKey:
    """The recipe of a solve, without its inputs (scenes, edges, reviews, priors); every setting takes part."""
    return RecipeKey("optimize", "pose_graph", dict(VERSIONS), plain(params), _gtsam())


def _gtsam() -> str:
    """The solver of the last, exact step: another release of it may round otherwise."""
    try:
        return f"gtsam {version('gtsam')}"
    except PackageNotFoundError:
        return ""
