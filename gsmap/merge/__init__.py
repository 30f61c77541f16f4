"""Many captures of one place into one set of Gaussians.

``merge(parts, method)`` is pure: captures already in the map frame in, Gaussians out. Methods live in `mergers`.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import ModuleType

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.merge import mergers
from gsmap.merge.parts import MergeResult, Part, inside

__all__ = ["MergeResult", "Part", "default_params", "merge", "methods", "reach_m", "reading_m"]


def methods() -> list[str]:
    """Names of the merging methods there are."""
    return sorted(m.name for m in pkgutil.iter_modules(mergers.__path__))


def default_params(method: str) -> object:
    """The method's ``Params`` with their defaults."""
    return _merger(method).Params()


def reach_m(method: str, params: object | None = None) -> float:
    """How far beyond a tile's border the Gaussians of scenes decide what is in it, in metres."""
    return _merger(method).reach_m(params or default_params(method))


def reading_m(method: str, params: object | None = None) -> float:
    """How far beyond a tile's border the parts given to `merge` should reach: cameras may stand farther away."""
    merger = _merger(method)
    return getattr(merger, "reading_m", merger.reach_m)(params or default_params(method))


def merge(
    parts: Sequence[Part],
    method: str = "tto",
    params: object | None = None,
    *,
    bounds: np.ndarray | None = None,
    budget_s: float | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> MergeResult:
    """Merge parts that lie in one frame.

    Args:
        parts: captures in the map frame. For a tile, all of their Gaussians within `reading_m` of the bounds.
        method: one of `methods()`.
        params: the method's ``Params``; None takes the defaults.
        bounds: (2, 3) lowest and highest corner of a tile; the result holds the Gaussians whose mean lies in it, and
            tiles made apart, in any order, fit together. None merges everything.
        budget_s: ceiling on the wall seconds an optimising method may take; the result then says `truncated`.
        progress: told the fraction done in [0, 1] and what is being done.

    Raises:
        ConfigError: unknown method, params of another method, a budget that is not positive.
        InputError: no parts, or bounds that are empty.
    """
    merger = _merger(method)
    params = merger.Params() if params is None else params
    if not isinstance(params, merger.Params):
        raise ConfigError(f"merge method {method!r} takes {merger.__name__}.Params, got {type(params).__name__}")
    if budget_s is not None and not budget_s > 0:
        raise ConfigError(f"a merge budget must be a positive number of seconds, got {budget_s}")
    if not parts:
        raise InputError("nothing to merge: no parts given")
    if bounds is not None:
        bounds = np.asarray(bounds, dtype=np.float64)
        if bounds.shape != (2, 3) or not (bounds[1] > bounds[0]).all():
            raise InputError(f"bounds must be a (2, 3) box with low < high on every axis, got {bounds.tolist()}")

    # The result must not depend on the order of the parts.
    order = sorted(range(len(parts)), key=lambda i: parts[i].scene_id)
    result = merger.merge(
        [parts[i] for i in order], params, bounds, budget_s, progress or (lambda fraction, text: None)
    )
    keep = inside(result.gaussians.means, bounds)
    return replace(
        result,
        gaussians=result.gaussians if keep.all() else result.gaussians[keep],
        origin=np.asarray(order, dtype=np.int32)[result.origin[keep]],
        num_input=sum(int(inside(part.gaussians.means, bounds).sum()) for part in parts),
    )


def _merger(method: str) -> ModuleType:
    if method not in methods():
        raise ConfigError(f"unknown merge method {method!r}: choose one of {', '.join(methods())}")
    return importlib.import_module(f"gsmap.merge.mergers.{method}")
