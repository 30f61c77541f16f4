"""How photographs are localised."""

from __future__ import annotations

from dataclasses import dataclass, field

from gsmap.errors import ConfigError
from gsmap.localize import (
    aligning,
    bundle,
    clips,
    covariance,
    differing,
    displacing,
    evidence,
    features,
    matching,
    packing,
    resection,
    retrieval,
    settling,
    sighted,
    tracking,
    tying,
    verdict,
    views,
)
from gsmap.methods import MethodParams, family


@dataclass(frozen=True)
class Params:
    """How photographs are localised.

    Args:
        extractor: finds local features: ``sift``, ``onnx`` (a model of the kind ``extractor``), or one that another
            package adds.
        extractors: settings of each extractor.
        views: which views of a scene are rendered.
        features: which of their features are kept.
        retrieval: which views a photo is matched with.
        matching: when features of a photo and of a view are the same.
        resection: how a pose is found among matches.
        settling: how a rough pose is sharpened.
        tracking: how patches of renders are found again in a photo.
        aligning: how renders are laid over a photo.
        displacing: how far from its pixel is what a render shows.
        evidence: how a photo is compared with renders.
        covariance: how well a pose is known.
        verdict: the bars that a pose must clear.
        together: how photographs of one place help each other.
        bundle: how they are adjusted at once.
        clips: which frames of a clip are looked at.
        differences: when a placed photo shows something else than the map.
        sighted: when a placed photo says that a thing is there, or gone.
        small: what a small map keeps.
        max_enlarged: photos smaller than views are made as large, but no more times larger than this: patches and what
            is laid over are of sizes in pixels.
        max_candidates: rough poses that are looked into.
        sure: once one is this probable, others are looked into only ...
        rival_inliers: ... where so large a share of its matches agrees on them.
        skip_from: a rough pose whose matches agree with one that is this probable is not looked into.
        apart_m: settled poses farther from each other than this are different places.
    """

    extractor: str = "sift"
    extractors: MethodParams = field(default_factory=lambda: MethodParams("extractor"))
    views: views.Params = field(default_factory=views.Params)
    features: features.Params = field(default_factory=features.Params)
    retrieval: retrieval.Params = field(default_factory=retrieval.Params)
    matching: matching.Params = field(default_factory=matching.Params)
    resection: resection.Params = field(default_factory=resection.Params)
    settling: settling.Params = field(default_factory=settling.Params)
    tracking: tracking.Params = field(default_factory=tracking.Params)
    aligning: aligning.Params = field(default_factory=aligning.Params)
    displacing: displacing.Params = field(default_factory=displacing.Params)
    evidence: evidence.Params = field(default_factory=evidence.Params)
    covariance: covariance.Params = field(default_factory=covariance.Params)
    verdict: verdict.Params = field(default_factory=verdict.Params)
    together: tying.Params = field(default_factory=tying.Params)
    bundle: bundle.Params = field(default_factory=bundle.Params)
    clips: clips.Params = field(default_factory=clips.Params)
    differences: differing.Params = field(default_factory=differing.Params)
    sighted: sighted.Params = field(default_factory=sighted.Params)
    small: packing.Params = field(default_factory=packing.Params)
    max_enlarged: float = 2.0
    max_candidates: int = 5
    sure: float = 0.97
    rival_inliers: float = 0.5
    skip_from: float = 0.5
    apart_m: float = 0.5

    def __post_init__(self) -> None:
        family("extractor").get(self.extractor)
        if not self.max_enlarged >= 1:
            raise ConfigError(f"max_enlarged is 1 or more, got {self.max_enlarged}", code="out_of_range")
