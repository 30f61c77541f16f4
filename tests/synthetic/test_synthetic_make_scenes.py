"""tools/make/scenes.py: a real RGB-D recording, and pictures with cameras, become captures in the house layout."""

import json
import sys

import numpy as np
import pytest

from gsmap.errors import InputError
from gsmap.ingest import read_captures
from gsmap_synthetic import make_captures, write_captures


@pytest.fixture(scope="module")
def tool():
    from tools.make import scenes

    return scenes


def _run(tool, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["make_scenes.py", *map(str, arguments)])
    return tool.main()


def test_a_real_recording_becomes_a_capture(tool, shared_data, tmp_path, monkeypatch, capsys):
    small = ["--size", "160", "--gaussians", "15000", "--steps", "150"]
    assert _run(tool, monkeypatch, "frames", shared_data / "kitchen", tmp_path, "--name", "kitchen", *small) == 0
    start, trained = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert trained["psnr_trained"] > start["psnr_trained"] + 2
    (capture,) = read_captures([tmp_path / "kitchen.ply"])
    assert len(capture.cameras) == 8
    truth = np.array(json.loads((tmp_path / "truth" / "kitchen.json").read_text())["T_scene_world"])
    pose = np.loadtxt(shared_data / "kitchen" / "frame-000000.pose.txt")
    np.testing.assert_allclose(capture.cameras.T_frame_camera[0], truth @ pose, atol=1e-4)


def test_pictures_with_cameras_are_matched_by_name(tool, place, tmp_path, monkeypatch):
    made = make_captures(3, 1, steps=0, place=place, num_frames=24, num_gaussians=2000, size_px=(96, 72))
    write_captures(tmp_path / "in", made, images=True)
    frames = tool.read_frames(tmp_path / "in" / "frames", tmp_path / "in" / "capture_a.cameras.json", 48)
    assert frames.images.shape == (24, 36, 48, 3)
    assert frames.depths_m is None
    assert frames.cameras.intrinsics_px[0, 0] == pytest.approx(made[0].cameras.intrinsics_px[0, 0] / 2)


def test_says_what_is_missing(tool, tmp_path, monkeypatch, capsys):
    assert _run(tool, monkeypatch, "frames", tmp_path / "nowhere", tmp_path / "out") == 1
    assert "is not a folder" in capsys.readouterr().err
    (tmp_path / "a.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (tmp_path / "camera-intrinsics.txt").write_text("100 0 50\n0 100 40\n0 0 1\n")
    with pytest.raises(InputError, match="no picture"):
        tool.read_frames(tmp_path, None, 100)
