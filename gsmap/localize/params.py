"""Settings of localization."""

from __future__ import annotations

from dataclasses import dataclass, field

from gsmap.localize import clips, verdict, views
from gsmap.methods import MethodParams, family
from gsmap.settings.ranges import require_range


@dataclass(frozen=True)
class Params:
    """Settings for localizing photos.

    Args:
        extractor: Method that extracts local features: ``sift``, ``onnx`` (a model of the kind ``extractor``), or one
            that another package adds.
        extractors: Settings of each extractor.
        views: Settings of the scene views whose features are stored.
        max_views: Largest number of views, at least 1, that a photo is matched with; larger localizes more photos and
            is slower.
        max_candidates: Largest number of candidate poses, at least 1, that are refined per photo; larger localizes more
            photos and is slower.
        min_change_fraction: Smallest fraction of the photo, in [0, 1], that a region must cover to be reported as a
            change; larger reports fewer changes.
        verdict: Thresholds of accepting a pose.
        clips: Settings of choosing frames of a video clip.
    """

    extractor: str = "sift"
    extractors: MethodParams = field(default_factory=lambda: MethodParams("extractor"))
    views: views.Params = field(default_factory=views.Params)
    max_views: int = 24
    max_candidates: int = 5
    min_change_fraction: float = 0.003
    verdict: verdict.Params = field(default_factory=verdict.Params)
    clips: clips.Params = field(default_factory=clips.Params)

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "max_views", "max_candidates")
        require_range(self, "[0, 1]", "min_change_fraction")
        family("extractor").get(self.extractor)
