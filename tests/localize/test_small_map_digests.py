"""Files of a small map are compared with the digests in its header: a small map written by hand, then changed."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from raising import raises

from gsmap.errors import CorruptError
from gsmap.localize import packed_features, packed_gaussians
from gsmap.map.small_map.export import SmallLocalizer
from gsmap.types import Cameras, Gaussians
from gsmap.types.localization import SceneFeatures

SCENE = "a" * 32


def _content(seed: int) -> bytes:
    """A scene's file: 40 features of two views, and 30 Gaussians."""
    rng = np.random.default_rng(seed)
    cameras = Cameras(np.tile(np.eye(4), (2, 1, 1)), np.full((2, 4), 100.0), np.full((2, 2), 200))
    descriptors = rng.normal(size=(40, 128))
    descriptors *= 254 / np.linalg.norm(descriptors, axis=1, keepdims=True)
    features = SceneFeatures(
        SCENE,
        cameras,
        np.array([0, 20, 40]),
        rng.uniform(-1, 1, (40, 3)).astype(np.float32),
        np.round(descriptors).clip(-127, 127).astype(np.int8),
        np.zeros(40, np.uint8),
    )
    gaussians = Gaussians(
        rng.uniform(-1, 1, (30, 3)).astype(np.float32),
        rng.normal(size=(30, 4)).astype(np.float32),
        rng.normal(-4, 0.3, (30, 3)).astype(np.float32),
        rng.normal(size=30).astype(np.float32),
        rng.normal(size=(30, 1, 3)).astype(np.float32),
    )
    made = io.BytesIO()
    np.savez_compressed(made, **packed_features.pack(features, 0.01, 10), **packed_gaussians.pack(gaussians))
    return made.getvalue()


@pytest.fixture
def small(tmp_path: Path) -> Path:
    content = _content(1)
    (tmp_path / f"{SCENE}.npz").write_bytes(content)
    scene = {
        "id": SCENE,
        "name": "hall",
        "captured_at": None,
        "component": 0,
        "S_map_scene": np.eye(4).tolist(),
        "covariance": None,
        "bounds": [[-1, -1, -1], [1, 1, 1]],
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    header = {"format": "gsmap small map", "version": 2, "metres_per_unit": {"0": 1.0}, "world": [], "scenes": [scene]}
    (tmp_path / "localize.json").write_text(json.dumps(header))
    return tmp_path


def _flip_a_date(content: bytes) -> bytes:
    """One bit of the date of the archive's first member: it is under no checksum of the archive."""
    assert content[:4] == b"PK\3\4"
    return content[:12] + bytes([content[12] ^ 1]) + content[13:]


CHANGED = {"a flipped bit": _flip_a_date(_content(1)), "another scene's file": _content(2)}


@pytest.mark.parametrize("what", CHANGED)
@pytest.mark.guards("data")
def test_a_file_with_other_bytes_is_damaged_though_its_arrays_can_be_read(small: Path, what: str) -> None:
    opened = SmallLocalizer(small)
    assert opened.placed[SCENE].features.num_features == 40
    (small / f"{SCENE}.npz").write_bytes(CHANGED[what])
    with np.load(small / f"{SCENE}.npz") as arrays:
        assert all(arrays[name].size for name in arrays)
    with raises(CorruptError, code="small_map_damaged", match=f"{SCENE}.npz"):
        _ = opened.placed[SCENE].gaussians
    with raises(CorruptError, code="small_map_damaged", match=f"{SCENE}.npz"):
        SmallLocalizer(small)
