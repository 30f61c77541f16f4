"""A small tree of settings, with a family of methods in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from gsmap.methods import MethodParams


@dataclass(frozen=True)
class Bars:
    """Args (metres unless said otherwise):
    near_m, far_m: how close and how far
        a thing may be.
    turn_deg: largest turn.
    """

    near_m: float = 0.1
    far_m: float = 5.0
    turn_deg: float = 2.0


@dataclass(frozen=True)
class Tree:
    """A tree.

    Args:
        bars: what is tested.
        toy: which way.
        toys: of each way.
        count: how many.
        budget_s: seconds, or None where there is no limit.
        loud: whether to say so.
        mode: how; ``slow`` is exact.
        weights: one per axis.
        names: any number.

    Raises:
        ConfigError: never.
    """

    bars: Bars = Bars()
    toy: str = "wood"
    toys: MethodParams = field(default_factory=lambda: MethodParams("toy"))
    count: int = 3
    budget_s: float | None = None
    loud: bool = False
    mode: Literal["slow", "fast"] = "slow"
    weights: tuple[float, float] = (1.0, 2.0)
    names: tuple[str, ...] = ()
