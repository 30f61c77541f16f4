"""Which views of the map look like a photograph: a product of one matrix, over all scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """The views of many scenes.

    Args:
        scenes: ids.
        summaries: (M, S) int8 of all views.
        scene: (M,) int64 whose view it is.
        view: (M,) int64 which of its scene's.
    """

    scenes: tuple[str, ...]
    summaries: np.ndarray
    scene: np.ndarray
    view: np.ndarray

    def __len__(self) -> int:
        return len(self.summaries)

    def only(self, rows: np.ndarray) -> ViewIndex:
        """Some of the views."""
        return ViewIndex(self.scenes, self.summaries[rows], self.scene[rows], self.view[rows])


def most_alike(index: ViewIndex, summary: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the ``count`` most alike views, best first, and their cosines; equals as they lie in the index.

    Args:
        summary: (S,) int8 of the photograph.
    """
    if not len(index) or index.summaries.shape[1] != len(summary):
        return np.zeros(0, np.int64), np.zeros(0)
    photo = summary.astype(np.float32)
    cosines = np.empty(len(index), np.float32)
    for start in range(0, len(index), 16_384):  # as float32 a block is 16 MB
        block = index.summaries[start : start + 16_384].astype(np.float32)
        norms = np.linalg.norm(block, axis=1) * np.linalg.norm(photo)
        cosines[start : start + 16_384] = block @ photo / np.maximum(norms, 1e-6)
    rows = np.argsort(-cosines, kind="stable")[:count]
    return rows, cosines[rows]
