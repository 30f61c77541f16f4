"""Arrays as torch tensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmap.errors import MissingDependencyError


def to_tensor(array: np.ndarray, device: str) -> Any:
    """Return a float32 tensor with a copy of an array on a device.

    Raises:
        MissingDependencyError: torch is not installed.
    """
    return require_torch("tensors").from_numpy(np.array(array, dtype=np.float32)).to(device)


def require_torch(use: str) -> Any:
    """Return the module torch.

    Args:
        use: subject of the message, in the plural.

    Raises:
        MissingDependencyError: torch is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise MissingDependencyError(f"{use} need torch, which is not installed", extra="torch") from error
    return torch
