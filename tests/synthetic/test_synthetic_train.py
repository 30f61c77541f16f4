"""Training improves what frames held back show, in any unit, and repeats exactly."""

import numpy as np
import pytest

from gsmap.errors import InputError
from gsmap.evaluate.images import psnr
from gsmap.render import render
from gsmap.types import Gaussians
from gsmap_synthetic import film, walk
from gsmap_synthetic.initialise import from_colour, from_depth
from gsmap_synthetic.train import Params, train


@pytest.fixture(scope="module")
def frames(place):
    return film(place, walk(place, (0, 1), 40, seed=2), size_px=(96, 72))


@pytest.fixture(scope="module")
def start(frames):
    return from_depth(frames[np.arange(40) % 8 != 3], 8000)


def _held_out(gaussians, frames):
    seen = frames[3::8]
    colour = render(gaussians, seen.cameras, depth=False, dominant_id=False).colour
    return float(
        np.mean([psnr(a, b / np.float32(255)) for a, b in zip(np.clip(colour, 0, 1), seen.images, strict=True)])
    )


def test_training_beats_the_start_on_frames_held_back(frames, start):
    trained = train(start, frames[np.arange(40) % 8 != 3], Params(steps=300))
    before, after = _held_out(start, frames), _held_out(trained, frames)
    assert before > 15
    assert after > before + 3
    assert np.isfinite(trained.means).all()
    np.testing.assert_allclose(np.linalg.norm(trained.quats, axis=1), 1, atol=1e-5)


def test_same_input_same_bits(frames, start):
    one, two = (train(start, frames, Params(steps=20), seed=5) for _ in range(2))
    np.testing.assert_array_equal(one.means, two.means)
    np.testing.assert_array_equal(one.sh, two.sh)


def test_splitting_grows_where_asked(frames):
    start = from_depth(frames, 2000)
    grown = train(start, frames, Params(steps=60, splits=2, split_share=0.1))
    assert 1.1 * len(start) < len(grown) <= 1.21 * len(start)


def test_a_start_covers_the_pictures(frames, start):
    alpha = render(start, frames.cameras[::6], depth=False, dominant_id=False).alpha
    assert np.mean(alpha > 0.8) > 0.9


def test_a_start_needs_depth(frames):
    without = type(frames)(frames.images, frames.cameras)
    with pytest.raises(InputError, match="no depth"):
        from_depth(without, 100)
    assert isinstance(from_colour(without, 500, 0.5, 6.0), Gaussians)
