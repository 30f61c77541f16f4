"""Read and write binary glTF 2.0 (``.glb``) with the ratified ``KHR_gaussian_splatting``, as float32 or packed as SPZ.

Scales are linear, opacities in [0, 1], quaternions xyzw, and the axes left-up-front; colours are as trained (sRGB).
A file is written with everything, SH included, turned into glTF's axes, so that viewers agree whether or not they turn
SH with a node; the node's transform is the identity, but for the origin of Gaussians that have one.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, InputError, NotGaussiansError
from gsmap.formats import spz
from gsmap.formats.axes import GLTF, PLY, change_axes
from gsmap.formats.quantise import check_size, opacity_bytes, require_writable
from gsmap.geometry.boxes import box_around
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.geometry.transforms import transform_with_origin
from gsmap.types import Gaussians, Sim3

VERSION = 2
HOLDS_ORIGIN = True

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
"""An extension in draft. Its text requires left-up-front axes, but CesiumJS and cesium-native, whose makers wrote the
draft, take the numbers of the SPZ as coordinates in the node's frame; gsmap writes and reads them likewise.
"""
_MAX_JSON_BYTES = 16 << 20
_MAX_NODES = 10_000
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_ARRAY_BUFFER = 34962
_LEAST_BYTES = 56  # of a Gaussian in memory, SH degree 0
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read all splats of the default scene as one set in the axes of a ``.ply``, with node transforms applied.

    Raises:
        InputError: Not a GLB, damaged, without splats, of a draft of the extension, compressed, or with buffers
            outside the file.
    """
    return change_axes(read_world(path), PLY, GLTF)


def write(path: str | os.PathLike[str], gaussians: Gaussians, *, compressed: bool = False) -> None:
    """Write a ``.glb`` in the order of the Gaussians, with point colours for viewers that cannot draw splats.

    Args:
        compressed: Pack the Gaussians as SPZ: about a fifth of the bytes, for viewers that read `SPZ_EXTENSION`.
    """
    require_writable(path, gaussians)
    writer = write_packed if compressed else write_world
    writer(path, change_axes(gaussians, GLTF, PLY))


def holds_splats(path: str | os.PathLike[str]) -> bool:
    """Return true if the file declares Gaussians; false for a mesh or a point cloud.

    Raises:
        InputError: Not a GLB, or damaged.
    """
    used = _read_container(path)[0].get("extensionsUsed", [])
    return isinstance(used, list) and any("gaussian_splat" in str(name) for name in used)  # drafts, too: `read` says so


def read_world(path: str | os.PathLike[str], matrix: np.ndarray | None = None) -> Gaussians:
    """Read the splats of a GLB in glTF's world (y up), or in the frame to which ``matrix`` (4, 4) maps that world."""
    gltf, binary = _read_container(path)
    outer = np.eye(4) if matrix is None else matrix
    try:
        found = list(_primitives(path, gltf, outer))
        repeated = sum(int(gltf["accessors"][p["attributes"]["POSITION"]]["count"]) for p, _ in found)
        check_size(path, repeated * _LEAST_BYTES, len(binary))
        parts = [_read_primitive(path, gltf, binary, *item) for item in found]
    except MALFORMED as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not valid glTF: {type(error).__name__} {error}", code="not_json") from error
    if not parts:
        raise NotGaussiansError(f"{path} holds no Gaussian splats ({EXTENSION}); it may be a mesh or a point cloud")
    return parts[0] if len(parts) == 1 else Gaussians.concatenate(parts)


def write_world(path: str | os.PathLike[str], gaussians: Gaussians, matrix: np.ndarray | None = None) -> None:
    """Write Gaussians unchanged, in a node whose transform ``matrix`` (4, 4) maps them to glTF's world."""
    g, matrix = gaussians, _from_origin(gaussians.origin, matrix)
    unit = g.quats / np.maximum(np.linalg.norm(g.quats, axis=1, keepdims=True), 1e-30)
    unit[~unit.any(1), 0] = 1
    arrays: dict[str, np.ndarray] = {
        "POSITION": g.means,
        "COLOR_0": _point_colours(g),
        f"{EXTENSION}:ROTATION": unit[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": g.scales,
        f"{EXTENSION}:OPACITY": g.opacities,
        **{name: g.sh[:, k] for k, name in enumerate(_sh_names(g.sh.shape[1]))},
    }
    sizes = [values.size * values.itemsize for values in arrays.values()]  # each a multiple of 4 bytes
    starts = np.cumsum([0, *sizes]).tolist()
    gltf = _gltf({name: _accessor_of(name, values) for name, values in arrays.items()}, matrix)
    for accessor, view in zip(gltf["accessors"], range(len(arrays)), strict=True):
        accessor["bufferView"] = view
    gltf["bufferViews"] = [
        {"buffer": 0, "byteOffset": start, "byteLength": size, "target": _ARRAY_BUFFER}
        for start, size in zip(starts, sizes, strict=False)
    ]
    _write_container(path, gltf, [np.ascontiguousarray(values).data for values in arrays.values()])


def write_packed(path: str | os.PathLike[str], gaussians: Gaussians, matrix: np.ndarray | None = None) -> None:
    """Write Gaussians like `write_world`, packed as SPZ, which keeps positions to about 1/100,000 of the extent.

    They are counted from the middle, which the node's transform gives back: SPZ has 24 bits for a position.
    """
    low, high = box_around(gaussians.means).astype(np.float64)
    middle = (low + high) / 2
    g = replace(gaussians, means=(gaussians.means - middle).astype(np.float32))
    data = spz.pack(path, g)
    data += b"\0" * (-len(data) % 4)
    names = ["POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE"))]
    three, four = (np.broadcast_to(np.float32(0), (len(g), width)) for width in (3, 4))
    colour = np.broadcast_to(np.uint8(0), (len(g), 4))  # CesiumJS makes bytes of it, and believes what stands here
    # What the attributes are once unpacked; degree 0 is in COLOR_0.
    shown: dict[str, np.ndarray] = dict.fromkeys([*names, *_sh_names(g.sh.shape[1])[1:]], three)
    shown |= {"POSITION": g.means, "COLOR_0": colour, f"{EXTENSION}:ROTATION": four}
    gltf = _gltf(
        {name: _accessor_of(name, values) for name, values in shown.items()},
        _from_origin(gaussians.origin + middle, matrix),
    )
    gltf["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
    gltf["extensionsUsed"] = gltf["extensionsRequired"] = [EXTENSION, SPZ_EXTENSION]
    gltf["bufferViews"] = [{"buffer": 0, "byteLength": len(data)}]
    _write_container(path, gltf, [data])


def _from_origin(origin: np.ndarray, matrix: np.ndarray | None) -> np.ndarray | None:
    """Return the node matrix (4, 4) of positions relative to an origin, given the matrix (4, 4) from their frame to
    the glTF world."""
    if not origin.any():
        return matrix
    shift = np.eye(4)
    shift[:3, 3] = origin
    out: np.ndarray = shift if matrix is None else np.asarray(matrix, float) @ shift
    return out


def _gltf(accessors: dict[str, dict[str, Any]], matrix: np.ndarray | None) -> dict[str, Any]:
    """Return the glTF JSON of one node with one splat primitive and its attributes; the caller adds the buffers."""
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    splatting |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    attributes = {name: i for i, name in enumerate(accessors)}
    node: dict[str, Any] = {"mesh": 0}
    if matrix is not None:
        node["matrix"] = np.asarray(matrix, float).T.ravel().tolist()
    return {
        "asset": {"version": "2.0", "generator": "gsmap"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": attributes, "mode": 0, "extensions": {EXTENSION: splatting}}]}],
        "accessors": list(accessors.values()),
    }


def _accessor_of(name: str, values: np.ndarray) -> dict[str, Any]:
    width = values.shape[1] if values.ndim == 2 else 1
    accessor: dict[str, Any] = {
        "componentType": 5121 if values.dtype == np.uint8 else 5126,
        "count": len(values),
        "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width],
    }
    if values.dtype == np.uint8:
        accessor["normalized"] = True
    if name == "POSITION":  # the one attribute whose bounds glTF asks for
        accessor |= dict(zip(("min", "max"), box_around(values).tolist(), strict=True))
    return accessor


def _sh_names(count: int) -> list[str]:
    degree_of = np.repeat(np.arange(4), [1, 3, 5, 7])[:count].tolist()
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}" for k, degree in enumerate(degree_of)]


def _write_container(path: str | os.PathLike[str], gltf: dict[str, Any], chunks: Sequence[bytes | memoryview]) -> None:
    """Write a GLB whose one buffer consists of the chunks in order, each of a multiple of 4 bytes."""
    length = sum(memoryview(chunk).nbytes for chunk in chunks)
    gltf["buffers"] = [{"byteLength": length}]
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + length
    if total >= 2**32:
        count = gltf["accessors"][0]["count"]
        raise InputError(
            f"{path}: {count} Gaussians do not fit a GLB of 4 GiB; write 3D Tiles instead", code="unsupported_output"
        )
    with open(path, "wb") as file:
        file.write(struct.pack("<4sIIII", b"glTF", 2, total, len(text), _JSON) + text)
        file.write(struct.pack("<II", length, _BIN))
        for chunk in chunks:
            file.write(chunk)


def _point_colours(g: Gaussians) -> np.ndarray:
    """Return linear RGB and opacity (N, 4) uint8, for viewers that draw the Gaussians as points."""
    srgb = np.clip(rgb_of_sh0(g.sh[:, 0]), 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgb = np.round(linear * 255).astype(np.uint8)
    return np.concatenate([rgb, opacity_bytes(g.logit_opacities)[:, None]], axis=1)


def _read_container(path: str | os.PathLike[str]) -> tuple[dict[str, Any], np.ndarray]:
    """Return the JSON of a GLB and the bytes of its binary chunk, memory-mapped from the file."""
    size = Path(path).stat().st_size
    with open(path, "rb") as file:
        head = file.read(20)
        if len(head) < 20 or head[:4] != b"glTF":
            raise InputError(
                f"{path} is not a GLB file: it {'is empty' if not head else 'has no glTF header'}",
                code="wrong_file_type",
            )
        version, total, json_bytes, kind = struct.unpack_from("<IIII", head, 4)
        if version != 2 or kind != _JSON:
            raise InputError(
                f"{path}: GLB version {version} with first chunk {kind:#x}; gsmap reads version 2",
                code="unsupported_version",
            )
        if total > size or 20 + json_bytes > total or json_bytes > _MAX_JSON_BYTES:
            raise InputError(
                f"{path}: its header promises {total:,} bytes with {json_bytes:,} of JSON, the file has {size:,}: "
                "truncated or damaged",
                code="file_truncated",
            )
        try:
            gltf = json.loads(file.read(json_bytes))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: its JSON cannot be read: {error}", code="not_json") from error
        if not isinstance(gltf, dict):
            raise InputError(f"{path} is not valid glTF: its JSON is not an object", code="not_json")
        tail = file.read(8)
    offset = 20 + json_bytes + 8
    if len(tail) < 8 or offset >= size:
        return gltf, np.empty(0, np.uint8)
    length, kind = struct.unpack("<II", tail)
    if kind != _BIN or offset + length > size:
        raise InputError(
            f"{path}: its binary chunk is {length:,} bytes, {size - offset:,} follow: truncated or damaged",
            code="file_truncated",
        )
    return gltf, np.memmap(path, np.uint8, "r", offset, (length,)) if length else np.empty(0, np.uint8)


def _primitives(
    path: str | os.PathLike[str], gltf: dict[str, Any], outer: np.ndarray
) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield each splat primitive of the default scene with the matrix (4, 4) from its node to the outermost frame."""
    nodes = gltf.get("nodes", [])
    scenes = gltf.get("scenes", [])
    roots = scenes[gltf.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    todo = [(int(i), outer) for i in roots]
    seen = 0
    while todo:
        index, parent = todo.pop()
        seen += 1
        if seen > _MAX_NODES or index < 0:
            raise InputError(f"{path}: more than {_MAX_NODES} nodes, or nodes in a circle", code="nested_too_deeply")
        node = nodes[index]
        world = parent @ _node_matrix(node)
        todo += [(int(child), world) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in gltf["meshes"][node["mesh"]]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, world


def _node_matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node or "scale" in node:
        from gsmap.geometry.rotations import quats_to_matrices

        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        matrix[:3, :3] = quats_to_matrices(np.array([w, x, y, z])) * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _read_primitive(
    path: str | os.PathLike[str], gltf: dict[str, Any], binary: np.ndarray, primitive: dict[str, Any], world: np.ndarray
) -> Gaussians:
    splatting = primitive["extensions"][EXTENSION]
    attributes = primitive["attributes"]
    nested = splatting.get("extensions", {})
    if SPZ_EXTENSION in nested:
        local = spz.unpack(path, _view(path, gltf, binary, nested[SPZ_EXTENSION]["bufferView"]).tobytes())
        if len(local) != gltf["accessors"][attributes["POSITION"]]["count"]:
            raise InputError(
                f"{path} is damaged: its SPZ holds {len(local)} Gaussians, its accessors another number",
                code="count_mismatch",
            )
        return _placed(path, local, world)
    if nested:
        raise InputError(
            f"{path} uses the extension {', '.join(nested)}, which gsmap does not read: convert it to plain "
            f"{EXTENSION}",
            code="unsupported_feature",
        )
    if splatting.get("kernel") != "ellipse" or splatting.get("colorSpace") != "srgb_rec709_display":
        raise InputError(
            f"{path}: kernel {splatting.get('kernel')!r} and colour space {splatting.get('colorSpace')!r}; gsmap reads "
            f"'ellipse' and 'srgb_rec709_display' of the ratified {EXTENSION}",
            code="unsupported_version",
        )
    count = int(gltf["accessors"][attributes["POSITION"]]["count"])

    def values(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise InputError(
                f"{path} lacks the attribute {name}: not a file of the ratified {EXTENSION}", code="missing_attribute"
            )
        return _accessor(path, gltf, binary, attributes[name], count, width)

    scales = values(f"{EXTENSION}:SCALE", 3)
    if (scales < 0).any():
        raise InputError(
            f"{path} has negative scales: an early draft of {EXTENSION} stored logarithms; export it anew",
            code="unsupported_version",
        )
    opacities = values(f"{EXTENSION}:OPACITY", 1)[:, 0]
    if not ((opacities >= 0) & (opacities <= 1)).all():
        raise InputError(
            f"{path} has opacities outside [0, 1], as files of an early draft of {EXTENSION} may have: export it anew",
            code="unsupported_version",
        )
    degree = 0
    while degree < 3 and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    sh = [values(f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}", 3) for d in range(degree + 1) for n in range(2 * d + 1)]
    tiny = np.finfo(np.float32).tiny
    # float32 rounds what is nearly opaque to 1: keep its logit finite.
    bounded = np.clip(opacities.astype(np.float64), tiny, 1 - 2.0**-25)
    local = Gaussians(
        values("POSITION", 3),
        values(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
        np.log(np.maximum(scales, tiny)),
        np.log(bounded) - np.log1p(-bounded),
        np.stack(sh, axis=1),
    )
    return _placed(path, local, world)


def _placed(path: str | os.PathLike[str], local: Gaussians, world: np.ndarray) -> Gaussians:
    if np.array_equal(world, np.eye(4)):
        return local
    try:
        S_world_local = Sim3.from_matrix(world)
    except InputError as error:
        raise InputError(
            f"{path}: the transform of a node or tile is more than a rotation, translation and uniform scale: {error}",
            code="unsupported_transform",
        ) from error
    return transform_with_origin(local, S_world_local)


def _require_inside(path: str | os.PathLike[str], gltf: dict[str, Any], view: dict[str, Any]) -> None:
    if view["buffer"] != 0 or "uri" in gltf["buffers"][0]:
        raise InputError(
            f"{path}: its data lies outside the file; gsmap reads self-contained .glb only",
            code="content_outside_folder",
        )


def _view(path: str | os.PathLike[str], gltf: dict[str, Any], binary: np.ndarray, index: int) -> np.ndarray:
    """Return the bytes of one buffer view after checking that they lie within the file."""
    view = gltf["bufferViews"][index]
    _require_inside(path, gltf, view)
    begin, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
    if not (begin >= 0 and length > 0 and begin + length <= len(binary)):
        raise InputError(
            f"{path} is damaged: view {index} needs bytes up to {begin + length:,} of {len(binary):,}",
            code="data_outside_buffer",
        )
    return binary[begin : begin + length]


def _accessor(
    path: str | os.PathLike[str], gltf: dict[str, Any], binary: np.ndarray, index: int, count: int, width: int
) -> np.ndarray:
    """Return the values (count, width) float32 of one accessor, after checking that they lie within the file."""
    accessor = gltf["accessors"][index]
    kind, stored = _COMPONENTS.get(accessor["componentType"]), _WIDTHS.get(accessor["type"])
    if "sparse" in accessor or "bufferView" not in accessor or kind is None or stored != width:
        raise InputError(
            f"{path}: accessor {index} is sparse or of a type that no attribute of splats has", code="invalid_accessor"
        )
    if accessor["count"] != count:
        raise InputError(
            f"{path}: accessor {index} has {accessor['count']} values for {count} Gaussians", code="count_mismatch"
        )
    view = gltf["bufferViews"][accessor["bufferView"]]
    _require_inside(path, gltf, view)
    item = np.dtype(kind)
    stride = int(view.get("byteStride", item.itemsize * width))
    start, begin, length = int(accessor.get("byteOffset", 0)), int(view.get("byteOffset", 0)), int(view["byteLength"])
    needed = start + stride * (count - 1) + item.itemsize * width
    if not count > 0 or min(start, begin) < 0 or not item.itemsize * width <= stride <= 252:
        raise InputError(f"{path}: accessor {index} has impossible count, offset or stride", code="invalid_accessor")
    if needed > length or begin + length > len(binary):
        raise InputError(
            f"{path} is damaged: accessor {index} needs {needed:,} bytes of {length:,}, {len(binary):,} in all",
            code="data_outside_buffer",
        )
    raw = np.ndarray((count, width), item, binary, begin + start, (stride, item.itemsize))
    out = raw.astype(np.float32)
    if accessor.get("normalized"):
        out = np.maximum(out / np.iinfo(item).max, -1)
    return out
