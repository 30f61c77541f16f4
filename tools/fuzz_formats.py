"""Feed every reader of `gsmap.formats` damaged files: Gaussians, cameras or an InputError must come back.

    python tools/fuzz_formats.py [--count N] [--seed S] [--format .spz ...] [--keep FOLDER]

N inputs per format, made from small valid files by flipping bits, overwriting numbers, cutting, repeating and mixing,
also inside the compressed layers. The process may take 1 GiB more than it has at the start, an input 5 s of CPU, and a
warning is a failure. What fails is written to the folder of --keep; exit 1 if anything did.
"""

from __future__ import annotations

import argparse
import io
import json
import random
import resource
import signal
import struct
import sys
import tempfile
import time
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.errors import InputError
from gsmap.types import Gaussians

EXTRA_BYTES = 1 << 30
LIMIT_S = 5
NUMBERS = [0, 1, 2, 3, 4, 127, 128, 255, 256, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1]
WORDS = [
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e999",
    b"99999999999999999999",
    b"null",
    b"[]",
    b"{}",
    b'""',
    b"../../x",
    b"\x00",
]


class TooSlow(Exception):
    """An input took more CPU time than it may."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", action="append", choices=sorted(SEEDS))
    parser.add_argument("--keep", default="fuzz_failures")
    args = parser.parse_args()
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        seeds = {suffix: make(Path(folder)) for suffix, make in SEEDS.items()}
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + EXTRA_BYTES, resource.RLIM_INFINITY))
        signal.signal(signal.SIGVTALRM, too_slow)
        warnings.simplefilter("error")
        for suffix in args.format or sorted(SEEDS):
            failures += fuzz(suffix, seeds[suffix], args.count, args.seed, Path(folder), Path(args.keep))
    return int(failures > 0)


def fuzz(suffix: str, seeds: list[bytes], count: int, seed: int, folder: Path, keep: Path) -> int:
    rng = random.Random(f"{suffix} {seed}")
    path = folder / (f"fuzzed{suffix}" if suffix.startswith(".") else suffix)
    outcomes: Counter[str] = Counter()
    slowest, failures, start = 0.0, 0, time.process_time()
    for number in range(count):
        data = mutate(suffix, rng.choice(seeds), rng, seeds)
        path.write_bytes(data)
        if suffix.endswith(".bin"):  # a COLMAP model is two files
            other = next(name for name in COLMAP if name != suffix)
            (folder / other).write_bytes(COLMAP[other])
        begin = time.process_time()
        signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT_S)
        try:
            if suffix in CAMERAS:
                formats.read_cameras(folder if suffix.endswith(".bin") else path)
            else:
                formats.read(path)
                formats.info(path)
            outcomes["read"] += 1
        except InputError as error:
            outcomes["refused"] += 1
            if "\n" in str(error) or len(str(error)) > 500:
                failures += report(keep, suffix, number, data, f"message of {len(str(error))} characters or many lines")
        except (Exception, TooSlow) as error:
            failures += report(keep, suffix, number, data, f"{type(error).__name__}: {error}")
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        slowest = max(slowest, time.process_time() - begin)
    spent = time.process_time() - start
    print(f"{suffix:16} {count} inputs: {dict(outcomes)}, {failures} failures, {spent:.0f} s, slowest {slowest:.2f} s")
    return failures


def mutate(suffix: str, data: bytes, rng: random.Random, seeds: list[bytes]) -> bytes:
    """One damaged input; half of the time the damage is within the compressed layer."""
    if suffix == ".spz" and data[:2] == b"\x1f\x8b" and rng.random() < 0.7:
        inner = bruise(zlib.decompress(data, 31), rng, 40)
        squeeze = zlib.compressobj(1, wbits=31)
        return squeeze.compress(inner) + squeeze.flush()
    if suffix == ".sog" and rng.random() < 0.8:
        return rezip(data, rng)
    header = {".ply": 800, ".compressed.ply": 1200, ".glb": 3000, ".spz": 140}.get(suffix, len(data))
    if rng.random() < 0.1:
        other = rng.choice(seeds)
        return data[: rng.randrange(len(data))] + other[rng.randrange(len(other)) :]
    return bruise(data, rng, header)


def bruise(data: bytes, rng: random.Random, header: int) -> bytes:
    """One to four wounds, mostly within the first ``header`` bytes."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if not out:
            break
        at = rng.randrange(min(len(out), header) if rng.random() < 0.8 else len(out))
        kind = rng.randrange(7)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            width = rng.choice([1, 2, 4, 8])
            out[at : at + width] = (rng.choice(NUMBERS) % 256**width).to_bytes(width, "little")
        elif kind == 2:
            del out[at:]
        elif kind == 3:
            del out[at : at + rng.randint(1, 40)]
        elif kind == 4:
            out[at:at] = out[at : at + rng.randint(1, 200)] * rng.choice([1, 2, 50])
        elif kind == 5:
            out[at : at + rng.randint(0, 12)] = rng.choice(WORDS)
        else:  # a number in a text becomes another
            digits = [i for i in range(min(len(out), header)) if 48 <= out[i] <= 57]
            if digits:
                i = rng.choice(digits)
                out[i : i + rng.randint(1, 4)] = rng.choice(WORDS + [str(n).encode() for n in NUMBERS])
    return bytes(out)


def rezip(data: bytes, rng: random.Random) -> bytes:
    """The same ZIP with one member damaged, left out or renamed."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w") as target:
        names = source.namelist()
        victim = "meta.json" if rng.random() < 0.5 else rng.choice(names)
        for name in names:
            member = source.read(name)
            if name == victim:
                chance = rng.random()
                if chance < 0.05:
                    continue
                member = bruise(member, rng, 600 if name == "meta.json" else 40)
            target.writestr(name, member)
    return out.getvalue()


def report(keep: Path, suffix: str, number: int, data: bytes, what: str) -> int:
    keep.mkdir(exist_ok=True)
    file = keep / f"{number}{suffix if suffix.startswith('.') else '.' + suffix}"
    file.write_bytes(data)
    print(f"{file}: {what[:300]}", file=sys.stderr)
    return 1


def too_slow(*_: object) -> None:
    raise TooSlow(f"more than {LIMIT_S} s")


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


def written(suffix: str, *options: dict) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        out = []
        for chosen in options or ({},):
            for degree in (0, 1, 3):
                path = folder / (suffix if suffix == "tileset.json" else f"seed{suffix}")
                formats.write(path, some(20 + 300 * (degree == 1), degree), **chosen)
                out.append(path.read_bytes())
        return out

    return make


def ascii_ply(folder: Path) -> list[bytes]:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {n}" for n in names), "end_header"]
    lines += [" ".join(["0.5"] * len(names))] * 3
    return [*written(".ply")(folder), "\n".join([*lines, ""]).encode()]


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

    book = np.linspace(-3, 3, 256).tolist()
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
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))  # first, so that plain damage to the archive hits it too
        for name, data in files.items():
            archive.writestr(f"{name}.webp", data)
    (folder / "seed.sog").write_bytes(out.getvalue())
    formats.read(folder / "seed.sog")
    return [out.getvalue()]


def spz(folder: Path) -> list[bytes]:
    """Versions 3 and 4 as written, and the payload of version 3 under the older headers."""
    out = written(".spz", {"version": 3}, {"version": 4})(folder)
    for version in (1, 2):
        inner = zlib.decompress(out[0], 31)
        squeeze = zlib.compressobj(wbits=31)
        out.append(squeeze.compress(inner[:4] + struct.pack("<I", version) + inner[8:]) + squeeze.flush())
    return out


def colmap() -> dict[str, bytes]:
    """A COLMAP model of two cameras and three images, one of them with two points."""
    cameras = struct.pack("<Q", 2) + struct.pack("<IiQQ4d", 1, 1, 640, 480, 500, 500, 320, 240)
    cameras += struct.pack("<IiQQ3d", 2, 0, 640, 480, 500, 320, 240)
    images = struct.pack("<Q", 3)
    for i in range(3):
        images += struct.pack("<I7dI", i + 1, 1, 0, 0, 0.1 * i, i, 0, 0, 1 + i % 2) + b"image.jpg\0"
        images += struct.pack("<Q", 2 * (i == 1)) + struct.pack("<ddq", 1, 2, -1) * 2 * (i == 1)
    return {"cameras.bin": cameras, "images.bin": images}


def inria(folder: Path) -> list[bytes]:
    turn = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    row = {"img_name": "a", "width": 640, "height": 480, "position": [1, 2, 3], "rotation": turn, "fx": 500, "fy": 500}
    return [json.dumps([{"id": i, **row} for i in range(3)]).encode()]


def nerfstudio(folder: Path) -> list[bytes]:
    pose = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    frames = [{"file_path": f"{i}.jpg", "transform_matrix": pose} for i in range(3)]
    size = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240}
    each = [{**frame, **size} for frame in frames]
    return [
        json.dumps(c).encode()
        for c in (
            {**size, "frames": frames},
            {"frames": each},
            {"camera_angle_x": 0.8, "w": 640, "h": 480, "frames": frames},
        )
    ]


COLMAP = colmap()
CAMERAS = ("cameras.json", "transforms.json", "cameras.bin", "images.bin")
SEEDS: dict[str, Callable[[Path], list[bytes]]] = {
    ".compressed.ply": written(".compressed.ply"),
    ".glb": written(".glb"),
    ".ply": ascii_ply,
    ".sog": sog,
    ".splat": written(".splat"),
    ".spz": spz,
    "cameras.bin": lambda folder: [COLMAP["cameras.bin"]],
    "cameras.json": inria,
    "images.bin": lambda folder: [COLMAP["images.bin"]],
    "tileset.json": written("tileset.json", {"max_per_tile": 10}),
    "transforms.json": nerfstudio,
}

if __name__ == "__main__":
    sys.exit(main())
