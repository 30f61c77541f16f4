"""Read and write PlayCanvas' streamed SOG, version 1: ``lod-meta.json`` beside SOG folders that viewers load by place.

Leaves of a tree of boxes name, for each level of detail, a run of the Gaussians of one SOG: level 0 is the finest. A
viewer draws one level of each leaf. Numbers that gsmap adds to a run (``error_m``, in the unit of the positions, and
PSNR) are left alone by others.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, ConfigError, InputError
from gsmap.formats import sog
from gsmap.formats.inside import file_inside
from gsmap.formats.quantise import require_writable
from gsmap.formats.tiles3d import box_of, coarser
from gsmap.geometry.boxes import box_around, cube_around, octants
from gsmap.geometry.morton import morton_codes
from gsmap.types import FileInfo, Gaussians

VERSION = 1

_MAX_JSON_BYTES = 64 << 20
_MAX_DEPTH = 64
_MAX_NODES = 100_000
_MAX_LEVELS = 32
_BLOCK = 1 << 10  # Gaussians that are compared with all leaves at once


@dataclass(frozen=True, eq=False)
class Run:
    """The run of consecutive Gaussians in a file that a leaf draws at one level.

    Args:
        uri: Path of the ``meta.json`` of a SOG, relative to ``lod-meta.json``, with ``/``.
        offset, count: Range of its Gaussians.
        extras: Additional numbers by name, which viewers ignore.
    """

    uri: str
    offset: int
    count: int
    extras: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LodNode:
    """A node of the tree in ``lod-meta.json``.

    Args:
        box: (2, 3) bounding box of its Gaussians over all levels.
        lods: Runs of a leaf by level, 0 is the finest; viewers replace a missing level by the next finer one.
        children: Children of an inner node.
    """

    box: np.ndarray
    lods: Mapping[int, Run] = field(default_factory=dict)
    children: tuple[LodNode, ...] = ()


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the finest level of every leaf; leave out an environment (sky).

    Raises:
        InputError: not a streamed SOG of version 1, a SOG that is none or lies outside its folder, or runs that are not
            in it or overlap.
    """
    path = Path(path)
    meta = _meta(path)
    finest: dict[Path, list[Run]] = defaultdict(list)
    try:
        for lods in _leaves(path, meta):
            run = next((run for _, run in sorted(lods.items()) if run.count), None)
            if run is not None:
                finest[file_inside(path, run.uri, ".json")].append(run)
    except MALFORMED as error:
        raise _not_ours(path, error) from error
    parts = [part for file, runs in sorted(finest.items()) for part in _parts(path, file, runs)]
    if not parts:
        raise InputError(f"{path} has no Gaussians", code="no_gaussians")
    return Gaussians.concatenate(parts)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return the metadata, with a note if the file has an environment, which is left out.

    Raises:
        InputError: as `read`.
    """
    left_out = bool(_meta(Path(path)).get("environment"))
    return FileInfo(notes=(f"{Path(path).name}: the environment was left out",) if left_out else ())


def write(path: str | os.PathLike[str], gaussians: Gaussians, *, max_per_leaf: int = 100_000) -> None:
    """Write a streamed SOG of an octree: level 0 has all Gaussians, other levels ``max_per_leaf / 4`` per cell.

    What is coarse is merged pair by pair with its moments kept, never dropped. Folders are named by their digests, so
    an older ``lod-meta.json`` beside them stays whole until it is replaced.

    Args:
        max_per_leaf: Gaussians of one leaf at its finest level.

    Raises:
        InputError: as `gsmap.formats.sog.write`.
        ConfigError: ``max_per_leaf`` is less than 1.
    """
    path = Path(path)
    if max_per_leaf < 1:
        raise ConfigError(f"max_per_leaf must be at least 1, got {max_per_leaf}", code="out_of_range")
    require_writable(path, gaussians)
    write_tree(path, _octree(path, gaussians, *cube_around(gaussians.means), max_per_leaf, "0").node(()))


def write_tree(path: str | os.PathLike[str], root: LodNode) -> None:
    """Write ``lod-meta.json``; call this last, when the folders that it refers to exist."""
    files: dict[str, int] = {}
    counts: dict[int, int] = defaultdict(int)
    tree = _node_json(root, files, counts)
    levels = max(counts, default=0) + 1
    meta = {
        "version": 1,
        "asset": {"generator": "gsmap"},
        "count": sum(counts.values()),
        "counts": [counts[level] for level in range(levels)],
        "lodLevels": levels,
        "filenames": list(files),
        "tree": tree,
    }
    Path(path).write_text(json.dumps(meta, indent=1))


def parted(gaussians: Gaussians, cells: np.ndarray) -> tuple[Gaussians, tuple[int, ...]]:
    """Sort Gaussians by the boxes (P, 2, 3) that they lie in; return them and the number of Gaussians of each box.

    A Gaussian belongs to the box that its mean is nearest to; within one they are along a Morton curve.
    """
    nearest = np.empty(len(gaussians), np.int64)
    for start in range(0, len(gaussians), _BLOCK):
        means = gaussians.means[start : start + _BLOCK, None].astype(np.float64)
        away = np.maximum(0, np.maximum(cells[:, 0] - means, means - cells[:, 1]))
        nearest[start : start + _BLOCK] = (away**2).sum(2).argmin(1)
    codes = morton_codes(gaussians.means, box_around(gaussians.means))
    order = np.lexsort((codes, nearest))
    return gaussians[order], tuple(np.bincount(nearest, minlength=len(cells)).tolist())


def runs(meta: Mapping[str, Any]) -> dict[str, list[Run]]:
    """Return the runs of each file in a parsed ``lod-meta.json``, sorted by offset.

    Raises:
        one of `MALFORMED`: what is parsed is no streamed SOG.
    """
    out: dict[str, list[Run]] = defaultdict(list)
    for lods in _leaves(Path("lod-meta.json"), meta):
        for run in lods.values():
            out[run.uri].append(run)
    return {uri: sorted(found, key=lambda run: run.offset) for uri, found in out.items()}


@dataclass(frozen=True, eq=False)
class _Cell:
    """A cube of the octree: the file of its Gaussians, and the number and box of those drawn for each leaf below it."""

    bounds: np.ndarray
    uri: str
    parts: tuple[int, ...]
    boxes: list[np.ndarray | None]
    error_m: float
    drawn: Gaussians
    children: tuple[_Cell, ...]

    @property
    def height(self) -> int:
        """Height of the cell above the deepest leaf below it, which is the level of its file for all leaves."""
        return max((1 + child.height for child in self.children), default=0)

    @property
    def leaves(self) -> list[_Cell]:
        return [leaf for child in self.children for leaf in child.leaves] or [self]

    def node(self, above: tuple[tuple[_Cell, int], ...]) -> LodNode:
        """Return this cell's node; ``above`` has the cells above it, each with the index there of its first leaf."""
        if not self.children:
            shown = [(cell, at) for cell, at in (*above, (self, 0)) if cell.parts[at]]
            boxes = np.stack([box for cell, at in shown if (box := cell.boxes[at]) is not None])
            lods = {
                cell.height: Run(cell.uri, sum(cell.parts[:at]), cell.parts[at], {"error_m": cell.error_m})
                for cell, at in shown
            }
            return LodNode(np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)]), lods)
        nodes, begun = [], 0
        for child in self.children:
            over = tuple((cell, at + begun) for cell, at in above)
            nodes.append(child.node((*over, (self, begun))))
            begun += len(child.leaves)
        boxes = np.stack([node.box for node in nodes])
        return LodNode(np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)]), {}, tuple(nodes))


def _octree(path: Path, gaussians: Gaussians, center: np.ndarray, side: float, max_per_leaf: int, name: str) -> _Cell:
    """Write the SOG folders of a cube and of all cubes below it; return its cell."""
    children = []
    if len(gaussians) > max_per_leaf and len(name) < _MAX_DEPTH // 2:
        for i, inside, middle in octants(gaussians.means, center, side):
            children.append(_octree(path, gaussians[inside], middle, side / 2, max_per_leaf, f"{name}{i}"))
    drawn, error_m = gaussians, 0.0
    if children:
        drawn, error_m = coarser(Gaussians.concatenate([child.drawn for child in children]), max(1, max_per_leaf // 4))
        error_m = max(error_m, 1.5 * max(child.error_m for child in children))
    leaves = [leaf for child in children for leaf in child.leaves]
    bounds = np.stack([center - side / 2, center + side / 2])
    drawn, parts = parted(drawn, np.stack([leaf.bounds for leaf in leaves] or [bounds]))
    ends = np.cumsum([0, *parts])
    boxes = [box_of(drawn[a:b]) if b > a else None for a, b in pairwise(ends)]
    return _Cell(bounds, _place(path, drawn, name), parts, boxes, error_m, drawn, tuple(children))


def _place(path: Path, gaussians: Gaussians, name: str) -> str:
    """Write the folder of a SOG under a name with its digest; return its uri."""
    staged = path.parent / f".{uuid.uuid4().hex[:8]}.{name}"
    try:
        staged.mkdir()
        sog.write(staged / "meta.json", gaussians, ordered=True)
        digest = hashlib.sha256((staged / "meta.json").read_bytes()).hexdigest()  # it names the images' digests
        folder = f"{name}-{digest[:12]}"
        if not (path.parent / folder / "meta.json").is_file():
            os.replace(staged, path.parent / folder)
    finally:
        shutil.rmtree(staged, ignore_errors=True)
    return f"{folder}/meta.json"


def _node_json(node: LodNode, files: dict[str, int], counts: dict[int, int]) -> dict[str, Any]:
    bound = {"min": node.box[0].tolist(), "max": node.box[1].tolist()}
    if node.children:
        return {"bound": bound, "children": [_node_json(child, files, counts) for child in node.children]}
    lods = {}
    for level, run in sorted(node.lods.items()):
        if run.count:
            file = files.setdefault(run.uri, len(files))
            counts[level] += run.count
            lods[str(level)] = {"file": file, "offset": run.offset, "count": run.count, **run.extras}
    return {"bound": bound, "lods": lods}


def _meta(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(
            f"{path} is larger than the {_MAX_JSON_BYTES >> 20} MiB of JSON that gsmap reads", code="file_too_large"
        )
    try:
        meta = json.loads(path.read_bytes())
        version = meta.get("version", 1)  # what splat-transform wrote before 2026 has none
        if version == 1 and "tree" in meta and "filenames" in meta:
            return dict(meta)
    except MALFORMED as error:
        raise _not_ours(path, error) from error
    raise InputError(
        f"{path} is not a streamed SOG of version 1, it has version {version} and {sorted(meta)[:9]}",
        code="unsupported_version",
    )


def _not_ours(path: Path, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    return InputError(f"{path} is not a streamed SOG: {type(error).__name__} {error}", code="wrong_file_type")


def _leaves(path: Path, meta: Mapping[str, Any]) -> Iterator[dict[int, Run]]:
    """Return the runs of each leaf, by level."""
    names = meta["filenames"]
    todo = [(meta["tree"], 0)]
    seen = 0
    while todo:
        node, depth = todo.pop()
        seen += 1
        if depth > _MAX_DEPTH or seen > _MAX_NODES:
            raise InputError(
                f"{path}: more than {_MAX_NODES} nodes, or nested deeper than {_MAX_DEPTH}", code="nested_too_deeply"
            )
        if "lods" in node:
            yield {int(level): _run(path, names, entry) for level, entry in list(node["lods"].items())[:_MAX_LEVELS]}
        todo += [(child, depth + 1) for child in reversed(node.get("children") or [])]


def _run(path: Path, names: list[str], entry: Mapping[str, Any]) -> Run:
    file, offset, count = int(entry["file"]), int(entry.get("offset", 0)), int(entry.get("count", 0))
    if not 0 <= file < len(names) or offset < 0 or count < 0:
        raise InputError(
            f"{path}: a leaf refers to {count} Gaussians from {offset} in file {file} of {len(names)}, which is not a "
            "valid run",
            code="rows_outside_file",
        )
    extras = {name: value for name, value in entry.items() if name not in ("file", "offset", "count")}
    return Run(str(names[file]), offset, count, extras)


def _parts(path: Path, file: Path, runs: list[Run]) -> Iterator[Gaussians]:
    """Read the Gaussians of some runs of one SOG, in the order of the file."""
    gaussians = sog.read(file)
    end = 0
    for run in sorted(runs, key=lambda run: run.offset):
        if run.offset < end or run.offset + run.count > len(gaussians):
            raise InputError(
                f"{path}: Gaussians {run.offset} to {run.offset + run.count} of {run.uri}, which has {len(gaussians)}, "
                "are not there or another leaf's",
                code="rows_outside_file",
            )
        end = run.offset + run.count
        yield gaussians[run.offset : end]
