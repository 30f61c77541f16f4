"""How much a report shows: its bounds hold whatever a map's size."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """How much a report shows, so that it stays a page of a few megabytes, made in seconds.

    Args:
        islands: components that get a floor plan, the largest first.
        plan_px: longer side of the picture under a floor plan.
        plan_gaussians: Gaussians that are read for such pictures, over all islands; islands beyond are drawn by the
            landmarks of their graphs.
        plan_scenes: scenes whose arrays (Gaussians or landmarks, cameras) are read for plans; of more only boxes are
            drawn.
        track_points: cameras drawn of one scene, evenly along its capture.
        pair_pictures: tentative and undecided pairs that are drawn, the most doubtful first.
        change_pictures: changes that are drawn, the surest first.
        picture_gaussians: Gaussians of a pair of scenes that is drawn at most; pictures of larger ones are left out.
        picture_px: longer side of one view in a picture of a pair or a change.
        scenes: rows in the table of scenes.
        edges: rows in the table of edges.
        changes: rows in the table of changes.
        revisions: revisions in the history, the newest.
        moves: of these so many are compared, each with the one before it.
        bars: bars in a plot; the largest are drawn.
        cells: scenes in the drawing of who was tried with whom.
    """

    islands: int = 8
    plan_px: int = 1200
    plan_gaussians: int = 2_000_000
    plan_scenes: int = 400
    track_points: int = 120
    pair_pictures: int = 6
    change_pictures: int = 6
    picture_gaussians: int = 3_000_000
    picture_px: int = 320
    scenes: int = 1000
    edges: int = 3000
    changes: int = 200
    revisions: int = 30
    moves: int = 8
    bars: int = 24
    cells: int = 300

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 0:
                raise ConfigError(f"report.{name} must not be negative, got {value}", code="out_of_range")
        for name in ("plan_px", "picture_px"):
            if getattr(self, name) < 16:
                raise ConfigError(
                    f"report.{name} must be at least 16 pixels, got {getattr(self, name)}", code="out_of_range"
                )
