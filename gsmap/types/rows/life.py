"""A map over years: what is thinned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.scenes import SceneRef


@dataclass(frozen=True, eq=False, kw_only=True)
class ThinRow(SceneRef):
    """A capture that was considered.

    Args:
        captured_at: ISO 8601 with zone.
        thinned: whether it is kept compact now, or would be.
        num_bytes_before: of its arrays and graphs.
        num_bytes_after: the same afterwards; what it would be in a dry run.
        seen_again: share of its surface that newer captures, kept whole, looked at.
        fidelity_db: PSNR of what is kept against what there was, in the capture's own pictures; null where it was not
            measured, or nothing differs.
        reason: why it stays as it is; empty where it is thinned.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "captured_at": "captured",
        "thinned": "thinned",
        "num_bytes_before": "bytes",
        "num_bytes_after": "kept",
        "seen_again": "seen again",
        "fidelity_db": "dB",
        "reason": "why not",
    }

    captured_at: str
    thinned: bool
    num_bytes_before: int
    num_bytes_after: int
    seen_again: float
    fidelity_db: float | None
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class ThinReport(Row):
    """What was thinned, or would be.

    Args:
        dry_run: whether nothing was changed.
        scenes: the captures that were old enough, oldest first.
        num_undated: captures without a date, which stay as they are.
        num_bytes: of the arrays and graphs of all living scenes now.
        num_bytes_freed: on disk; 0 in a dry run, or where a branch or a tag still names what was there.
        fits: whether that is within the budget.
    """

    columns: ClassVar[Mapping[str, str]] = {"num_bytes": "bytes", "num_bytes_freed": "freed", "fits": "fits"}

    dry_run: bool
    scenes: tuple[ThinRow, ...]
    num_undated: int
    num_bytes: int
    num_bytes_freed: int
    fits: bool
