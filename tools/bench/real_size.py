"""Costs of captures at real size: pairs of 1 and 3 million Gaussians of SH degree 3 with 300 cameras each.

    python -m tools.bench.real_size --house FOLDER --cache FOLDER [--millions 1 3] [--steps ingest describe ...]
    python -m tools.bench.real_size --data FOLDER --cache FOLDER

Without ``--data`` the pair is made from the captures c0 and c1 of the house (see ``--house``), which are separate
trainings of 150 thousand Gaussians each: every Gaussian becomes several smaller ones that together look like it, so
that surfaces have the density of real captures; higher SH coefficients are noise, and cameras are repeated with small
random motions. The photo is one of the frames that c0 was trained on. ``--data`` reads a folder with two
captures NAME.ply, NAME.cameras.json and, optionally, truth/NAME.json (``T_scene_world``) and one photo.jpg.

One line for each step: CPU seconds (user and system, one thread) and peak memory, each step in a process of its own,
without imports. "pair" is the first registration of two described scenes by a process, "pair again" the second. "tto
tile" is one tile of 6 m at the middle of the first capture, optimized in 150 steps: of both captures as if they had no
dates, and where they disagree of the newest. "tiles with levels" exports the union of both as 3D Tiles. "peer"
registers the same pair by KISS-Matcher and small_gicp, whose time includes reading the files, as that of "ingest" does.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, peak_mb, print_table, say, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "GSMAP_WORKERS"):
    os.environ.setdefault(_name, "1")

import json
import multiprocessing
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.evaluate.registration import pose_error as registration_error
from gsmap.formats import cameras_json
from gsmap.geometry.rotations import exp_so3, quats_to_matrices
from gsmap.types import Cameras, Gaussians, Sim3

STEPS = (
    "ingest",
    "describe",
    "pair",
    "pair again",
    "changes",
    "features",
    "photo",
    "tto tile",
    "tiles with levels",
    "peer",
)
_NUM_CAMERAS = 300
_OVERLAP = 4.0
_SH_REST_SIGMA = 0.01
_CAMERA_SIGMAS = 0.05, 0.05  # metres, radians
_FOCAL_PX = 280.0  # of the frames of the house
_PEER_CELL_M = 0.1  # of KISS-Matcher, which fails at 0.2 m
_PEER_POINT_M = 0.05  # of GICP, which is no more exact and far slower at 0.02 m
_MIN_OPACITY = 0.1  # Gaussians that are points for the peer
_TILE_M, _TILE_STEPS = 6.0, 150  # edge and optimization steps of the tile of the step "tto tile"


def densified(gaussians: Gaussians, count: int, seed: int) -> Gaussians:
    """Replace every Gaussian by several smaller ones of SH degree 3 on its surface, which together look like it.

    At each point of its surface `_OVERLAP` of them overlap on average, and share its optical depth. With fewer, or with
    its own opacity, renders are speckled and let surfaces behind shine through, and no photo looks like them.
    """
    rng = np.random.default_rng(seed)
    rows = np.linspace(0, len(gaussians), count, endpoint=False).astype(np.int64)
    g, times = gaussians[rows], count / len(gaussians)
    overlap = min(_OVERLAP, times)
    along = g.log_scales > g.log_scales.min(1, keepdims=True)
    step = np.sqrt(1 - overlap / times) * rng.normal(size=(count, 3)) * g.scales * along
    means = g.means + np.einsum("nij,nj->ni", quats_to_matrices(g.quats), step)
    smaller = g.log_scales + 0.5 * np.log(overlap / times) * along
    depth = np.logaddexp(0, g.logit_opacities.clip(max=15).astype(np.float64)) / overlap  # -log(1 - opacity)
    sh = rng.normal(0, _SH_REST_SIGMA, (count, 16, 3))
    sh[:, : g.sh.shape[1]] = g.sh
    return Gaussians(means, g.quats, smaller, np.log(np.expm1(depth)), sh)


def repeated(cameras: Cameras, count: int, seed: int) -> Cameras:
    """Repeat cameras with small random motions."""
    rng = np.random.default_rng(seed)
    rows = np.arange(count) % len(cameras)
    poses = cameras.T_frame_camera[rows].copy()
    poses[:, :3, 3] += rng.normal(0, _CAMERA_SIGMAS[0], (count, 3))
    poses[:, :3, :3] = poses[:, :3, :3] @ exp_so3(rng.normal(0, _CAMERA_SIGMAS[1], (count, 3)))
    return Cameras(poses, cameras.intrinsics_px[rows], cameras.sizes_px[rows])


def make_pair(house: Path, folder: Path, count: int) -> None:
    """Write a pair of captures of the house with ``count`` Gaussians each."""
    (folder / "truth").mkdir(parents=True)
    for seed, name in enumerate(("c0", "c1")):
        cameras = formats.read_cameras(house / f"{name}.cameras.json")
        formats.write(folder / f"{name}.ply", densified(formats.read(house / f"{name}.ply"), count, seed))
        cameras_json.write(folder / f"{name}.cameras.json", repeated(cameras, _NUM_CAMERAS, seed))
        shutil.copyfile(house / "truth" / f"{name}.json", folder / "truth" / f"{name}.json")
    shutil.copyfile(house / "frames" / "c0_030.jpg", folder / "photo.jpg")


def _ingest(path: str, folder: Path, part: int) -> str:
    names = sorted(folder.glob("*.ply"))
    with gsmap.map.open_or_create(path) as m:
        (row,) = m.ingest(names[part], captured_at=f"2024-01-0{1 + part}")
    return f"{row.num_gaussians} Gaussians"


def _describe(path: str, folder: Path, part: int) -> str:
    with gsmap.map.open(path) as m:
        (row,) = m.describe(m.scenes()[part].name)
    return f"{row.num_nodes} nodes"


def _pair(path: str, folder: Path, part: int) -> str:
    with gsmap.map.open(path) as m:
        a, b = m.scenes()
        (row,) = m.register(f"{a.name}:{b.name}")
    return row.status


def _changes(path: str, folder: Path, part: int) -> str:
    with gsmap.map.open(path) as m:
        a, b = m.scenes()
        report = m.changes(f"{a.name}:{b.name}")
    return f"{len(report.changes)} changes"


def _features(path: str, folder: Path, part: int) -> str:
    from gsmap.map.localization.localize import Localizer

    with gsmap.map.open(path) as m:
        return f"{len(Localizer(m.store, m.settings, m._progress).placed)} captures"


def _photo(path: str, folder: Path, part: int) -> str:
    with gsmap.map.open(path) as m:
        report = m.localize(folder / "photo.jpg", focal=_FOCAL_PX)
    return report.results[0].status


def _tto_tile(path: str, folder: Path, part: int) -> str:
    with gsmap.map.open(path) as m:
        first, _ = m.scenes()
        middle = m.poses()[first.name].S_map_scene.apply(first.bounds.mean(0))
        half = np.array([_TILE_M / 2, _TILE_M / 2, 1e3])
        box = [*(middle - half), *(middle + half)]
        prefer = ("both", "newest")[part]
        with _empty_folder() as out:
            report = m.export(out, format="ply", merge="tto", tile_size_m=0, bbox=box, steps=_TILE_STEPS, prefer=prefer)
    return f"{sum(tile.num_gaussians for tile in report.tiles)} Gaussians"


def _tiles_with_levels(path: str, folder: Path, part: int) -> str:
    with gsmap.map.open(path) as m, _empty_folder() as out:
        report = m.export(out, format="3dtiles", merge="union")
        num_levels = len(list(out.glob("component_*/levels/*")))
    return f"{len(report.tiles)} tiles, {num_levels} levels"


def _peer(path: str, folder: Path, part: int) -> str:
    import kiss_matcher
    import small_gicp

    def points(name: str) -> np.ndarray:
        gaussians = formats.read(folder / f"{name}.ply")
        return gaussians.means[gaussians.opacities >= _MIN_OPACITY].astype(np.float64)

    target, source = (points(name) for name in ("c0", "c1"))
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(_PEER_CELL_M))
    rough = matcher.estimate(source.astype(np.float32), target.astype(np.float32))
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = rough.rotation, np.ravel(rough.translation)
    fine = small_gicp.align(
        target, source, start, downsampling_resolution=_PEER_POINT_M, max_correspondence_distance=0.2, max_iterations=50
    )
    pose = Sim3(fine.T_target_source[:3, :3], fine.T_target_source[:3, 3])
    return error_of(pose, *(true_pose(folder, name) for name in ("c0", "c1")), source.mean(0))


@contextmanager
def _empty_folder() -> Iterator[Path]:
    """Yield an empty folder for an export, whose merged tiles no cache holds."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["GSMAP_CACHE"] = folder + "/cache"
        yield Path(folder, "out")


def _imports() -> None:
    """Import what the steps use, which is not part of their cost."""
    import gsmap.change
    import gsmap.describe
    import gsmap.export
    import gsmap.localize
    import gsmap.map.changes.compare
    import gsmap.map.changes.rows
    import gsmap.map.localization.localize
    import gsmap.map.localization.photo_localization
    import gsmap.map.stages.export
    import gsmap.map.stages.ingest
    import gsmap.map.stages.register
    import gsmap.register  # noqa: F401


def _measure(step: Callable[..., str], arguments: tuple[Any, ...], times: int, profile: str, queue: Any) -> None:
    _imports()
    if profile:
        import cProfile

        with cProfile.Profile() as profiler:
            step(*arguments)
        profiler.dump_stats(profile)
    for _ in range(times - 1):
        step(*arguments)
    told, seconds = timed(step, *arguments)
    queue.put((told, seconds, peak_mb()))


def measured(step: Callable[..., str], *arguments: Any, times: int = 1, profile: str = "") -> tuple[str, float, float]:
    """Run a step in a process of its own, ``times`` times; return its note, CPU seconds of the last time, and MiB."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_measure, args=(step, arguments, times, profile, queue))
    process.start()
    process.join()
    if process.exitcode:
        raise SystemExit(f"the step {step.__name__} failed")
    found: tuple[str, float, float] = queue.get()
    return found


def pose_error(path: str, folder: Path) -> str:
    """Return the error of the pair's edge at the middle of the source, where the truth is known."""
    with gsmap.map.open(path) as m:
        scenes = {scene.id: scene for scene in m.scenes()}
        edge = m.store.registrations.current()[0].registration
    true = (true_pose(folder, scenes[scene].name) for scene in (edge.target, edge.source))
    return error_of(edge.S_target_source, *true, scenes[edge.source].bounds.mean(0))


def true_pose(folder: Path, name: str) -> Sim3 | None:
    """Return the true pose of the world in a capture; None if it is unknown."""
    file = folder / "truth" / f"{name}.json"
    return Sim3.from_matrix(np.array(json.loads(file.read_text())["T_scene_world"])) if file.exists() else None


def error_of(pose: Sim3 | None, target: Sim3 | None, source: Sim3 | None, middle: np.ndarray) -> str:
    """Return the error of a pose of the source in the target at a point (3,) of the source."""
    if pose is None or target is None or source is None:
        return "no pose or no truth"
    error = registration_error(pose, target @ source.inverse(), middle)
    return f"{error.rre_deg:.4f} deg, {1000 * error.centroid_m:.1f} mm"


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--data", type=Path, help="folder with a pair of captures")
    parser.add_argument("--house", type=Path, help="folder of the house, from which pairs are made")
    parser.add_argument("--cache", type=Path, required=True, help="keep captures and maps here")
    parser.add_argument("--millions", type=float, nargs="+", default=[1.0, 3.0], help="Gaussians of a capture")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--fresh", action="store_true", help="begin with a new map")
    parser.add_argument("--profile", type=Path, help="also write a cProfile of every step to this folder")
    options = parser.parse_args()
    if options.data is None and options.house is None:
        parser.error("give --data or --house")
    if options.profile:
        options.profile.mkdir(parents=True, exist_ok=True)
    rows: list[tuple[object, ...]] = []
    folders = [(options.data.name, options.data)] if options.data else []
    for millions in [] if options.data else options.millions:
        folder = options.cache / f"{millions:g}m"
        if not (folder / "photo.jpg").exists():
            # In a process of its own, since Linux counts the peak memory of a parent for the processes that it starts.
            making = multiprocessing.get_context("spawn").Process(
                target=make_pair, args=(options.house, folder, int(1e6 * millions))
            )
            making.start()
            making.join()
        folders.append((f"{millions:g} M", folder))
    for size, folder in folders:
        path = str(options.cache / f"{folder.name}.gsmap")
        if options.fresh:
            shutil.rmtree(path, ignore_errors=True)
        rows += [(size, *row) for row in run(path, folder, options.steps, options.profile)]
    print_table(("captures", "step", "CPU s", "peak MiB", "result"), rows)


def run(path: str, folder: Path, steps: list[str], profile: Path | None) -> list[tuple[object, ...]]:
    """Run the steps on one pair."""

    def measure(step: Callable[..., str], part: int = 0, times: int = 1) -> tuple[str, float, float]:
        into = "" if profile is None else str(profile / f"{folder.name}{step.__name__}_{part}.prof")
        return measured(step, path, folder, part, times=times, profile=into)

    rows = list[tuple[object, ...]]()

    def add(name: str, found: tuple[str, float, float]) -> None:
        rows.append((name, f"{found[1]:.2f}", f"{found[2]:.0f}", found[0]))
        say(f"{folder.name}: {name} {found[1]:.2f} CPU s, {found[2]:.0f} MiB, {found[0]}")

    for name, step in (("ingest", _ingest), ("describe", _describe)):
        if name in steps:
            for part in (0, 1):
                add(f"{name} {part + 1} of 2", measure(step, part))
    if "pair" in steps:
        add("pair", measure(_pair))
        say(f"{folder.name}: {pose_error(path, folder)}")
    if "pair again" in steps:
        add("pair again", measure(_pair, times=2))
    if {"changes", "features", "photo", "tto tile", "tiles with levels"} & set(steps):
        with gsmap.map.open(path) as m:
            m.optimize()
    if "changes" in steps:
        add("changes of the pair", measure(_changes))
    if "features" in steps:
        add("features of both captures", measure(_features))
    if "photo" in steps and (folder / "photo.jpg").exists():
        add("a photo, features known", measure(_photo, times=2))
    if "tto tile" in steps:
        add("tto tile of both captures", measure(_tto_tile))
        add("tto tile of the newest", measure(_tto_tile, 1))
    if "tiles with levels" in steps:
        add("tiles with levels", measure(_tiles_with_levels))
    if "peer" in steps:
        add("peer", measure(_peer))
    return rows


if __name__ == "__main__":
    main()
