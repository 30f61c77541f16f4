"""Check that settings lie in their ranges."""

from __future__ import annotations

from math import isinf

from gsmap.errors import ConfigError


def require_range(params: object, interval: str, *names: str) -> None:
    """Raise an error for settings outside of an interval, such as ``(0, 1]`` or, without an upper end, ``[0, inf]``."""
    low, high = (float(end) for end in interval[1:-1].split(","))
    wanted = f"lie in {interval}"
    if isinf(high):
        wanted = f"be at least {low:g}" if interval[0] == "[" else f"be greater than {low:g}"
    for name in names:
        value = getattr(params, name)
        is_end = (value == low and interval[0] == "(") or (value == high and interval[-1] == ")")
        if is_end or not low <= value <= high:
            raise ConfigError(f"{name} must {wanted}, got {value}", code="out_of_range")
