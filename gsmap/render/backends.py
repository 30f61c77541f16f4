"""Choice of the renderer: the native kernel on the CPU, or gsplat on CUDA."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
from typing import Literal

from gsmap.errors import ConfigError


def backend(name: str = "auto") -> Literal["native", "gsplat"]:
    """Resolve the name of a backend to ``native`` or ``gsplat``.

    The two do not give the same bits, so the answer belongs to the recipe of whatever is rendered. torch is imported
    only where gsplat and NVIDIA's driver are installed.

    Args:
        name: ``native``, ``gsplat``, or ``auto``: gsplat where it is installed and torch finds a GPU, otherwise native.

    Raises:
        ConfigError: an unknown name.
    """
    if name not in ("auto", "native", "gsplat"):
        raise ConfigError(f"backend must be auto, native or gsplat, got {name!r}", code="invalid_choice")
    if name == "gsplat" or (name == "auto" and gsplat_available()):
        return "gsplat"
    return "native"


@functools.cache
def gsplat_available() -> bool:
    """Return True if gsplat is installed and torch finds a GPU."""
    # torch is slow to import, and naming a recipe can do without it where there is no gsplat or no driver.
    if importlib.util.find_spec("gsplat") is None or not _has_driver():
        return False
    import torch

    return bool(torch.cuda.is_available())


@functools.cache
def has_triton() -> bool:
    """Return True if Triton is installed; without it torch runs the same operations, more slowly."""
    return importlib.util.find_spec("triton") is not None


def _has_driver() -> bool:
    """Return True if NVIDIA's driver is installed."""
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return False
    return True
