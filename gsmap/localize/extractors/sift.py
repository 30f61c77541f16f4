"""SIFT (Lowe 2004) with descriptors as RootSIFT (Arandjelovic and Zisserman 2012), by pycolmap on the CPU."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from gsmap.types.localization import Keypoints
from gsmap.types.model import ModelSpec

VERSION = 1
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
        self._sift = _sift(params)

    def extract(self, rgb: np.ndarray) -> Keypoints:
        """Features of a picture; see `gsmap.methods.extractor`."""
        if min(rgb.shape[:2]) < 16:  # less than the smallest octave
            return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
        # Rec. 601, as every SIFT has been computed of colour pictures since libjpeg gave grey ones.
        grey = np.ascontiguousarray((rgb @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8))
        found, descriptors = self._sift.extract(grey)
        return Keypoints(
            found[:, :2].astype(np.float32), descriptors.astype(np.float32), found[:, 3].astype(np.float32)
        )


@lru_cache(maxsize=4)
def _sift(params: Params) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # it tells of every extractor that it makes
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features = params.max_features
    options.sift.peak_threshold = params.peak_threshold
    options.sift.edge_threshold = params.edge_threshold
    options.sift.first_octave = -1 if params.doubled else 0
    options.sift.normalization = pycolmap.Normalization.L1_ROOT
    with warnings.catch_warnings():  # what is to come after it gives no arrays yet
        warnings.simplefilter("ignore", DeprecationWarning)
        return pycolmap.Sift(options, pycolmap.Device.cpu)
