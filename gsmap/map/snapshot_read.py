"""Read the catalog as of one transaction, even if other processes write meanwhile."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from gsmap.store import Store

_P = ParamSpec("_P")
_T = TypeVar("_T")


def snapshot_read(report: Callable[Concatenate[Store, _P], _T]) -> Callable[Concatenate[Store, _P], _T]:
    """Decorate a report so that all its catalog reads see the same state."""

    @functools.wraps(report)
    def inside(store: Store, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        with store.catalog.read():
            return report(store, *args, **kwargs)

    return inside
