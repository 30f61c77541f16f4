"""Seconds (CPU) and bytes to write and read every format, next to gsply and Open3D in the same run.

    python tools/bench_formats.py [FILE | --count N] [--degree D] [--json OUT]

Without FILE, N random Gaussians, which compress worse than trained ones.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.types import Gaussians


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?")
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--json")
    args = parser.parse_args()
    g = formats.read(args.file) if args.file else random_gaussians(args.count, args.degree)
    print(f"{len(g):,} Gaussians, SH degree {g.sh_degree}; CPU seconds")
    print(f"{'format':20} {'by':8} {'write s':>8} {'read s':>8} {'MB':>8}")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, by, write, read in ways(g, Path(folder)):
            row = {"format": name, "by": by, "write_s": seconds(write), "read_s": seconds(read), "mb": size_mb(folder)}
            rows.append(row)
            numbers = [f"{row[k]:8.2f}" if row[k] is not None else f"{'-':>8}" for k in ("write_s", "read_s", "mb")]
            print(f"{name:20} {by:8} {' '.join(numbers)}", flush=True)
            for file in sorted(Path(folder).rglob("*"), reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
    if args.json:
        Path(args.json).write_text(json.dumps({"count": len(g), "sh_degree": g.sh_degree, "rows": rows}, indent=1))


def ways(g: Gaussians, folder: Path):
    """(format, by whom, write, read) with nothing to do before it is called."""
    for name, options in (
        (".ply", {}),
        (".compressed.ply", {}),
        (".splat", {}),
        (".spz", {}),
        (".spz v4", {"version": 4}),
        (".glb", {}),
        ("tileset.json", {}),
    ):
        path = folder / ("a" + name.split()[0] if name.startswith(".") else name)
        yield name, "gsmap", lambda p=path, o=options: formats.write(p, g, **o), lambda p=path: formats.read(p)
    try:
        import gsply
    except ImportError:
        return
    data = gsply.GSData.from_arrays(
        g.means, g.log_scales, g.quats, g.logit_opacities, g.sh[:, 0], g.sh[:, 1:], format="ply"
    )
    for name, write, read in (
        (".ply", lambda p: gsply.plywrite(p, data), gsply.plyread),
        (".compressed.ply", lambda p: gsply.plywrite(p, data, compressed=True), gsply.plyread),
        (".spz", lambda p: gsply.write_spz(p, data), gsply.read_spz),
    ):
        path = str(folder / f"a{name}")
        yield name, "gsply", lambda w=write, p=path: w(p), lambda r=read, p=path: r(p)
    import open3d

    spz = folder / "a.spz"
    formats.write(spz, g)
    yield ".spz", "open3d", None, lambda: open3d.t.io.read_point_cloud(str(spz))


def seconds(call: Callable[[], object] | None) -> float | None:
    if call is None:
        return None
    start = time.process_time()
    call()
    return time.process_time() - start


def size_mb(folder: str) -> float:
    return sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()) / 1e6


def random_gaussians(count: int, degree: int) -> Gaussians:
    rng = np.random.default_rng(0)
    return Gaussians(
        rng.uniform(-10, 10, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(-4, 1, (count, 3)),
        rng.normal(0, 2, count),
        rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3)),
    )


if __name__ == "__main__":
    main()
