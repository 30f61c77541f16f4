"""SIFT (Lowe 2004) with descriptors as RootSIFT (Arandjelovic and Zisserman 2012), as COLMAP finds them on the CPU.

It is our own kernel, for it was most of what views of a scene cost and a fifth of a photo: the steps are VLFeat's, and
so are the features, to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap._native import sift
from gsmap.types.localization import Keypoints
from gsmap.types.model import ModelSpec

VERSION = 2
MODELS: tuple[str, ...] = ()


@dataclass(frozen=True)
class Params:
    """What counts as a feature.

    Args:
        max_features: of a picture, at most; large ones are kept before small ones.
        peak_threshold: least contrast, as a share of the range of grey.
        edge_threshold: largest ratio of the two curvatures: what is no more than an edge is left out.
        doubled: look for features in the picture doubled, too: twice as many, for three times the work.
    """

    max_features: int = 1500
    peak_threshold: float = 0.002
    edge_threshold: float = 12.0
    doubled: bool = True


def make(models: Mapping[str, ModelSpec], params: Params) -> SiftExtractor:
    """Open the extractor; see `gsmap.methods.extractor`."""
    return SiftExtractor(params)


class SiftExtractor:
    """SIFT of grey pictures. The same picture gives the same features on any number of threads."""

    def __init__(self, params: Params) -> None:
        self._params = params

    def extract(self, rgb: np.ndarray) -> Keypoints:
        """Features of a picture; see `gsmap.methods.extractor`."""
        if min(rgb.shape[:2]) < 16:  # less than the smallest octave
            none = np.zeros(0, np.float32)
            return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), none, none)
        # Rec. 601, as every SIFT has been computed of colour pictures since libjpeg gave grey ones.
        grey = np.ascontiguousarray((rgb @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8))
        kept = self._params
        found, descriptors = sift(grey, kept.max_features, kept.peak_threshold, kept.edge_threshold, kept.doubled)
        pixels, sizes, angles = (np.ascontiguousarray(found[:, part]) for part in (slice(0, 2), 2, 3))
        return Keypoints(pixels, descriptors, angles, sizes)
