"""Readers of JSON, TOML and text refuse damage that the fuzzer found (tools/check/fuzz_parsers.py) in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from raising import raises

from gsmap.cli.edge import read_pose
from gsmap.errors import ConfigError, InputError
from gsmap.export import streamed_sog, tileset
from gsmap.export.manifest import Manifest
from gsmap.map.evaluation.evaluate import _read_truth
from gsmap.map.settings import map_settings
from gsmap.settings import parse

EYE = np.eye(4).tolist()
HUGE, DEEP = 10**400, "[" * 100_000
TILE = {"name": "a", "component": 0, "path": "a.ply", "bounds_m": [[0, 0, 0], [1, 1, 1]], "num_gaussians": 1, "key": ""}
TILE |= {"num_bytes": 1, "sha256": "", "recipe": {}, "truncated": False, "notes": [], "S_map_scene": {"s": EYE}}
MANIFEST = {"version": 2, "map_id": "m", "tiles": [TILE]}


@pytest.mark.parametrize(
    "text",
    [
        DEEP,
        json.dumps({**MANIFEST, "map_id": 7}),
        json.dumps({**MANIFEST, "tiles": [{**TILE, "S_map_scene": True}]}),
        json.dumps({**MANIFEST, "tiles": [{**TILE, "bounds_m": [[HUGE] * 3] * 2}]}),
    ],
)
def test_manifest(tmp_path: Path, text: str) -> None:
    (tmp_path / "tiles.json").write_text(text)
    with raises((InputError, ConfigError), code="foreign_export"):
        Manifest.load(tmp_path, "m")


def test_a_tile_whose_path_is_no_name(tmp_path: Path) -> None:
    (tmp_path / "tiles.json").write_text(json.dumps({**MANIFEST, "tiles": [{**TILE, "path": "a\0b"}]}))
    with raises(InputError, code="foreign_export"):
        Manifest.load(tmp_path, "m")


@pytest.mark.parametrize("text", [DEEP, f'{{"root": {{"boundingVolume": {{"box": [{HUGE}, 0]}}}}}}', '{"root": 7}'])
def test_levels_of_a_tileset_that_is_not_ours_are_made_again(tmp_path: Path, text: str) -> None:
    (tmp_path / "tileset.json").write_text(text)
    assert tileset.Tiles3D().known(tmp_path) == {}
    (tmp_path / "lod-meta.json").write_text(text)
    assert streamed_sog.StreamedSog().known(tmp_path) == {}


@pytest.mark.parametrize(
    "text", [DEEP, json.dumps({"T_scene_world": [[HUGE] * 4] * 4}), "7", '{"T_scene_world": null}']
)
def test_truth(tmp_path: Path, text: str) -> None:
    (tmp_path / "hall.json").write_text(text)
    with raises(InputError, code="invalid_truth"):
        _read_truth(tmp_path, "hall")


@pytest.mark.parametrize("text", [DEEP, json.dumps([[HUGE] * 4] * 4), '{"a": 1}', "[true, {}]"])
def test_pose(tmp_path: Path, text: str) -> None:
    (tmp_path / "pose.json").write_text(text)
    with pytest.raises(InputError):
        read_pose(tmp_path / "pose.json")


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "9" * 5000,
        "a = " + DEEP,
        f"[merge.mergers.voxel]\nvoxel_m = {HUGE}",
        "[optimize]\ngate_probability = nan",
        "[describe]\nobjects = 2099-99-99",
    ],
)
def test_settings(tmp_path: Path, text: str) -> None:
    (tmp_path / "settings.toml").write_text(text)
    with raises(
        ConfigError, code=("invalid_settings_file", "invalid_setting_value", "out_of_range"), match=r"settings\.toml"
    ):
        map_settings(tmp_path, None, {})
    name, _, value = text.partition(" = ")
    assert parse(f"{name}={value}")[0] == name


def test_a_message_is_one_printable_line_whatever_it_quotes() -> None:
    quoted = str(InputError("hall\x1b]0;owned\x07\n" + "word" * 5000))
    assert quoted.isprintable()
    assert len(quoted) <= 1000
    said = str(InputError("x" * 5000 + " at line 3: " + "mend it"))
    assert said.endswith("at line 3: mend it")
    assert str(InputError(said)) == said
