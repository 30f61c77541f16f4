"""How far work is, in the logs: under ``gsmap.<stage>``, a line at INFO whenever something is done."""

from __future__ import annotations

import logging

from gsmap.types.progress import StageProgress


def logged(progress: StageProgress | None) -> StageProgress:
    """The same progress, and every step of it in the logs."""

    def told(stage: str, fraction: float, text: str = "") -> None:
        if text:
            logging.getLogger(f"gsmap.{stage}").info("%3.0f %% %s", 100 * fraction, text)
        if progress is not None:
            progress(stage, fraction, text)

    return told
