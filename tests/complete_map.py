"""One small map that has everything that verbs leave in a map, with every kind of export beside it.

Three visits of a room: in February a box stands elsewhere, in March it is gone. January is thinned, February was
trained again and supersedes its first training; a shed is a component of its own, an attic was removed. Objects are
named, changes and edges reviewed, a photo is kept, the map is surveyed, branched, tagged and backed up.

The command line makes it (`LINES`), so that every way to make maps can: the fixture `complete_map` in this process, the
sweeps of `tests/faults` in children that they disturb.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from PIL import Image

import gsmap.map
from gsmap import formats
from gsmap.types import Gaussians
from gsmap.types.localized_photo import LocalizedPhoto
from tools.make.tiny_encoder import image_encoder

SMALL = "export MAP HERE/small --for localize --budget 5MB"
HTML = "export MAP HERE/page.html --format html --page-mb 1"
TREE = "export MAP HERE/tree --merge union --tile-size 3 --format 3dtiles"
TILES = "export MAP OUT --merge union --tile-size 3"
LINES = (
    "init MAP",
    "settings MAP --set describe.landmarks=false --set thin.min_seen_again=0.5 --set thin.min_fidelity_db=0",
    "ingest MAP IN/january.ply --captured-at 2025-01-01 --scale known",
    "ingest MAP IN/february.ply --captured-at 2025-02-01 --scale known",
    "ingest MAP IN/shed.ply IN/attic.ply --scale known",
    "edge MAP january:february --pose IN/same.txt --sigma 0.1,0.001",
    "edge MAP january:attic --pose IN/pose.txt --sigma 1,0.1",
    "edge MAP february:shed --pose IN/pose.txt --sigma 1,0.1",
    "confirm MAP january:february --note taped",
    "reject MAP february:shed --note mirrored",
    "describe MAP",
    "optimize MAP",
    "changes MAP --pictures HERE/pictures",
    "confirm MAP c1 --note seen",
    "reject MAP c2 --note shadow",
    "edit MAP o1 --name bench --label seat --note oak",
    "edit MAP january --note wet --tag hall",
    "georeference MAP --crs EPSG:25832 --gcp IN/gcp_list.txt --check P4 --scale-bar january:0,0,0 january:1,0,0 1",
    "*photo",
    TILES,
    TREE,
    SMALL,
    HTML,
    "view MAP --export HERE/www",
    "report MAP HERE/report.html",
    "why MAP january:february --pictures HERE/pictures",
    "thin MAP --keep-days 0",
    "ingest MAP IN/again.ply --supersedes february",
    "ingest MAP IN/march.ply --captured-at 2025-03-01 --scale known",
    "edge MAP february:march --pose IN/same.txt --sigma 0.1,0.001",
    "describe MAP",
    "optimize MAP",
    "changes MAP",
    "remove MAP attic",
    "tag MAP handover",
    "branch MAP what-if",
    "edit MAP@what-if february --note later",
    "backup MAP HERE/kept",
)
"""What makes it. MAP, OUT, IN and HERE are as in `words`; ``*photo`` calls `keep_photo`."""


def words(line: str, folder: Path, samples: Path) -> list[str]:
    """The arguments of a line, in a folder that holds the map and its exports."""
    places = {"MAP": "site.gsmap", "OUT": "out", "HERE": ""}
    out = []
    for word in line.split():
        first, slash, rest = word.partition("/")
        first, at, branch = first.partition("@")
        if first == "IN":
            first = str(samples)
        elif first in places:
            first = str(folder / places[first])
        out.append(f"{first}{at}{branch}{slash}{rest}")
    return out


def make(folder: Path, samples: Path, run: Callable[[list[str]], object]) -> None:
    """Make the map in a folder by the command line.

    Args:
        run: runs arguments of ``gsmap`` and fails where they fail.
    """
    write_samples(samples)
    for line in LINES:
        if line == "*photo":
            keep_photo(folder / "site.gsmap")
        else:
            run(words(line, folder, samples))


def copy_map(source: Path, target: Path) -> None:
    """A copy to break: files of arrays are linked, since what is in its place is never written again."""

    def copy(there: str, here: str) -> None:
        if "/arrays/" in there:
            os.link(there, here)
        else:
            shutil.copy2(there, here)

    shutil.copytree(source, target, copy_function=copy, symlinks=True, dirs_exist_ok=True)


def keep_photo(site: Path) -> None:
    """Keep a photo, as localizing one does."""
    with gsmap.map.open(site) as m:
        pose = np.eye(4)
        pose[:3, 3] = [2.0, 1.5, 1.2]
        content = io.BytesIO()
        noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
        Image.fromarray(noise).save(content, "JPEG")
        photo = LocalizedPhoto(
            digest="1" * 64,
            name="photo.jpg",
            captured_at="2025-02-02T00:00:00+00:00",
            scene=m.store.scenes.get("february").id,
            T_scene_camera=pose,
            covariance=np.eye(6) * 1e-4,
            intrinsics_px=np.array([30.0, 30, 32, 24]),
            size_px=(64, 48),
            probability=0.99,
        )
        m.store.photos.add(photo, content.getvalue())


# --- captures --------------------------------------------------------------------------------------------------------

BOX, BESIDE = ((2.1, 1.3, 0.0), (2.5, 1.7, 0.6)), ((1.0, 0.5, 0.0), (1.4, 0.9, 0.6))
BENCH = ((3.0, 0.02, 0.0), (3.6, 0.4, 0.5))


def write_samples(folder: Path) -> None:
    """Captures of a few hundred Gaussians, poses for ``gsmap edge``, control points, and models where onnx is."""
    folder.mkdir(parents=True)
    for seed, name in enumerate(("a", "b", "c", "shed", "attic")):
        formats.write(folder / f"{name}.ply", capture(seed))
        (folder / f"{name}.cameras.json").write_text(json.dumps(_frames(name)))
    rooms = {
        "then": room([BOX]),
        "now": room([]),
        "again": room([BENCH, BESIDE], opacity=4.5),
        "january": room([BENCH, BOX]),
        "february": room([BENCH, BESIDE]),
        "march": room([BENCH], opacity=4.8),
        "march2": room([BENCH], opacity=4.4),
    }
    for name, gaussians in rooms.items():
        frames = {"again": "february", "march2": "march"}.get(name, name)
        formats.write(folder / f"{name}.ply", gaussians)
        (folder / f"{name}.cameras.json").write_text(json.dumps(_views(frames)))
    for name, x in (("pose", 5.0), ("pose2", 5.1), ("same", 0.0)):
        pose = np.eye(4)
        pose[0, 3] = x
        np.savetxt(folder / f"{name}.txt", pose)
    (folder / "gcp_list.txt").write_text(_control_points())
    (folder / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    if importlib.util.find_spec("onnx") is not None:
        for name, window in (("encoder", 16), ("encoder2", 8)):
            (folder / f"{name}.onnx").write_bytes(image_encoder(window))


def capture(seed: int, count: int = 400) -> Gaussians:
    """Gaussians on the sides of a box of 4 x 3 x 2 m, of one texture."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    points *= [4.0, 3.0, 2.0]
    colours = np.sin(points * [3.0, 4.0, 5.0])[:, None]
    flat = np.full((count, 3), np.log(0.05))
    return Gaussians(points, np.tile([1.0, 0, 0, 0], (count, 1)), flat, np.full(count, 3.0), colours)


def room(boxes: Iterable[tuple[tuple[float, ...], tuple[float, ...]]], opacity: float = 5.0) -> Gaussians:
    """The same box from the inside, closed, and smaller ones in it; ``opacity`` is the logit of each Gaussian."""
    points, sizes = [_sides((0, 0, 0), (4, 3, 2), 0.2)], [0.09]
    for low, high in boxes:
        points.append(_sides(low, high, 0.05))
        sizes.append(0.03)
    scales = np.concatenate([np.full((len(part), 3), np.log(size)) for part, size in zip(points, sizes, strict=True)])
    every = np.concatenate(points)
    count, colours = len(every), np.sin(every * [3.0, 4.0, 5.0])[:, None]
    return Gaussians(every, np.tile([1.0, 0, 0, 0], (count, 1)), scales, np.full(count, opacity), colours)


def _sides(low: tuple[float, ...], high: tuple[float, ...], step: float) -> np.ndarray:
    """(N, 3) points on the six sides of a box."""
    sides = []
    for axis in range(3):
        grid = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
        for end in (low[axis], high[axis]):
            grid[axis] = np.array([end])
            sides.append(np.stack(np.meshgrid(*grid), -1).reshape(-1, 3))
    return np.concatenate(sides)


_CENTRES = ((0.6, 0.6), (3.4, 0.6), (3.4, 2.4), (0.6, 2.4), (2.3, 0.4), (0.5, 1.5))
_FOCAL, _SIZE = 30.0, (64, 48)


def _axes(x: float, y: float) -> np.ndarray:
    """(3, 3) axes of a camera that looks at the middle of the room, as columns."""
    ahead = np.array([2.3 - x, 1.5 - y, -0.4])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead], 1)


def _views(name: str) -> list[dict[str, object]]:
    """Cameras around the middle, which they see."""
    return [
        {"id": i, "img_name": f"{name}_{i}", "width": _SIZE[0], "height": _SIZE[1], "position": [x, y, 1.4]}
        | {"rotation": _axes(x, y).tolist(), "fx": _FOCAL, "fy": _FOCAL}
        for i, (x, y) in enumerate(_CENTRES)
    ]


def _frames(name: str) -> list[dict[str, object]]:
    return [
        {"id": i, "img_name": f"{name}_{i}", "width": 32, "height": 24, "position": [2.0, 1.5, 1.0]}
        | {"rotation": [[0, 0, way], [-way, 0, 0], [0, -1, 0]], "fx": 20.0, "fy": 20.0}
        for i, way in enumerate((1, -1))
    ]


def _control_points() -> str:
    """Control points that photos of January and February show, in OpenDroneMap's format."""
    lines = ["EPSG:25832"]
    for k, point in enumerate(([2.0, 1.2, 1.0], [2.6, 1.8, 0.0], [2.3, 1.0, 0.6], [1.8, 1.9, 0.2]), 1):
        world = np.add(point, [500_000, 5_500_000, 100])
        for name in ("january", "february"):
            for i, (x, y) in enumerate(_CENTRES):
                seen = _axes(x, y).T @ (np.array(point) - [x, y, 1.4])
                pixel = seen[:2] / seen[2] * _FOCAL + np.array(_SIZE) / 2
                if seen[2] > 0.3 and (pixel > 1).all() and (pixel < np.array(_SIZE) - 1).all():
                    lines.append(" ".join(f"{v:.4f}" for v in (*world, *pixel)) + f" {name}_{i} P{k}")
    return "\n".join(lines) + "\n"
