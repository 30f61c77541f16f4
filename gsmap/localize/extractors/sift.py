"""Extract SIFT features (Lowe 2004) with RootSIFT descriptors (Arandjelovic and Zisserman 2012), as COLMAP does on the
CPU.

A native kernel extracts the features, because extraction dominates the cost of scene views. Features equal those of
VLFeat up to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap._native import sift
from gsmap.settings.ranges import require_range
from gsmap.types.localization import Keypoints
from gsmap.types.model import ModelSpec

VERSION = 2
MODELS: tuple[str, ...] = ()


PEAK_THRESHOLD = 0.002
"""Minimum contrast of a feature, relative to the range of grey values."""

EDGE_THRESHOLD = 12.0
"""Maximum ratio of the principal curvatures of a feature, which excludes edges."""


@dataclass(frozen=True)
class Params:
    """Settings of the extractor ``sift``.

    Args:
        max_features: Largest number of features per image, at least 1, the largest features first; larger localizes
            more photos and is slower.
        upsampled: Extract features also from the image enlarged to double size, which finds twice as many features in
            three times the time.
    """

    max_features: int = 1500
    upsampled: bool = True

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "max_features")


def make(models: Mapping[str, ModelSpec], params: Params) -> SiftExtractor:
    """Create the extractor; see `gsmap.methods.extractor`."""
    return SiftExtractor(params)


class SiftExtractor:
    """An extractor of SIFT features from grey images; results do not depend on the number of threads."""

    def __init__(self, params: Params) -> None:
        self._params = params

    def extract(self, rgb: np.ndarray) -> Keypoints:
        """Extract the features of an image; see `gsmap.methods.extractor`."""
        if min(rgb.shape[:2]) < 16:  # smaller than the smallest octave
            none = np.zeros(0, np.float32)
            return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), none, none)
        # Rec. 601, as in decoding a JPEG to grey.
        grey = np.ascontiguousarray((rgb @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8))
        params = self._params
        found, descriptors = sift(grey, params.max_features, PEAK_THRESHOLD, EDGE_THRESHOLD, params.upsampled)
        pixels, sizes, angles = (np.ascontiguousarray(found[:, part]) for part in (slice(0, 2), 2, 3))
        return Keypoints(pixels, descriptors, angles, sizes)
