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
    try:
        import torch
    except ImportError as error:
        raise MissingDependencyError("tensors need torch: pip install torch") from error
    return torch.from_numpy(np.array(array, dtype=np.float32)).to(device)
