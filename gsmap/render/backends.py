"""Choose the renderer: the native kernel on the CPU, or gsplat on CUDA."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
from typing import Literal

from gsmap.errors import ConfigError


def backend(name: str = "auto") -> Literal["native", "gsplat"]:
    """Resolve the name of a backend to ``native`` or ``gsplat``.

    Both backends give slightly different results, so the backend is part of the recipe of every rendered result. torch
    is imported only if gsplat and NVIDIA's driver are installed.

    Args:
        name: ``native``, ``gsplat``, or ``auto`` (gsplat if it is installed and torch finds a GPU, otherwise native).

    Raises:
        ConfigError: the name is unknown.
    """
    if name not in ("auto", "native", "gsplat"):
        raise ConfigError(f"backend must be auto, native or gsplat, got {name!r}", code="invalid_choice")
    if name == "gsplat" or (name == "auto" and gsplat_available()):
        return "gsplat"
    return "native"


@functools.cache
def gsplat_available() -> bool:
    """Return whether gsplat is installed and torch finds a GPU."""
    # torch is slow to import, and the recipe key does not need it without gsplat or a driver.
    if importlib.util.find_spec("gsplat") is None or not _has_driver():
        return False
    import torch

    return bool(torch.cuda.is_available())


def _has_driver() -> bool:
    """Return whether NVIDIA's driver is installed."""
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return False
    return True
