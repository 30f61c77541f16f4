"""Our SIFT beside COLMAP's: the same features of the same picture, on every processor."""

from __future__ import annotations

import warnings

import numpy as np
import pycolmap
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from gsmap.localize.extractors import sift


def _picture() -> np.ndarray:
    """(H, W) uint8 of things of many sizes."""
    rng = np.random.default_rng(4)
    out = np.zeros((151, 202))
    for sigma in (1.0, 2.0, 4.0, 9.0, 20.0):
        layer = gaussian_filter(rng.normal(size=out.shape), sigma)
        out += layer / layer.std()
    return np.clip(110 + 35 * out, 0, 255).astype(np.uint8)


def _reference(grey: np.ndarray, params: sift.Params) -> tuple[np.ndarray, np.ndarray]:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features = params.max_features
    options.sift.peak_threshold = sift.PEAK_THRESHOLD
    options.sift.edge_threshold = sift.EDGE_THRESHOLD
    options.sift.first_octave = -1 if params.upsampled else 0
    options.sift.normalization = pycolmap.Normalization.L1_ROOT
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return pycolmap.Sift(options, pycolmap.Device.cpu).extract(grey)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("params", [sift.Params(), sift.Params(max_features=150), sift.Params(upsampled=False)])
def test_features_are_those_of_colmap(params):
    grey = _picture()
    found = sift.make({}, params).extract(np.repeat(grey[..., None], 3, axis=2))
    want, descriptors = _reference(grey, params)
    assert len(want) > 50
    assert abs(len(found) - len(want)) <= 0.01 * len(want) + 1
    assert found.angles_rad is not None
    mine = np.c_[found.pixels, np.cos(found.angles_rad), np.sin(found.angles_rad)]
    distance, row = cKDTree(mine).query(np.c_[want[:, :2], np.cos(want[:, 3]), np.sin(want[:, 3])])
    same = distance < 0.02
    assert same.mean() > 0.98
    assert (np.diff(row[same]) > 0).mean() > 0.98  # in the same order, on which the choice of features rests
    assert found.sizes_px is not None
    assert np.allclose(found.sizes_px[row[same]], want[same, 2], rtol=0.02)
    apart = np.abs(found.descriptors[row[same]] - descriptors[same]).max(1)
    assert np.quantile(apart, 0.95) < 4 / 512
