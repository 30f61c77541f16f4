"""Merge several scenes of one place into one set of Gaussians.

``merge(scenes, method)`` is a pure function from scenes in the map frame to Gaussians. Built-in methods are in
`mergers`, and other packages add methods by entry points; all keep the contract in `gsmap.methods.merger`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsmap import compare, render
from gsmap.errors import ConfigError, InputError
from gsmap.geometry.boxes import inside
from gsmap.methods import MethodParams, RecipeKey, family
from gsmap.methods.merger import Merger
from gsmap.types import MergeResult, PosedScene
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 1
"""Version of the steps around a merger: how its inputs are selected, and which part of its result a tile gets."""

__all__ = [
    "VERSION",
    "MergeResult",
    "Params",
    "PosedScene",
    "checked_params",
    "default_params",
    "merge",
    "merger",
    "methods",
    "photos_m",
    "reach_m",
    "recipe_key",
    "uses_dates",
    "with_prefer",
    "with_steps",
]


@dataclass(frozen=True)
class Params:
    """Settings of merging.

    Args:
        method: Merger in use: ``tto``, ``voxel``, ``union``, ``distance``, or one that another package adds.
        mergers: Settings of each merger, by its name.
    """

    method: str = "tto"
    mergers: MethodParams = field(default_factory=lambda: MethodParams("merger"))

    def __post_init__(self) -> None:
        merger(self.method)

    def chosen(self) -> Any:
        """Return the settings of the merger in use."""
        return self.mergers[self.method]


def methods() -> list[str]:
    """Return the names of the merging methods that can be loaded."""
    return list(family("merger").usable())


def merger(method: str) -> Merger:
    """Return the merger with a name.

    Raises:
        ConfigError: the name is unknown, or the merger breaks the contract.
    """
    found: Merger = family("merger").get(method)
    return found


def default_params(method: str) -> Any:
    """Return the method's default ``Params``."""
    return merger(method).Params()


def checked_params(method: str, params: Any) -> Any:
    """Return the params after a check; for None return the method's defaults.

    Raises:
        ConfigError: the method is unknown, or the params are of another method.
    """
    wanted = merger(method).Params
    if params is None:
        return wanted()
    if not isinstance(params, wanted):
        raise ConfigError(
            f"merge method {method!r} takes {wanted.__module__}.Params, got {type(params).__module__}."
            f"{type(params).__qualname__}",
            code="invalid_method",
        )
    return params


def reach_m(method: str, params: Any = None) -> float:
    """Return the distance in metres beyond a tile's border within which Gaussians affect its content."""
    return merger(method).reach_m(checked_params(method, params))


def photos_m(method: str, params: Any = None) -> float | None:
    """Return the distance in metres beyond a tile's border within which kept photos are used; None for no photos."""
    photos_m_of = getattr(merger(method), "photos_m", None)
    found: float | None = None if photos_m_of is None else photos_m_of(checked_params(method, params))
    return found


def uses_dates(method: str, params: Any = None) -> bool:
    """Return whether a tile's content depends on the dates of the scenes."""
    return merger(method).uses_dates(checked_params(method, params))


def with_steps(method: str, params: Any, steps: int) -> Any:
    """Return the params with the given number of optimization steps.

    Raises:
        ConfigError: the method does not optimize, or the number is negative.
    """
    params, name = checked_params(method, params), merger(method).STEPS
    if name is None:
        takes = [other for other in methods() if merger(other).STEPS is not None]
        raise ConfigError(
            f"merge method {method!r} does not support --steps: leave it out, or use {' or '.join(takes)}",
            code="option_not_applicable",
        )
    if steps < 0:
        raise ConfigError(f"steps must not be negative, got {steps}", code="out_of_range")
    return replace(params, **{name: steps})


PREFERENCES = ("newest", "best", "both")


def with_prefer(method: str, params: Any, prefer: str) -> Any:
    """Return the params with the given preference where scenes disagree: the newest scene, the best observed one, or
    both.

    Raises:
        ConfigError: the preference is unknown, or the method does not use dates.
    """
    params = checked_params(method, params)
    if prefer not in PREFERENCES:
        raise ConfigError(f"--prefer must be one of {', '.join(PREFERENCES)}, got {prefer!r}", code="invalid_choice")
    if hasattr(params, "prefer"):
        return replace(params, prefer=prefer)
    takes = [other for other in methods() if hasattr(merger(other).Params(), "prefer")]
    raise ConfigError(
        f"merge method {method!r} does not support --prefer: leave it out, or use {' or '.join(takes)}",
        code="option_not_applicable",
    )


def recipe_key(method: str = "tto", params: Any = None) -> RecipeKey:
    """Return the recipe of a merge, without its inputs.

    Args:
        method: one of `methods()`.
        params: the method's ``Params``; None takes the defaults.

    Raises:
        ConfigError: unknown method, params of another method.
    """
    how, params = merger(method), checked_params(method, params)
    # A merger that uses dates compares scenes by renders, so the version of the comparison is part of its recipe.
    renders = how.RENDERS or how.uses_dates(params)
    versions = {"merge": VERSION} | ({"compare": compare.VERSION} if renders else {})
    backend, settings = render.backend() if renders else "", plain(params)
    return RecipeKey("merge", method, versions | family("merger").version(method), settings, backend)


def merge(
    scenes: Sequence[PosedScene],
    method: str = "tto",
    params: Any = None,
    *,
    bounds: np.ndarray | None = None,
    budget_s: float | None = None,
    progress: Progress | None = None,
) -> MergeResult:
    """Merge scenes in one frame.

    Args:
        scenes: scenes in the map frame. For a tile, they need all Gaussians within the merger's ``reading_m`` of the
            bounds (`gsmap.merge.tile.merge_tile` reads just these).
        method: one of `methods()`.
        params: the method's ``Params``; None takes the defaults.
        bounds: (2, 3) lowest and highest corner of a tile. The result holds the Gaussians with means in the tile; tiles
            fit together, whatever their order. None merges everything.
        budget_s: limit on the wall-clock seconds of an optimizing method; the result is `truncated` if it was reached.
        progress: called with the fraction done in [0, 1] and the current step.

    Raises:
        ConfigError: the method is unknown, the params are of another method, or the budget is not positive.
        InputError: there are no scenes, or the bounds are empty.
    """
    params = checked_params(method, params)
    if budget_s is not None and not budget_s > 0:
        raise ConfigError(
            f"the merge budget must be a positive number of seconds, got {budget_s}",
            code="invalid_budget",
        )
    if not scenes:
        raise InputError("nothing to merge: no scenes given", code="nothing_to_merge")
    if bounds is not None:
        bounds = np.asarray(bounds, dtype=np.float64)
        if bounds.shape != (2, 3) or not (bounds[1] > bounds[0]).all():
            raise InputError(
                f"bounds must be a (2, 3) box with low < high on every axis, got {bounds.tolist()}", code="invalid_box"
            )

    # The result must not depend on the order of the scenes.
    order = sorted(range(len(scenes)), key=lambda i: scenes[i].scene_id)
    result = merger(method).merge([scenes[i] for i in order], params, bounds, budget_s, progress or silent)
    keep = inside(result.gaussians.means, bounds)
    return replace(
        result,
        gaussians=result.gaussians if keep.all() else result.gaussians[keep],
        origin=np.asarray(order, dtype=np.int32)[result.origin[keep]],
        num_input=sum(int(inside(scene.gaussians.means, bounds).sum()) for scene in scenes),
    )
