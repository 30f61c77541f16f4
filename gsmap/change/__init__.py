"""What changed between two captures of one place."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.methods import RecipeKey
from gsmap.types import ChangeReport, PlacedScene
from gsmap.types.plain import plain
from gsmap.types.progress import Progress

VERSION = 0


@dataclass(frozen=True)
class Params:
    """How changes between two captures are found.

    Args:
        min_confidence: changes less sure than this are not reported.
    """

    min_confidence: float = 0.3


def recipe_key(params: Params | None = None) -> RecipeKey:
    """What names everything that is compared in this way; the two scenes are added by whoever knows them."""
    return RecipeKey("change", "views", {"change": VERSION}, plain(params or Params()))


def compare(
    older: PlacedScene, newer: PlacedScene, params: Params | None = None, progress: Progress | None = None
) -> ChangeReport:
    """What changed from the older to the newer capture."""
    raise NotImplementedError
