"""Replace infinities that are valid values: an opacity of exactly 0 or 1, or a Gaussian without thickness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.types import Gaussians

MAX_LOGIT = np.float32(25 * np.log(2))  # a logit whose opacity is 1 in float32
MIN_LOG_SCALE = np.float32(np.log(2e-9))  # of a scale of 2e-9 units


def clamp_infinities(gaussians: Gaussians) -> Gaussians:
    """Replace infinite logits, and log-scales of minus infinity, by finite values that render the same.

    Other infinities, such as scales of plus infinity, are damage and are left for `gsmap.ingest.validate`.
    """
    logits = clamp_column("logit_opacities", gaussians.logit_opacities)
    log_scales = clamp_column("log_scales", gaussians.log_scales)
    if logits is gaussians.logit_opacities and log_scales is gaussians.log_scales:
        return gaussians
    return replace(gaussians, log_scales=log_scales, logit_opacities=logits)


def clamp_column(name: str, column: np.ndarray) -> np.ndarray:
    """Clamp one field of Gaussians as `clamp_infinities` does; return the array itself if nothing changes."""
    if name not in ("logit_opacities", "log_scales") or not np.isinf(column).any():
        return column
    column = column.copy()
    if name == "logit_opacities":
        column[np.isposinf(column)] = MAX_LOGIT
        column[np.isneginf(column)] = -MAX_LOGIT
    else:
        column[np.isneginf(column)] = MIN_LOG_SCALE
    return column


def count_clamped(gaussians: Gaussians) -> tuple[int, int]:
    """Count the opacities and the scales whose values may come from `clamp_infinities`."""
    logits, log_scales = gaussians.logit_opacities, gaussians.log_scales
    return int((np.abs(logits) == MAX_LOGIT).sum()), int((log_scales == MIN_LOG_SCALE).sum())
