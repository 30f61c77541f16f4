"""Parsers that take bytes from outside, with small valid files to begin with: the targets of `fuzz_parsers`.

Import this under `atheris.instrument_imports`, so that gsmap's code tells where an input went.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from gsmap import formats
from gsmap.cli.edge import read_pose
from gsmap.errors import NotFoundError
from gsmap.export.manifest import Manifest
from gsmap.export.streamed_sog import StreamedSog
from gsmap.export.tileset import Tiles3D
from gsmap.formats import cameras_json, colmap, nerfstudio
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.ingest import find_captures, find_date
from gsmap.ingest.dates import date_in_name
from gsmap.ingest.validate import validate
from gsmap.map.evaluation.evaluate import _read_truth
from gsmap.map.settings import map_settings, write_settings
from gsmap.map.stages.register import read_pairs
from gsmap.networks.file import refuse_external_data
from gsmap.settings import parse
from gsmap.types import Cameras, Gaussians, Sim3, Tile
from tools.check import fuzz_mutators as mutators


@dataclass(frozen=True)
class Target:
    """One parser.

    Args:
        file: what its input is called on disk.
        seeds: writes valid files into a folder and returns their bytes.
        read: reads the file at a path, or raises a GsmapError.
        mutate: damage beneath its outer layer; see `tools.check.fuzz_mutators`.
        setup: puts beside the input what the parser wants there.
    """

    file: str
    seeds: Callable[[Path], list[bytes]]
    read: Callable[[Path], object]
    mutate: Callable[..., bytes | None] = mutators.either
    setup: Callable[[Path], object] = lambda folder: None


def gaussians_file(path: Path) -> None:
    found = formats.read(path)
    formats.info(path)
    validate(found, where=str(path))


def cameras_file(path: Path) -> None:
    formats.read_cameras(path)


def cameras_beside(path: Path) -> None:
    formats.read_cameras(path.parent)


def dated(path: Path) -> None:
    for found in find_captures([path.parent / "hall.ply"]):
        find_date(found, None, ())


def pairs(path: Path) -> None:
    known = {name: SimpleNamespace(id=name, name=name) for name in ("a", "b", "a b", "c:d")}

    def get(name: str) -> SimpleNamespace:
        if name not in known:
            raise NotFoundError(f"no scene {name!r}")
        return known[name]

    read_pairs(SimpleNamespace(scenes=SimpleNamespace(get=get)), path)


def manifest_file(path: Path) -> None:
    found = Manifest.load(path.parent, "m" * 32)
    for tile in found.tiles.values():
        found.has_file(path.parent, tile)


def assignment(path: Path) -> None:
    """``--set`` takes text; here the bytes of a file."""
    name, value = parse(path.read_bytes().decode("utf-8", "replace"))
    map_settings(path.parent / "none", None, {name: value})


# --- seeds -----------------------------------------------------------------------------------------------------------


def some(count: int, degree: int) -> Gaussians:
    rng = np.random.default_rng(count)
    k = (degree + 1) ** 2
    return Gaussians(
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(-4, 1, (count, 3)),
        rng.normal(size=count),
        rng.normal(0, 0.2, (count, k, 3)),
    )


def cameras(count: int = 3) -> Cameras:
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, 3] = np.arange(3 * count).reshape(count, 3)
    pose[-1, :3, :3] = quats_to_matrices(np.array([0.5, 0.5, 0.5, 0.5]))
    names = tuple(f"frame_{i}.jpg" for i in range(count))
    return Cameras(pose, np.full((count, 4), 240.0), np.full((count, 2), 480), names)


def written(suffix: str, *options: dict) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        out = []
        for chosen in options or ({},):
            for degree in (0, 1, 3):
                path = folder / (suffix if suffix.endswith(".json") else f"seed{suffix}")
                formats.write(path, some(5 + 260 * (degree == 0 and suffix == ".compressed.ply"), degree), **chosen)
                out.append(path.read_bytes())
        return out

    return make


def ply(folder: Path) -> list[bytes]:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {n}" for n in names), "end_header"]
    lines += [" ".join(["0.5"] * len(names))] * 3
    flat = [line for line in lines if "scale_2" not in line and "f_dc" not in line][:-3]
    colours = [f"property uchar {c}" for c in ("red", "green", "blue")] + ["property double filter_3D", "end_header"]
    rows = [" ".join(["0.5"] * 10 + ["7"] * 3 + ["0.01"])] * 3
    return [*written(".ply")(folder), *("\n".join([*t, ""]).encode() for t in (lines, [*flat[:-1], *colours, *rows]))]


def sog(folder: Path) -> list[bytes]:
    """A .sog of twelve Gaussians with one band of SH, put together by hand."""
    from PIL import Image

    rng = np.random.default_rng(0)

    def image(height: int, width: int, alpha: int = 255, top: int = 256) -> bytes:
        texels = rng.integers(0, top, (height, width, 4)).astype(np.uint8)
        texels[..., 3] = alpha
        out = io.BytesIO()
        Image.fromarray(texels, "RGBA").save(out, "WEBP", lossless=True, exact=True)
        return out.getvalue()

    book = np.linspace(-3, 3, 256).round(2).tolist()
    meta = {
        "version": 2,
        "count": 12,
        "means": {"mins": [-1, -1, -1], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
        "scales": {"files": ["scales.webp"], "codebook": book},
        "sh0": {"files": ["sh0.webp"], "codebook": book},
        "shN": {"count": 64, "bands": 1, "files": ["shN_centroids.webp", "shN_labels.webp"], "codebook": book},
    }
    files = {name: image(4, 4) for name in ("means_l", "means_u", "scales", "sh0")}
    files |= {"quats": image(4, 4, 253), "shN_centroids": image(1, 192), "shN_labels": image(4, 4, 255, 1)}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", json.dumps(meta))  # first, so that plain damage to the archive hits it too
        for name, data in files.items():
            archive.writestr(f"{name}.webp", data)
    return [out.getvalue()]


def sog_folder(folder: Path) -> list[bytes]:
    formats.write(folder / "meta.json", some(12, 1))
    return [(folder / "meta.json").read_bytes()]


def ksplat(folder: Path) -> list[bytes]:
    """One of each compression level: four splats of SH degree 1 in two buckets."""
    out = []
    for level, row in ((0, 80), (1, 42), (2, 33)):
        buckets = 2 * (level > 0)
        header = struct.pack("<BB2xIIIIHH", 0, 1, 1, 1, 4, 4, level, 0).ljust(4096, b"\0")
        section = struct.pack("<4If2H4IH", 4, 4, 3, buckets, 5.0, 12, 0, 0, 0, buckets // 2, buckets // 2, 1)
        rows = np.random.default_rng(level).integers(0, 60, 4 * row).astype(np.uint8).tobytes()
        out.append(
            header + section.ljust(1024, b"\0") + struct.pack("<I", 1)[: 2 * buckets] + bytes(12 * buckets) + rows
        )
    return out


def lcc(folder: Path) -> None:
    """What lies beside the JSON of an .lcc: two units of two levels."""
    rng = np.random.default_rng(0)
    index = b"".join(struct.pack("<I" + "IQI" * 2, i, 3, 96 * i, 96, 0, 0, 0) for i in range(2))
    (folder / "index.bin").write_bytes(index)
    (folder / "data.bin").write_bytes(rng.integers(0, 60, 192).astype(np.uint8).tobytes())
    (folder / "shcoef.bin").write_bytes(rng.integers(0, 256, 384).astype(np.uint8).tobytes())


def lcc_json(folder: Path) -> list[bytes]:
    bounds = [{"name": name, "min": [0.1] * 3, "max": [0.5] * 3} for name in ("scale", "shcoef")]
    return [
        json.dumps({"totalLevel": 2, "fileType": kind, "attributes": bounds}).encode()
        for kind in ("Quality", "Portable")
    ]


def lcc_beside(folder: Path) -> None:
    lcc(folder)
    (folder / "in.lcc").write_bytes(lcc_json(folder)[0])


def lcc_index(folder: Path) -> list[bytes]:
    lcc(folder)
    return [(folder / "index.bin").read_bytes()]


def checkpoint(folder: Path) -> list[bytes]:
    import torch

    g = some(5, 1)
    table = {"means": g.means, "quats": g.quats, "scales": g.log_scales, "opacities": g.logit_opacities}
    table |= {"sh0": g.sh[:, :1], "shN": g.sh[:, 1:]}
    tensors = {name: torch.tensor(values) for name, values in table.items()}
    out = []
    for whole in (
        {"step": 1, "splats": tensors},
        {"pipeline": {f"_model.gauss_params.{k}": v for k, v in tensors.items()}},
    ):
        torch.save(whole, folder / "seed.pt")
        out.append((folder / "seed.pt").read_bytes())
    return out


def spz(folder: Path) -> list[bytes]:
    """Versions 3 and 4 as written, and the payload of version 3 under the older headers and with an extension."""
    out = written(".spz", {"version": 3}, {"version": 4})(folder)
    inner = zlib.decompress(out[0], 31)
    axes = struct.pack("<III", 0xADBE0003, 4, 3)
    for changed in (
        *(inner[:4] + struct.pack("<I", version) + inner[8:] for version in (1, 2)),
        inner[:14] + b"\x02" + inner[15:] + axes,
    ):
        squeeze = zlib.compressobj(wbits=31)
        out.append(squeeze.compress(changed) + squeeze.flush())
    return out


def colmap_bin() -> dict[str, bytes]:
    """A COLMAP model of two cameras and three images, one of them with two points."""
    calibrations = struct.pack("<Q", 2) + struct.pack("<IiQQ4d", 1, 1, 640, 480, 500, 500, 320, 240)
    calibrations += struct.pack("<IiQQ3d", 2, 0, 640, 480, 500, 320, 240)
    images = struct.pack("<Q", 3)
    for i in range(3):
        images += struct.pack("<I7dI", i + 1, 1, 0, 0, 0.1 * i, i, 0, 0, 1 + i % 2) + b"image.jpg\0"
        images += struct.pack("<Q", 2 * (i == 1)) + struct.pack("<ddq", 1, 2, -1) * 2 * (i == 1)
    return {"cameras.bin": calibrations, "images.bin": images}


def beside_bin(folder: Path) -> None:
    for name, data in colmap_bin().items():
        (folder / name).write_bytes(data)


def colmap_txt(name: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        colmap.write(folder / "model", cameras())
        return [(folder / "model" / name).read_bytes()]

    return make


def one(write: Callable[[Path], object], name: str = "seed") -> Callable[[Path], list[bytes]]:
    """The seed that a writer of gsmap puts at a path."""

    def make(folder: Path) -> list[bytes]:
        write(folder / name)
        return [(folder / name).read_bytes()]

    return make


def transforms(folder: Path) -> list[bytes]:
    turn = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    frames = [{"file_path": f"{i}.jpg", "transform_matrix": turn} for i in range(3)]
    size = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240}
    moved = {"applied_transform": turn[:3], "applied_scale": 0.5}
    whole = [{**size, "frames": frames, **moved}, {"camera_angle_x": 0.8, "w": 640, "h": 480, "frames": frames}]
    return [*one(lambda p: nerfstudio.write(p, cameras()))(folder), *(json.dumps(c).encode() for c in whole)]


def dataparser(folder: Path) -> list[bytes]:
    return [json.dumps({"transform": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]], "scale": 0.25}).encode()]


def manifest(folder: Path) -> list[bytes]:
    tile = Tile(
        "k",
        0,
        np.array([[0.0, 0, 0], [1, 1, 1]]),
        {"s": Sim3.identity()},
        3,
        {"stage": "merge"},
        path="component_0/a.ply",
    )
    Manifest("m" * 32, {(0, "a"): tile}, {"component_0/a.ply": 10}).save(folder)
    new = json.loads((folder / "tiles.json").read_bytes())
    return [json.dumps(new).encode(), json.dumps({**new, "version": 1}).encode()]


def photograph(suffix: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        from PIL import Image

        exif = Image.Exif()
        ifd = exif.get_ifd(0x8769)
        ifd[0x9003], ifd[0x9011] = "2025:05:31 14:00:00", "+02:00"
        out = io.BytesIO()
        Image.new("RGB", (4, 4)).save(out, suffix, exif=exif)
        return [out.getvalue()]

    return make


def network(folder: Path) -> list[bytes]:
    from onnx import TensorProto, helper

    def value(name: str) -> object:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, 2, 2])

    weight = helper.make_tensor("w", TensorProto.FLOAT, [1, 3, 2, 2], [0.5] * 12)
    body = helper.make_graph([helper.make_node("Identity", ["x"], ["z"])], "g", [], [value("z")])
    nodes = [helper.make_node("Mul", ["x", "w"], ["y"]), helper.make_node("If", ["c"], ["q"], then_branch=body)]
    graph = helper.make_graph(nodes, "tiny", [value("x")], [value("y")], [weight])
    return [helper.make_model(graph, ir_version=8).SerializeToString()]


def hall(folder: Path) -> None:
    """A capture for what lies beside it to date."""
    formats.write(folder / "hall.ply", some(2, 0))
    (folder / "images").mkdir(exist_ok=True)


TRUTH = json.dumps({"T_scene_world": np.eye(4).tolist()}).encode()
SIDECAR = [b'{"captured_at": "2025-05-31T14:00:00+02:00"}', b'{"captured_at": "2025-05-31", "x": [1, {"y": null}]}']
NAME = ["hall_2025-05-31T14-00", "20250531_1400", "2025-05-31 14:00:00Z", "a 2025_05_31 20250601"]
PAIRS = b"a b\nb:a  # seen twice\n\na b:c:d\n# end\n"
SET = [b"register.refiner=icp", b"merge.mergers.voxel.voxel_m = 0.02", b"describe.object.num_cameras=12", b"x=[1, 2]"]
SETTINGS = {"describe.landmarks": False, "merge.mergers.tto.voxel_m": 0.01, "register.refiner": "none"}

JSON = mutators.json_or_bytes
TARGETS: dict[str, Target] = {
    "ply": Target("in.ply", ply, gaussians_file),
    "compressed_ply": Target("in.compressed.ply", written(".compressed.ply"), gaussians_file),
    "splat": Target("in.splat", written(".splat"), gaussians_file),
    "spz": Target("in.spz", spz, gaussians_file, mutators.spz),
    "sog": Target("in.sog", sog, gaussians_file, mutators.sog),
    "ksplat": Target("in.ksplat", ksplat, gaussians_file),
    "lcc": Target("in.lcc", lcc_json, gaussians_file, JSON, lcc),
    "lcc_index": Target("index.bin", lcc_index, lambda p: gaussians_file(p.with_name("in.lcc")), setup=lcc_beside),
    "checkpoint": Target("in.pt", checkpoint, gaussians_file),
    "usda": Target("in.usda", written(".usda"), gaussians_file),
    "usdc": Target("in.usdc", written(".usdc"), gaussians_file),
    "sog_folder": Target("meta.json", sog_folder, gaussians_file, JSON, sog_folder),
    "glb": Target("in.glb", written(".glb"), gaussians_file, mutators.glb),
    "tileset": Target(
        "tileset.json",
        written("tileset.json", {"max_per_tile": 3}),
        gaussians_file,
        JSON,
        written("tileset.json", {"max_per_tile": 3}),
    ),
    "streamed_sog": Target(
        "lod-meta.json",
        written("lod-meta.json", {"max_per_leaf": 3}),
        gaussians_file,
        JSON,
        written("lod-meta.json", {"max_per_leaf": 3}),
    ),
    "known_levels": Target("tileset.json", written("tileset.json"), lambda p: Tiles3D().known(p.parent), JSON),
    "known_streams": Target(
        "lod-meta.json",
        written("lod-meta.json", {"max_per_leaf": 3}),
        lambda p: StreamedSog().known(p.parent),
        JSON,
    ),
    "cameras_json": Target("cameras.json", one(lambda p: cameras_json.write(p, cameras())), cameras_file, JSON),
    "transforms_json": Target("transforms.json", transforms, cameras_file, JSON),
    "dataparser_json": Target(
        nerfstudio.DATAPARSER,
        dataparser,
        lambda p: cameras_file(p.with_name("transforms.json")),
        JSON,
        lambda folder: (folder / "transforms.json").write_bytes(transforms(folder)[1]),
    ),
    "colmap_cameras_bin": Target(
        "cameras.bin", lambda _: [colmap_bin()["cameras.bin"]], cameras_beside, setup=beside_bin
    ),
    "colmap_images_bin": Target("images.bin", lambda _: [colmap_bin()["images.bin"]], cameras_beside, setup=beside_bin),
    "colmap_cameras_txt": Target(
        "cameras.txt", colmap_txt("cameras.txt"), cameras_beside, setup=lambda f: colmap.write(f, cameras())
    ),
    "colmap_images_txt": Target(
        "images.txt", colmap_txt("images.txt"), cameras_beside, setup=lambda f: colmap.write(f, cameras())
    ),
    "date_sidecar": Target("hall.json", lambda _: SIDECAR, dated, JSON, hall),
    "date_jpeg": Target("images/a.jpg", photograph("JPEG"), lambda p: dated(p.parent), setup=hall),
    "date_tiff": Target("images/a.tif", photograph("TIFF"), lambda p: dated(p.parent), setup=hall),
    "date_name": Target(
        "name", lambda _: [n.encode() for n in NAME], lambda p: date_in_name(p.read_bytes().decode("utf-8", "replace"))
    ),
    "manifest": Target("tiles.json", manifest, manifest_file, JSON),
    "settings": Target(
        "settings.toml",
        one(lambda p: write_settings(p.parent, SETTINGS, preset="paper"), "settings.toml"),
        lambda p: map_settings(p.parent, None, {}),
    ),
    "assignment": Target("set", lambda _: SET, assignment),
    "truth": Target("hall.json", lambda _: [TRUTH], lambda p: _read_truth(p.parent, "hall"), JSON),
    "pairs": Target("pairs", lambda _: [PAIRS], pairs),
    "pose": Target("pose.json", lambda _: [b"[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]", TRUTH], read_pose, JSON),
    "onnx": Target("in.onnx", network, refuse_external_data, mutators.protobuf),
}
