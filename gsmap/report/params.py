"""Settings that limit the size of a report and the time to make it, whatever the size of the map."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range


@dataclass(frozen=True)
class Params:
    """Settings of the report, a page of a few megabytes that is computed in seconds.

    Args:
        islands: Largest number of components drawn as a floor plan, at least 0, the largest components first; more
            plans take longer.
        pair_pictures: Largest number of tentative and undecided pairs shown with a picture, at least 0, the most
            doubtful first; more pictures take longer and make the page larger.
        change_pictures: Largest number of changes shown with a picture, at least 0, the most probable first; more
            pictures take longer and make the page larger.
        scenes: Largest number of rows in the table of scenes, at least 0; more rows make the page larger.
        edges: Largest number of rows in the table of edges, at least 0; more rows make the page larger.
    """

    islands: int = 8
    pair_pictures: int = 6
    change_pictures: int = 6
    scenes: int = 1000
    edges: int = 3000

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", *vars(self))
