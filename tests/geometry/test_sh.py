"""Degree-0 colours against the definition of the real spherical harmonics."""

import numpy as np

from gsmap.geometry.sh import SH_C0, rgb_of_sh0, sh0_of_rgb
from gsmap.geometry.transforms import sh_basis


def test_the_constant_is_the_harmonic_of_degree_0():
    np.testing.assert_allclose(SH_C0, 0.5 / np.sqrt(np.pi), rtol=1e-15)
    assert sh_basis(np.array([[0.0, 0.6, 0.8]]), 0).item() == SH_C0


def test_colours_are_what_a_renderer_shows_and_come_back():
    np.testing.assert_allclose(rgb_of_sh0(np.array([0.0, 1.0, -1.0])), [0.5, 0.5 + SH_C0, 0.5 - SH_C0])
    rgb = np.random.default_rng(0).uniform(-0.5, 1.5, (100, 3)).astype(np.float32)
    back = rgb_of_sh0(sh0_of_rgb(rgb))
    assert back.dtype == np.float32
    np.testing.assert_allclose(back, rgb, atol=1e-6)  # and not clipped
