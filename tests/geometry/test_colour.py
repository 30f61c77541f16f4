"""Colour spaces."""

import numpy as np

from gsmap.geometry import colour
from gsmap.geometry.colour import srgb_to_lab


def test_white_black_and_red_are_what_the_standard_says():
    found = srgb_to_lab(np.array([[1.0, 1, 1], [0, 0, 0], [1, 0, 0]]))
    np.testing.assert_allclose(found, [[100, 0, 0], [0, 0, 0], [53.24, 80.09, 67.20]], atol=0.02)


def test_very_many_colours_are_those_of_each_part(monkeypatch):
    rgb = np.random.default_rng(0).random((1000, 3), np.float32)
    whole = srgb_to_lab(rgb)
    monkeypatch.setattr(colour, "_BLOCK", 64)
    np.testing.assert_allclose(srgb_to_lab(rgb), whole, rtol=1e-6)
