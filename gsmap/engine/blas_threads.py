"""Run jobs with one thread of BLAS, since its threads change the last bits of products and decompositions.

Results must not depend on the number of processors or workers. gsmap's own kernels give the same bits with any number
of threads, and keep theirs.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let the OpenBLAS of numpy and scipy use one thread inside; other libraries of BLAS are left as they are."""
    known = _controls()
    before = [get() for get, _ in known]
    for _, set_count in known:
        set_count(1)
    try:
        yield
    finally:
        for count, (_, set_count) in zip(before, known, strict=True):
            set_count(count)


@cache
def _controls() -> tuple[tuple[Callable[[], int], Callable[[int], None]], ...]:
    """Return functions that get and set the number of threads of each OpenBLAS that comes with numpy and scipy."""
    found = []
    for package in ("numpy", "scipy"):
        spec = find_spec(package)
        folder = Path(spec.origin).parents[1] / f"{package}.libs" if spec is not None and spec.origin else Path()
        for path in sorted(folder.glob("*openblas*")):
            library = ctypes.CDLL(str(path))  # the one that the package has loaded
            for suffix in ("64_", ""):
                with contextlib.suppress(AttributeError):
                    get = getattr(library, f"scipy_openblas_get_num_threads{suffix}")
                    found.append((get, getattr(library, f"scipy_openblas_set_num_threads{suffix}")))
                    break
    return tuple(found)
