"""Scenes count less where another scene shows the same detail more sharply."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_walls import cameras_facing, wall

from gsmap.merge import PosedScene, default_params, merge
from gsmap.merge.references import render_references
from gsmap.render import render

CAMERAS = cameras_facing(np.linspace(-0.6, 0.6, 7))


def scene(name, seed, *, contrast=0.4, grain=0.0):
    """A wall with stripes of a wavelength of seven pixels, whose contrast blur reduces, and errors of colour."""

    def stripes(x, y):
        return np.repeat(0.5 + contrast * (np.sin(45 * x) * np.cos(3 * y))[:, None], 3, axis=1)

    return PosedScene(wall(seed, -1, 1, spacing=0.02, colour=stripes, grain=grain), CAMERAS, name)


def weights_of(scenes):
    """Mean weight of each scene on the wall, where the cameras look."""
    sharpness = render_references(scenes, None, 0.0, 64, None, lambda *_: None).sharpness
    points = scenes[0].gaussians.means[np.abs(scenes[0].gaussians.means[:, 0]) < 0.6]
    return [float(sharpness.at(i, points).mean()) for i in range(len(scenes))]


def test_a_blurred_scene_counts_less_and_a_sharp_one_in_full():
    sharp, blurred = weights_of([scene("a", 0), scene("b", 1, contrast=0.1)])
    assert sharp > 0.95
    assert blurred < 0.1


@pytest.mark.parametrize("gain", [1.0, 1.4])
def test_noise_and_exposure_of_another_scene_are_no_sharpness(gain):
    noisy = scene("b", 1, grain=0.15)
    noisy = replace(noisy, gaussians=replace(noisy.gaussians, sh=noisy.gaussians.sh.copy()))
    noisy.gaussians.sh[:, 0] = gain * noisy.gaussians.sh[:, 0] + (gain - 1) * 0.5 / 0.28209479177387814
    assert weights_of([scene("a", 0), noisy])[0] > 0.8


def test_a_merge_is_as_sharp_as_the_sharpest_scene():
    sharp, blurred = scene("a", 0), scene("b", 1, contrast=0.1)
    # The blurred scene has more views, by which it would own the wall.
    blurred = replace(blurred, cameras=cameras_facing(np.linspace(-0.6, 0.6, 20)))
    merged = merge([sharp, blurred], "tto", replace(default_params("tto"), steps=60))
    assert (merged.origin == 0).mean() > 0.9
    own, shown = (render(g, CAMERAS).colour[:, 12:36, 16:48] for g in (sharp.gaussians, merged.gaussians))
    assert shown.std() > 0.85 * own.std()
