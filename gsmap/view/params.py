"""Settings of the page."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range


@dataclass(frozen=True)
class Params:
    """Settings of the page; its levels of detail are kept in the user's cache folder, not in the map.

    Args:
        cache_gib: Largest size of all cached levels of detail in GiB, positive; a larger cache avoids computing levels
            again.
        workers: Number of threads that compute levels of detail, at least 1; more threads are faster and need more
            memory.
        picture_gaussians: Largest number of Gaussians, at least 0, that a pair of scenes may have for its picture to be
            drawn; a larger number draws larger pairs and needs more memory.
        site_pairs: Largest number of pairs shown with pictures on a static page, at least 0, the most doubtful first;
            more pairs make the page larger.
        site_changes: Largest number of changes shown with pictures on a static page, at least 0, the most probable
            first; more changes make the page larger.
    """

    cache_gib: float = 20.0
    workers: int = 2
    picture_gaussians: int = 8_000_000
    site_pairs: int = 24
    site_changes: int = 48

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "workers")
        require_range(self, "(0, inf]", "cache_gib")
        require_range(self, "[0, inf]", "picture_gaussians", "site_pairs", "site_changes")
