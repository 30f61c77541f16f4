"""Exports of a map whose unit is not the metre, beside those of the same map in metres.

    python -m tools.bench.units --made 0 [--units 0.1 0.3 3 10] [--methods tto voxel union distance]
    python -m tools.bench.units CAPTURES --scenes c0 c1 --units 0.3 --methods tto

CAPTURES is a folder as `tools/bench/merge.py` takes it; ``--made SEED`` makes one. The captures are put into another
unit, tied by the truth, and exported; what comes out is brought to metres by the truth and rendered from the captures'
own cameras against their photographs. Rows, of every unit:

- told: nobody knows a scale, and a person gave metres per unit of the first capture (``gsmap edit
  --metres-per-unit``);
- measured: the first capture, whose frame is the map's, is in the unit, and the others are said to be in metres;
- auto: all captures are in the unit, and nothing is said (policy ``auto``);
- guess: nor is the unit taken for the metre where that is plausible (policy ``unknown``).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.geometry.metric_scale import scale_gaussians
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import Capture, read_captures
from gsmap.map import Map
from gsmap.merge import methods
from gsmap.types import Gaussians, Sim3
from gsmap_synthetic import make_captures, write_captures
from tools.harness import argument_parser, timed

HOW = ("told", "measured", "auto", "guess")
_ONLY_THE_GUESS = {"describe.landmarks": False, "describe.objects": False, "describe.things": False}
_SIGMAS = np.array([1e-3] * 6 + [1e-3])


@dataclass(frozen=True)
class Place:
    """Captures in metres, the inverse of their truth, and their photographs."""

    captures: Sequence[Capture]
    S_world_scene: dict[str, Sim3]
    images: Path


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", type=Path, nargs="?")
    parser.add_argument("--scenes", nargs="+", help="names of captures; all else")
    parser.add_argument("--made", type=int, metavar="SEED", help="a made place in place of a folder")
    parser.add_argument("--units", nargs="+", type=float, default=[0.1, 0.3, 3.0, 10.0], help="metres")
    parser.add_argument("--methods", nargs="+", choices=methods(), default=["tto", "voxel", "union", "distance"])
    parser.add_argument("--how", nargs="+", choices=HOW, default=list(HOW))
    parser.add_argument("--tile-size", type=float, default=0.0, help="metres; 0 is one file")
    parser.add_argument("--json", type=Path, help="write all figures here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench_units_") as folder:
        if options.made is not None:
            options.captures = Path(folder) / "place"
            write_captures(options.captures, _made(options.made), images=True)
        if options.captures is None:
            parser.error("name a folder of captures, or --made SEED")
        rows = run(read(options.captures, options.scenes), Path(folder), options)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


def _made(seed: int):
    return make_captures(seed, 2, steps=200, num_frames=24, num_gaussians=20_000, size_px=(240, 180), routes=[[0], [0]])


def read(folder: Path, scenes: Sequence[str] | None) -> Place:
    """Captures in metres, with their truth."""
    names = scenes or sorted(path.stem for path in (folder / "truth").glob("*.json"))
    truth = {
        name: Sim3.from_matrix(np.array(json.loads((folder / "truth" / f"{name}.json").read_text())["T_scene_world"]))
        for name in names
    }
    captures = read_captures([folder / f"{name}.ply" for name in names])
    return Place(captures, {name: S.inverse() for name, S in truth.items()}, folder / "frames")


def run(place: Place, folder: Path, options: argparse.Namespace) -> list[dict]:
    """Every row, printed as it comes."""
    rows = []
    first: dict[str, dict] = {}
    print(f"{'':22}{'the map says':34}{'':10}{'PSNR':>7}{'dB':>8}{'Gaussians':>11}{'%':>8}{'CPU s':>8}")
    for unit, how in [(1.0, "metric"), *((unit, how) for unit in options.units for how in options.how)]:
        with make(place, unit, how, folder / f"{unit:g}_{how}.gsmap") as m:
            for method in options.methods:
                out = folder / f"{unit:g}_{how}_{method}"
                row = {"unit_m": unit, "how": how, "method": method}
                row |= exported(m, place, true_metres(m, place), out, method, options.tile_size)
                base = first.setdefault(method, row)
                row["db"] = row["psnr_db"] - base["psnr_db"]
                row["more"] = row["num_gaussians"] / base["num_gaussians"] - 1
                rows.append(row)
                print(
                    f"{unit:5g} m a unit, {how:9}{row['metre']:34}{method:10}{row['psnr_db']:7.2f}{row['db']:+8.3f}"
                    f"{row['num_gaussians']:11d}{100 * row['more']:+8.2f}{row['cpu_s']:8.1f}",
                    flush=True,
                )
    for how in options.how:
        of = [row for row in rows if row["how"] == how]
        worst = max(of, key=lambda row: abs(row["db"])), max(of, key=lambda row: abs(row["more"]))
        print(f"{how}: at most {abs(worst[0]['db']):.3f} dB and {100 * abs(worst[1]['more']):.2f} % of Gaussians off")
    return rows


def make(place: Place, unit: float, how: str, path: Path) -> Map:
    """A map of the captures in a unit, tied by the truth."""
    m = gsmap.map.create(path)
    poses: list[Sim3] = []
    names: list[str] = []
    for k, capture in enumerate(place.captures):
        own = 1.0 if how == "measured" and k else unit
        policy = "known" if own == 1.0 and how in ("metric", "measured") else "auto" if how == "auto" else "unknown"
        S = Sim3(np.eye(3), np.zeros(3), 1 / own)
        gaussians, cameras = transform_gaussians(capture.gaussians, S), transform_cameras(capture.cameras, S)
        m.ingest(gaussians, cameras=cameras, name=capture.name, scale=policy, captured_at=f"2026-01-{k + 1:02}")
        poses.append(place.S_world_scene[capture.name] @ S.inverse())
        names.append(capture.name)
        if k:
            sigmas = _SIGMAS / np.r_[np.ones(3), np.full(3, own), 1.0]
            m.add_edge(f"{names[0]}:{capture.name}", poses[0].inverse() @ poses[k], sigmas)
    if how in ("auto", "guess"):
        m.with_settings(_ONLY_THE_GUESS).describe()
    m.optimize()
    if how == "told":
        m.edit(names[0], metres_per_unit=unit)
    return m


def true_metres(m: Map, place: Place) -> float:
    """Metres in a unit of the map, by the truth of its first scene."""
    graph = m.pose_graph()
    assert graph is not None
    S_map_scene = {scene.name: graph.poses[scene.id].S_map_scene for scene in m.scenes()}
    capture = place.captures[0]
    stored = m.read(capture.name)[1].centers
    spread = np.linalg.norm(capture.cameras.centers - capture.cameras.centers.mean(0), axis=1).sum()
    own = spread / np.linalg.norm(stored - stored.mean(0), axis=1).sum()  # metres in a unit of that scene
    return float(own / S_map_scene[capture.name].scale)


def exported(m: Map, place: Place, true_m: float, out: Path, method: str, tile_size_m: float) -> dict:
    """One export, looked at in true metres, so that rendering is the same."""
    result, cpu_s = timed(m.export, out, merge=method, tile_size_m=tile_size_m)
    files = [formats.read(out / tile.path) for tile in result.tiles if tile.path]
    merged = scale_gaussians(Gaussians.concatenate(files), true_m)
    parts = []
    for capture in place.captures:
        cameras = transform_cameras(m.read(capture.name, frame="map")[1], Sim3(np.eye(3), np.zeros(3), true_m))
        parts.append(compare_renders(merged, cameras, find_images(capture.cameras, place.images)).psnr_db)
    return {
        "metre": m.metres()[0].text(),
        "psnr_db": float(np.concatenate(parts).mean()),
        "num_gaussians": len(merged),
        "cpu_s": cpu_s,
    }


if __name__ == "__main__":
    main()
