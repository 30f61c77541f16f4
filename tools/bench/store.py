"""The storage table: what writing, reading and checking a scene costs, beside what people would use instead.

    python -m tools.bench.store [FILE.ply] [--gaussians 1000000] [--degree 3] [--repeat 3] [--json out.json]
    python -m tools.bench.store [FILE.ply] --boxes [--city]

Without a file the Gaussians are random (worse to compress than real ones). CPU is process time of all threads, best of
the repeats; MB/s counts the bytes of the arrays in memory. "damage found" flips some 16 bits, evenly over the files
that hold arrays, one after the other, and reads the scene: how many of them raised an error.

--boxes: what reading a box of 26 in 1,000 Gaussians would ask of a bucket (medians of 12 boxes): range requests, and
bytes as a multiple of what its Gaussians take of the file. Boxes are cubes, or stand like a wall, a quarter as deep as
wide and high; --city takes a made city (walls, roofs and streets) in place of random Gaussians.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

from gsmap import formats
from gsmap.store import Store, array_archive, arrays
from gsmap.store.object_arrays import MAX_REQUESTS, merge_ranges
from gsmap.types import Cameras, Gaussians
from gsmap_synthetic.city import PER_BLOCK, City
from tools.harness import argument_parser, timed

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--boxes", action="store_true", help="only what boxes ask of a bucket")
    parser.add_argument("--city", action="store_true", help="a made city instead of random Gaussians")
    options = parser.parse_args()
    if options.file:
        g = formats.read(options.file)
    elif options.city:
        g = City(-(-options.gaussians // PER_BLOCK), seed=9, sh_degree=options.degree).load()
    else:
        g = random_gaussians(options.gaussians, options.degree)
    print(f"{len(g)} Gaussians, SH degree {g.sh_degree}, {g.nbytes / 1e6:.0f} MB\n")
    with tempfile.TemporaryDirectory() as folder:
        if options.boxes:
            boxes(Path(folder), g)
            return
        rows = [bench(Path(folder), g, options.repeat) for bench in (gsmap_store, ply, plain_zarr, npz)]
    print(f"{'':24}{'write s':>9}{'MB/s':>7}{'read s':>9}{'MB/s':>7}{'box ms':>8}{'check s':>9}{'MB':>7}  damage found")
    for row in rows:
        print(
            f"{row['name']:24}{row['write_s']:9.2f}{g.nbytes / 1e6 / row['write_s']:7.0f}"
            f"{row['read_s']:9.2f}{g.nbytes / 1e6 / row['read_s']:7.0f}"
            f"{row['box_ms']:8.0f}{row['check_s']:9.2f}{row['megabytes']:7.0f}  {row['damage']}"
        )
    if options.json:
        options.json.write_text(json.dumps({"gaussians": len(g), "bytes": g.nbytes, "rows": rows}, indent=1))


def random_gaussians(n: int, degree: int) -> Gaussians:
    rng = np.random.default_rng(0)
    k = (degree + 1) ** 2
    return Gaussians(
        rng.uniform(-50, 50, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-4, 1, (n, 3)),
        rng.normal(size=n),
        rng.normal(size=(n, k, 3)).astype("f4"),
    )


def gsmap_store(folder: Path, g: Gaussians, repeat: int) -> dict:
    def write() -> None:
        shutil.rmtree(folder / "map", ignore_errors=True)
        with Store.create(folder / "map") as made:
            made.scenes.add(g, one_camera(), name="scene")

    write_s = best(write, repeat)
    with Store.open(folder / "map") as store:
        read = lambda: store.scenes.gaussians("scene")  # noqa: E731
        box = middle_box(g)
        return row(
            "gsmap store",
            write_s,
            best(read, repeat),
            best(lambda: store.scenes.gaussians("scene", box), repeat),
            best(store.check, repeat),
            folder / "map",
            damage(folder / "map" / "arrays", read),
        )


def boxes(folder: Path, g: Gaussians, share: float = 0.026, count: int = 12) -> None:
    """Print what boxes around some of the Gaussians would ask of a bucket."""
    asked: list[list[tuple[int, int]]] = []
    with Store.create(folder / "map") as store:
        store.scenes.add(g, one_camera(), name="scene")
        size = (next((folder / "map" / "arrays").rglob(array_archive.FILE))).stat().st_size
        with mock.patch.object(arrays._FolderReader, "expect", lambda self, file, ranges: asked.append(list(ranges))):
            for name, shape in (("cube", (1.0, 1.0, 1.0)), ("wall", (1.0, 0.25, 1.0))):
                rng, found = np.random.default_rng(5), []
                for centre in g.means[rng.integers(len(g), size=count)].astype(np.float64):
                    away = (np.abs(g.means - centre) / shape).max(1)
                    reach = np.quantile(away, share) * np.array(shape)
                    asked.clear()
                    hit = len(store.scenes.gaussians("scene", np.stack([centre - reach, centre + reach])))
                    few = [part for ranges in asked for part in merge_ranges(ranges, MAX_REQUESTS)]
                    found.append((len(few), sum(b - a for a, b in few) / (size * hit / len(g)), hit))
                requests, times, hits = np.median(found, axis=0)
                print(
                    f"{name}: {hits:.0f} Gaussians in {requests:.0f} requests, {times:.2f} times their bytes",
                    flush=True,
                )


def ply(folder: Path, g: Gaussians, repeat: int) -> dict:
    (folder / "ply").mkdir()
    path = folder / "ply" / "scene.ply"
    write_s = best(lambda: formats.write(path, g), repeat)
    return peer("one .ply (our reader)", folder / "ply", write_s, lambda: formats.read(path), g, repeat)


def plain_zarr(folder: Path, g: Gaussians, repeat: int) -> dict:
    import zarr

    path = folder / "zarr"

    def write() -> None:
        shutil.rmtree(path, ignore_errors=True)
        group = zarr.create_group(str(path), zarr_format=3)
        for name in NAMES:
            group.create_array(name, data=getattr(g, name))

    def read() -> Gaussians:
        group = zarr.open_group(str(path), mode="r")
        return Gaussians(**{name: group[name][...] for name in NAMES})

    return peer("zarr v3 as it comes", path, best(write, repeat), read, g, repeat)


def npz(folder: Path, g: Gaussians, repeat: int) -> dict:
    (folder / "npz").mkdir()
    path = folder / "npz" / "scene.npz"
    write_s = best(lambda: np.savez(path, **{name: getattr(g, name) for name in NAMES}), repeat)

    def read() -> Gaussians:
        with np.load(path) as arrays:
            return Gaussians(**{name: arrays[name] for name in NAMES})

    return peer("numpy .npz", folder / "npz", write_s, read, g, repeat)


def peer(name: str, folder: Path, write_s: float, read: Callable[[], Gaussians], g: Gaussians, repeat: int) -> dict:
    """A way of storing that has no index and no check: both cost a whole reading."""
    low, high = middle_box(g)

    def box() -> Gaussians:
        everything = read()
        return everything[((everything.means >= low) & (everything.means <= high)).all(1)]

    read_s = best(read, repeat)
    return row(name, write_s, read_s, best(box, repeat), read_s, folder, damage(folder, read))


def row(name: str, write_s: float, read_s: float, box_s: float, check_s: float, folder: Path, found: str) -> dict:
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6
    figures = {"write_s": write_s, "read_s": read_s, "box_ms": 1e3 * box_s, "check_s": check_s, "megabytes": size}
    return {"name": name, **figures, "damage": found}


def middle_box(g: Gaussians) -> np.ndarray:
    """A box around the median with a tenth of the extent along each axis."""
    low, high = np.percentile(g.means, [5, 95], axis=0)
    center = np.median(g.means, axis=0)
    return np.array([center - 0.05 * (high - low), center + 0.05 * (high - low)], np.float64)


def damage(folder: Path, read: Callable[[], object]) -> str:
    files = [p for p in folder.rglob("*") if p.is_file() and p.suffix != ".json" and p.stat().st_size > 1000]
    files = files[:: max(1, len(files) // 16)]
    each = -(-16 // len(files))
    found = 0
    for file in files:
        whole = file.read_bytes()
        for i in range(each):
            broken = bytearray(whole)
            broken[(2 * i + 1) * len(broken) // (2 * each)] ^= 1
            file.write_bytes(broken)
            try:
                read()
            except Exception:  # whatever a library raises
                found += 1
        file.write_bytes(whole)
    return f"{found} of {each * len(files)}"


def best(call: Callable[[], object], repeat: int) -> float:
    return min(timed(call)[1] for _ in range(repeat))


def one_camera() -> Cameras:
    return Cameras(np.eye(4)[None], np.array([[500.0, 500, 320, 240]]), np.array([[640, 480]]))


if __name__ == "__main__":
    main()
