"""Folders of tiles and captures that lead elsewhere, and names that steer the terminal."""

from __future__ import annotations

import json
import os
import shutil
from typing import Any

import numpy as np
from hostile_world import World, case, make_cameras, make_gaussians

from gsmap import formats
from gsmap.formats import cameras_json

# A word is added to the scenes first, so that their tiles are made again and the old ones would go.
AGAIN = ("export MAP TILES --tile-size 0 --merge voxel", "export MAP TILES --tile-size 3 --merge union")
TILESET = ("export MAP TILES --format 3dtiles --tile-size 1 --merge union",)

# --- tiles -----------------------------------------------------------------------------------------------------------


def _tiles(w: World, **change: Any) -> None:
    path = w.tiles / "tiles.json"
    about = json.loads(path.read_text())
    for tile in about["tiles"]:
        tile.update(change)
    path.write_text(json.dumps(about))


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_tile_that_leads_upwards(w: World) -> None:
    _tiles(w, path="../home/thesis.txt", num_bytes=1400)


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_tile_that_leads_upwards_from_its_component(w: World) -> None:
    _tiles(w, path="component_0/../../home/thesis.txt")


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_tile_with_an_absolute_path(w: World) -> None:
    _tiles(w, path=str(w.home / "thesis.txt"))


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_tile_that_is_its_folder(w: World) -> None:
    _tiles(w, path="component_0/..")


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_tile_whose_name_steers_the_terminal(w: World) -> None:
    _tiles(w, path="component_0/\x1b[31m\n.ply", name="\x1b[31m\n", notes=["\x1b[31m"])


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_manifest_of_nonsense(w: World) -> None:
    _tiles(w, S_map_scene=7, bounds_m="wide", num_bytes=float("inf"))


@case(r"is not a manifest gsmap wrote", verbs=AGAIN)
def a_manifest_that_is_too_deep(w: World) -> None:
    (w.tiles / "tiles.json").write_text("[" * 200_000)


@case(r"is not a regular file", verbs=AGAIN)
def a_manifest_that_is_a_link(w: World) -> None:
    w.replaced(w.tiles / "tiles.json", w.home / "thesis.txt")


@case(r"is not a regular file", verbs=AGAIN)
def a_manifest_that_is_a_pipe(w: World) -> None:
    (w.tiles / "tiles.json").unlink()
    os.mkfifo(w.tiles / "tiles.json")


@case(r"is a link", verbs=AGAIN)
def a_component_that_is_a_link(w: World) -> None:
    shutil.move(w.tiles / "component_0", w.home / "component_0")
    (w.tiles / "component_0").symlink_to(w.home / "component_0")


@case(works=AGAIN, verbs=AGAIN)
def a_tile_that_is_a_link(w: World) -> None:
    for tile in (w.tiles / "component_0").iterdir():
        w.replaced(tile, w.home / "thesis.txt")


@case(works=AGAIN, verbs=AGAIN)
def a_staging_folder_that_is_a_link(w: World) -> None:
    (w.tiles / ".partial").symlink_to(w.home / "photos")


@case(works=AGAIN, verbs=AGAIN)
def a_staging_folder_full_of_links(w: World) -> None:
    (w.tiles / ".partial").mkdir()
    for tile in (w.tiles / "component_0").iterdir():
        (w.tiles / ".partial" / f"component_0_{tile.name}").symlink_to(w.home / "thesis.txt")


@case(r"is a link", verbs=TILESET)
def levels_that_lie_elsewhere(w: World) -> None:
    (w.tiles / "component_0" / "levels").symlink_to(w.home / "photos" / "2019")


@case(works=TILESET, verbs=TILESET)
def a_tileset_that_is_a_link(w: World) -> None:
    (w.tiles / "component_0" / "tileset.json").symlink_to(w.home / "thesis.txt")


@case(works=TILESET, verbs=TILESET)
def a_tileset_that_is_too_deep(w: World) -> None:
    (w.tiles / "component_0" / "tileset.json").write_text('{"root":' + '{"children":[' * 50_000)


# --- captures --------------------------------------------------------------------------------------------------------

INGEST = ("ingest MAP CAPTURES",)


@case(r"is not JSON", verbs=INGEST)
def cameras_that_are_a_link_to_something_else(w: World) -> None:
    (w.captures / "cameras.json").symlink_to("/etc/passwd")


@case(verbs=INGEST, works=INGEST)
def folders_that_link_in_circles(w: World) -> None:
    for name in "pqrs":
        (w.captures / name).symlink_to(w.captures)
    (w.captures / "images").symlink_to(w.captures / "images")


@case(r"is not|cannot read", verbs=INGEST)
def gaussians_that_are_a_link_to_something_else(w: World) -> None:
    (w.captures / "a.ply").symlink_to("/etc/passwd")


@case(verbs=INGEST, works=INGEST)
def gaussians_that_are_a_device_or_a_pipe(w: World) -> None:
    (w.captures / "a.ply").symlink_to("/dev/zero")
    os.mkfifo(w.captures / "b.ply")
    os.mkfifo(w.captures / "cameras.json")
    os.mkfifo(w.captures / "c.json")


@case(
    r"save its data to a file first",
    verbs=("ingest MAP HOME/../pipe.ply", "ingest MAP CAPTURES/c.ply --cameras HOME/../pipe.ply"),
)
def a_pipe_that_is_named_as_a_capture(w: World) -> None:
    os.mkfifo(w.root / "pipe.ply")


@case(r"is a pipe or a device", verbs=("convert HOME/../pipe.ply HOME/../out.spz",))
def a_pipe_to_convert(w: World) -> None:
    os.mkfifo(w.root / "pipe.ply")


@case(r"no (model )?file|no such", verbs=("models add MAP clip HOME/../pipe.onnx",))
def a_pipe_that_is_named_as_a_model(w: World) -> None:
    os.mkfifo(w.root / "pipe.onnx")


@case(r"2000000000 x 2000000000 pixels", verbs=INGEST)
def cameras_of_two_billion_pixels(w: World) -> None:
    cameras_json.write(w.captures / "c.cameras.json", make_cameras(size=(2_000_000_000, 2_000_000_000)))


@case(r"NaN or infinity|not JSON|cameras", verbs=INGEST)
def cameras_of_nan(w: World) -> None:
    cameras_json.write(w.captures / "c.cameras.json", make_cameras())
    text = (w.captures / "c.cameras.json").read_text()
    (w.captures / "c.cameras.json").write_text(text.replace("-5.0", "NaN"))


@case(r"has a control character", verbs=INGEST)
def a_capture_whose_name_steers_the_terminal(w: World) -> None:
    formats.write(w.captures / "b\x1b]0;owned\x07\nfake.ply", make_gaussians(7))


@case(r"has a control character", verbs=("ingest MAP CAPTURES/c.ply --name " + "\x1b[31mred",))
def a_name_that_steers_the_terminal(w: World) -> None:
    del w


@case(r"operating system .*\\x1b\[31mx", verbs=(f"list HOME/\x1b[31m{'x' * 300}.gsmap scenes",))
def a_name_that_the_system_refuses_and_that_steers_the_terminal(w: World) -> None:
    del w


@case(r"steer|not|cannot|unknown", verbs=("ingest MAP CAPTURES", "convert CAPTURES/x\x1b[31m.ply HOME/../o.spz"))
def a_broken_file_whose_name_steers_the_terminal(w: World) -> None:
    (w.captures / "x\x1b[31m.ply").write_bytes(b"ply\nformat \x1b[31m 1.0\n\x9b\nend_header\n")


@case(r"lies outside the folder", verbs=INGEST)
def a_tileset_whose_tiles_lie_elsewhere(w: World) -> None:
    root = {"geometricError": 0, "content": {"uri": "../home/thesis.txt.glb"}}
    box = {"box": np.r_[np.zeros(3), np.eye(3).ravel()].tolist()}
    text = json.dumps({"asset": {"version": "1.1"}, "geometricError": 0, "root": root | {"boundingVolume": box}})
    (w.captures / "tileset.json").write_text(text)


@case(r"image size|not there|cannot", verbs=INGEST)
def pictures_that_are_a_pipe(w: World) -> None:
    os.mkfifo(w.captures / "f.png")
    frames = [{"file_path": "f.png", "transform_matrix": np.eye(4).tolist()}]
    (w.captures / "transforms.json").write_text(json.dumps({"fl_x": 60, "frames": frames}))
