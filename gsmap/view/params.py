"""How a map is looked at."""

from __future__ import annotations

from dataclasses import dataclass, field

from gsmap.errors import ConfigError
from gsmap.view.trees import TreeParams


@dataclass(frozen=True)
class Params:
    """How a map is looked at; what is kept for that lies in the user's cache folder, not in the map.

    Args:
        tree: levels of detail of a scene.
        cache_gib: how much is kept of scenes that were looked at; those looked at longest ago go first.
        workers: threads that make levels of detail.
        overview_mb: of the first picture of an island; whatever its size, every scene has a share.
        overview_gaussians: of one scene in it at most.
        picture_px: longer side of the pictures of a pair or a change.
        pair_views: cameras of each of two captures that they are compared from.
        pictures_kept: pictures that the server keeps in memory.
        picture_gaussians: Gaussians of a pair of scenes that is drawn at most.
        site_pairs: pairs that a static page has pictures of, the most doubtful.
        site_changes: changes that a static page has pictures of, the surest.
        correspondences: of a pair that are shown.
        nodes: of a layer of a scene's graph that are shown, the weightiest.
        cameras: of a scene that are shown, evenly along its capture.
    """

    tree: TreeParams = field(default_factory=TreeParams)
    cache_gib: float = 20.0
    workers: int = 2
    overview_mb: float = 5.0
    overview_gaussians: int = 32_768
    picture_px: int = 640
    pair_views: int = 2
    pictures_kept: int = 64
    picture_gaussians: int = 8_000_000
    correspondences: int = 400
    site_pairs: int = 24
    site_changes: int = 48
    nodes: int = 2_000
    cameras: int = 300

    def __post_init__(self) -> None:
        for name in ("workers", "overview_gaussians", "pair_views", "pictures_kept", "nodes", "cameras"):
            if getattr(self, name) < 1:
                raise ConfigError(f"view.{name} must be at least 1, got {getattr(self, name)}", code="out_of_range")
        for name in ("cache_gib", "overview_mb"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"view.{name} must be positive, got {getattr(self, name)}", code="out_of_range")
        for name in ("picture_gaussians", "correspondences", "site_pairs", "site_changes"):
            if getattr(self, name) < 0:
                raise ConfigError(f"view.{name} must not be negative, got {getattr(self, name)}", code="out_of_range")
        if self.picture_px < 16:
            raise ConfigError(f"view.picture_px must be at least 16 pixels, got {self.picture_px}", code="out_of_range")
