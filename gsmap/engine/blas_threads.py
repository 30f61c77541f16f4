"""Run jobs with one thread of BLAS, since its threads change the last bits of products and decompositions.

Results must not depend on the number of processors or workers. gsmap's own kernels give the same bits with any number
of threads, and keep theirs.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_lock = threading.Lock()
_before: list[int] = []  # numbers of threads before the first of the jobs that run now
_depth = 0  # number of jobs of this process that run now, in several threads


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let the OpenBLAS of numpy and scipy use one thread inside; other libraries of BLAS are left as they are."""
    global _before, _depth
    known = _controls()
    with _lock:
        if not _depth:
            _before = [get() for get, _ in known]
            for _, set_count in known:
                set_count(1)
        _depth += 1
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if not _depth:
                for count, (_, set_count) in zip(_before, known, strict=True):
                    set_count(count)


def run_with_one_blas_thread(job: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Run a job inside `one_blas_thread` and return its result."""
    with one_blas_thread():
        return job(*arguments)


@cache
def _controls() -> tuple[tuple[Callable[[], int], Callable[[int], None]], ...]:
    """Return functions that get and set the number of threads of each OpenBLAS that comes with numpy and scipy."""
    found = []
    for package in ("numpy", "scipy"):
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            continue
        for path in sorted((Path(spec.origin).parents[1] / f"{package}.libs").glob("*openblas*")):
            library = ctypes.CDLL(str(path))  # the one that the package has loaded
            for suffix in ("64_", ""):
                with contextlib.suppress(AttributeError):
                    get = getattr(library, f"scipy_openblas_get_num_threads{suffix}")
                    found.append((get, getattr(library, f"scipy_openblas_set_num_threads{suffix}")))
                    break
    return tuple(found)
