"""The picture of a map shows the scenes whichever way up their frame is, and says no to nothing."""

import numpy as np
import pytest
from raising import raises

from gsmap.errors import InputError
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import Sim3
from gsmap_synthetic import make_captures, make_place
from gsmap_synthetic.map_picture import _find_up, map_picture


@pytest.fixture(scope="module")
def parts():
    place = make_place(3, texel_m=0.08)
    made = make_captures(3, 2, steps=0, place=place, num_frames=24, num_gaussians=8000, size_px=(96, 72))
    poses = [Sim3.from_matrix(c.T_scene_world) for c in made]
    first = poses[0]
    out = []
    for capture, pose in zip(made, poses, strict=True):
        S = first @ pose.inverse()
        out.append((capture.name, transform_gaussians(capture.gaussians, S), transform_cameras(capture.cameras, S)))
    return out, first.rotation[:, 2]


def test_finds_up_in_a_tilted_frame(parts):
    parts, up = parts
    assert np.degrees(np.arccos(_find_up(parts) @ up)) < 0.5


def test_draws_scenes_walks_and_ties(parts):
    parts, _ = parts
    names = [name for name, *_ in parts]
    picture = map_picture(parts, [tuple(names)], width_px=640)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (640, 3)
    paper = (picture == picture[0, 0]).all(2).mean()
    assert 0.1 < paper < 0.8
    untied = map_picture(parts, width_px=640)
    assert picture.shape == untied.shape
    assert (picture != untied).any()
    orange = (np.abs(picture.astype(int) - [233, 99, 46]).sum(2) < 12).sum()
    assert orange > 300


def test_needs_a_scene():
    with raises(InputError, code="nothing_to_draw"):
        map_picture([])
