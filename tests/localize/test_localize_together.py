"""Photographs of one place help each other; a clip is its sharpest frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.rotations import exp_so3
from gsmap.localize import Params, localize_together, read_clip
from gsmap.localize import clips as reading
from gsmap.localize.extractors import sift
from gsmap.localize.localizing import judged_poses, placement, prepared
from gsmap_synthetic import film

SIFT = sift.make({}, sift.Params())


def test_whoever_is_placed_helps_the_others(world) -> None:
    """A photo whose own matches with the map are forbidden is placed by its neighbour."""
    pose = world.poses[1].copy()
    pose[:3, :3] = pose[:3, :3] @ exp_so3(np.array([0.0, 0.05, 0.0]))
    frames = film(world.place, pose[None], size_px=(480, 360), focal=world.focal)
    beside = replace(world.photos[1], rgb=frames.images[0], name="beside")
    placed = localize_together([world.photos[1], beside], world.index, {"scene": world.placed}, SIFT, Params())
    for one, truth in zip(placed, (world.poses[1], pose), strict=True):
        assert one.is_placed, one.reason
        assert np.linalg.norm(one.T_map_camera[:3, 3] - truth[:3, 3]) < 0.06
    assert min(one.probability for one in placed) > 0.95


def test_a_pose_by_another_photos_features_alone_is_said_by_its_scene(world) -> None:
    """The map was not rendered from there, so no render says which scene it is."""
    picture, scale = prepared(world.photos[1], Params())
    scenes = {"scene": world.placed}
    found = judged_poses(picture, world.index, scenes, SIFT, Params())[0][0]
    pixels = found.settled.pixels
    unseen = replace(found.settled, looks=[], scene=np.zeros(len(pixels), int))
    said = placement("beside", replace(found, settled=unseen), 0.0, picture, scale, scenes, Params())
    assert said.is_placed, said.reason
    assert said.scenes == ("scene",)
    assert said.num_gaussians == 0


def test_photos_of_other_places_stay_refused_together(world, elsewhere) -> None:
    placed = localize_together(elsewhere.photos, world.index, {"scene": world.placed}, SIFT, Params())
    assert not any(one.is_placed for one in placed)


def clip(path, images: np.ndarray) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = images.shape[2], images.shape[1], "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def test_a_clip_gives_the_sharpest_frame_of_each_stretch(tmp_path) -> None:
    rng = np.random.default_rng(0)
    images = np.full((20, 64, 96, 3), 128, np.uint8)
    for sharp in (3, 12):
        images[sharp] = rng.integers(0, 255, (64, 96, 3))
    clip(tmp_path / "a.mp4", images)
    frames = read_clip(tmp_path / "a.mp4", params=reading.Params(every_s=1.0))
    assert [round(10 * at) for at, _ in frames] == [3, 12]
    assert frames[0][1].size_px == (96, 64)


def test_what_is_no_clip_is_refused(tmp_path) -> None:
    pytest.importorskip("av")
    with pytest.raises(NotFoundError):
        read_clip(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("no clip")
    with pytest.raises(InputError, match="not a clip"):
        read_clip(tmp_path / "text.mp4")
