"""Seconds (CPU), bytes and picture of every format, next to gsply, Open3D and splat-transform in the same run.

    python -m tools.bench.formats [FILE [--cameras CAMERAS] | --count N] [--degree D] [--json OUT]
                                  [--peers] [--only NAME]

--peers runs splat-transform too (npm: @playcanvas/splat-transform, see tests/formats/test_splat_transform.py), which
takes minutes to write a SOG without a GPU. --only: formats with this in their names.

Without FILE, N random Gaussians, which compress worse than trained ones. With CAMERAS, the PSNR of what gsmap reads
back against FILE itself, over five views that gsmap renders.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.types import Gaussians
from tools.harness import argument_parser, timed


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("file", nargs="?")
    parser.add_argument("--cameras")
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--json")
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    g = formats.read(args.file) if args.file else random_gaussians(args.count, args.degree)
    print(f"{len(g):,} Gaussians, SH degree {g.sh_degree}; CPU seconds")
    print(f"{'format':20} {'by':16} {'write s':>8} {'read s':>8} {'MB':>8} {'bytes':>8} {'PSNR dB':>8}")
    rows = []
    picture_of = renderer(args.cameras) if args.cameras else None
    truth = picture_of(g) if picture_of else None
    with tempfile.TemporaryDirectory() as folder:
        for name, by, write, read in ways(g, Path(folder), args.file if args.peers else None):
            if args.only not in name:
                continue
            (_, write_s), (back, read_s) = (timed(call) if call else (None, None) for call in (write, read))
            row = {
                "format": name,
                "by": by,
                "write_s": write_s,
                "read_s": read_s,
                "mb": size_mb(folder),
                "bytes_per_gaussian": size_mb(folder) * 1e6 / len(g),
                "psnr_db": None,
            }
            if truth is not None and isinstance(back, Gaussians):
                row["psnr_db"] = -10 * math.log10(max(float(((picture_of(back) - truth) ** 2).mean()), 1e-15))
            rows.append(row)
            keys = ("write_s", "read_s", "mb", "bytes_per_gaussian", "psnr_db")
            numbers = [f"{row[k]:8.2f}" if row[k] is not None else f"{'-':>8}" for k in keys]
            print(f"{name:20} {by:16} {' '.join(numbers)}", flush=True)
            for file in sorted(Path(folder).rglob("*"), reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
    if args.json:
        Path(args.json).write_text(json.dumps({"count": len(g), "sh_degree": g.sh_degree, "rows": rows}, indent=1))


def ways(g: Gaussians, folder: Path, peers_of: str | None):
    """(format, by whom, write, read) with nothing to do before it is called; splat-transform writes from a file."""
    for name, options in (
        (".ply", {}),
        (".compressed.ply", {}),
        (".splat", {}),
        (".spz", {}),
        (".spz v4", {"version": 4}),
        (".spz 8 bits of SH", {"sh_bits": (8, 8)}),
        (".glb", {}),
        (".sog", {}),
        (".sog palette 4096", {"palette_size": 4096}),
        (".usdc", {}),
        (".usdc half", {"half": True}),
        ("tileset.json", {}),
        ("lod-meta.json", {}),
    ):
        path = folder / ("a" + name.split()[0] if name.startswith(".") else name)
        yield name, "gsmap", lambda p=path, o=options: formats.write(p, g, **o), lambda p=path: formats.read(p)
    for name in (".sog", ".spz", ".compressed.ply") if peers_of else ():
        path = folder / f"a{name}"
        yield name, "splat-transform", lambda p=path: splat_transform(peers_of, p), lambda p=path: formats.read(p)
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


def splat_transform(source: str, target: Path) -> None:
    home = Path(os.environ.get("NPM_VALIDATORS", Path.home() / ".cache" / "gsmap" / "validators"))
    program = home / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    subprocess.run(["node", program, "-q", "-w", "-g", "cpu", "--max-workers", "0", source, target], check=True)


def renderer(path: str) -> Callable[[Gaussians], np.ndarray]:
    from gsmap.render import render
    from gsmap.types import Cameras

    cameras = formats.read_cameras(path)
    some = np.linspace(0, len(cameras) - 1, 5).astype(int)
    cameras = Cameras(cameras.T_frame_camera[some], cameras.intrinsics_px[some], cameras.sizes_px[some])
    return lambda g: np.clip(render(g, cameras, depth=False, dominant_id=False).colour, 0, 1)


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
