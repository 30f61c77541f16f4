"""Thinned captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.scenes import SceneRef


@dataclass(frozen=True, eq=False, kw_only=True)
class ThinRow(SceneRef):
    """A capture that was considered for thinning.

    Args:
        captured_at: capture date, ISO 8601 with zone.
        thinned: true if it was thinned, or would be.
        num_bytes_before: size of its arrays and graphs before.
        num_bytes_after: size afterwards; an estimate in a dry run.
        seen_again: fraction of its surface that newer, whole captures observed.
        fidelity_db: PSNR of the thinned against the whole capture in its own images; null if it was not measured or
            nothing differs.
        reason: reason why it is not thinned, or empty.
        reason_code: code of the reason, a key of `gsmap.reason_codes.REASONS`, or empty.
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
    reason_code: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class ThinReport(Row):
    """The result of thinning captures, or a preview of it.

    Args:
        dry_run: true if nothing was changed.
        scenes: captures that are old enough, oldest first.
        num_undated: number of undated captures, which are never thinned.
        num_bytes: size of the arrays and graphs of all living scenes.
        num_bytes_freed: bytes freed on disk; 0 in a dry run, or if a branch or tag still needs the data.
        fits: true if the size is within the budget.
    """

    columns: ClassVar[Mapping[str, str]] = {"num_bytes": "bytes", "num_bytes_freed": "freed", "fits": "fits"}

    dry_run: bool
    scenes: tuple[ThinRow, ...]
    num_undated: int
    num_bytes: int
    num_bytes_freed: int
    fits: bool
