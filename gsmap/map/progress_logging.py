"""Log one line at INFO under ``gsmap.<stage>`` for every finished step."""

from __future__ import annotations

import logging

from gsmap.types.progress import StageProgress


def log_progress(progress: StageProgress | None) -> StageProgress:
    """Return a progress callback that also logs every step."""

    def told(stage: str, fraction: float, text: str = "") -> None:
        if text:
            logging.getLogger(f"gsmap.{stage}").info("%3.0f %% %s", 100 * fraction, text)
        if progress is not None:
            progress(stage, fraction, text)

    return told
