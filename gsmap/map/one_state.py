"""Reports that speak of one state of a map, whatever others write meanwhile."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from gsmap.store import Store

_P = ParamSpec("_P")
_T = TypeVar("_T")


def of_one_state(report: Callable[Concatenate[Store, _P], _T]) -> Callable[Concatenate[Store, _P], _T]:
    """Let all that a function reads of the store's catalog be of one moment."""

    @functools.wraps(report)
    def inside(store: Store, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        with store.catalog.read():
            return report(store, *args, **kwargs)

    return inside
