"""What the CUDA backend gives: agreement with the CPU, and speed beside gsplat called bare and beside the CPU.

    python tools/bench/gpu.py CAPTURES [--parts kernels fit tile describe pairs memory] [--json OUT]

CAPTURES holds folders of captures (``house``, ``kitchen``: NAME.spz or .ply, NAME.cameras.json, truth/NAME.json with
T_scene_world, frames/). Each part prints its rows when it is done and adds them to the JSON. Times are wall seconds,
medians where they are repeated; the CPU's rows use all cores of the machine. Larger scenes are captures whose Gaussians
are each split into smaller ones in their own plane.

Without a GPU, ``--dry-run`` runs every part on the CPU with tiny scenes: it shows that the script runs.
"""

from __future__ import annotations

import argparse
import contextlib
import cProfile
import functools
import itertools
import json
import multiprocessing
import os
import pickle
import pstats
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gsmap.describe import describe
from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.merge import default_params, merge
from gsmap.register import SceneView, register_pair
from gsmap.render import (
    FitOptions,
    GaussianTensors,
    LearningRates,
    backends,
    gsplat,
    make_fitter,
    render,
    set_num_threads,
)
from gsmap.types import Cameras, Gaussians, PosedScene, Sim3
from tools.harness import argument_parser

PARTS = ("kernels", "fit", "merge", "describe", "pairs", "tile", "memory")
BACKENDS = ("native", "gsplat")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", type=Path)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--pairs", type=int, default=1000, help="candidate pairs to verify")
    parser.add_argument("--profile", action="store_true", help="print where the time of merging and describing goes")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, with tiny scenes")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        if options.dry_run:
            stack.enter_context(_on_cpu())
        if not backends.gsplat_available():
            sys.exit("no GPU here, or no gsplat; --dry-run runs the script on the CPU")
        house = captures_in(options.captures / "house")
        if options.dry_run:
            house = {name: tiny(capture) for name, capture in house.items()}
        for part in options.parts:
            start = time.perf_counter()
            rows = globals()[f"measure_{part}"](house, options)
            for row in rows:
                print(
                    "  ".join(
                        f"{key} {value:.5g}" if isinstance(value, float) else f"{key} {value}"
                        for key, value in row.items()
                    )
                )
            print(f"-- {part}: {time.perf_counter() - start:.1f} s", flush=True)
            if options.json:
                kept = json.loads(options.json.read_text()) if options.json.exists() else {}
                options.json.write_text(json.dumps(kept | {part: rows}, indent=1))


@contextlib.contextmanager
def _on_cpu() -> Iterator[None]:
    """gsplat's torch functions in place of its kernels, as the tests have them."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "render"))
    import pytest
    from gsplat_reference import gsplat_on_cpu

    with pytest.MonkeyPatch.context() as patch:
        getattr(gsplat_on_cpu, "__wrapped__", gsplat_on_cpu)(patch)
        yield


@contextlib.contextmanager
def rendered_by(name: str) -> Iterator[None]:
    """``auto`` means this backend."""
    there = backends.gsplat_available
    backends.gsplat_available = lambda: name == "gsplat"  # type: ignore[assignment]
    try:
        yield
    finally:
        backends.gsplat_available = there


# --- scenes ----------------------------------------------------------------------------------------------------------


class Capture:
    """Gaussians and cameras in their own frame, and where they truly lie."""

    def __init__(self, name: str, gaussians: Gaussians, cameras: Cameras, S_scene_world: Sim3, folder: Path) -> None:
        self.name, self.gaussians, self.cameras, self.S_scene_world = name, gaussians, cameras, S_scene_world
        self.folder = folder

    def placed(self) -> PosedScene:
        S = self.S_scene_world.inverse()
        return PosedScene(transform_gaussians(self.gaussians, S), transform_cameras(self.cameras, S), self.name)


def captures_in(folder: Path) -> dict[str, Capture]:
    out = {}
    for read in read_captures(folder):
        truth = json.loads((folder / "truth" / f"{read.name}.json").read_text())
        S = Sim3.from_matrix(np.array(truth["T_scene_world"]))
        out[read.name] = Capture(read.name, read.gaussians, read.cameras, S, folder)
    return out


def tiny(capture: Capture) -> Capture:
    g = capture.gaussians
    few = g[np.argsort(-g.opacities * g.scales.max(1))[:60]]
    return Capture(capture.name, few, capture.cameras[:6].resized(32), capture.S_scene_world, capture.folder)


def densified(gaussians: Gaussians, times: int, sh_degree: int) -> Gaussians:
    """``times`` smaller Gaussians in the plane of each, with SH of a degree."""
    rng = np.random.default_rng(5)
    axes = quats_to_matrices(gaussians.quats)
    k = (sh_degree + 1) ** 2
    sh = np.zeros((len(gaussians), k, 3), np.float32)
    sh[:, : gaussians.sh.shape[1]] = gaussians.sh[:, :k]
    sh[:, gaussians.sh.shape[1] :] = rng.normal(0, 0.01, sh[:, gaussians.sh.shape[1] :].shape)
    parts = []
    for _ in range(times):
        step = rng.normal(size=(len(gaussians), 3)) * gaussians.scales * 0.8
        means = gaussians.means + np.einsum("nij,nj->ni", axes, step)
        scales = gaussians.log_scales - 0.5 * np.log(times)
        parts.append(Gaussians(means, gaussians.quats, scales, gaussians.logit_opacities, sh))
    return Gaussians.concatenate(parts)


def views_of(capture: Capture, count: int, width: int = 1024, height: int = 1024) -> Cameras:
    """So many of its cameras, of one size."""
    rows = np.linspace(0, len(capture.cameras) - 1, count).astype(int)
    poses = capture.cameras.T_frame_camera[rows]
    return Cameras(
        poses,
        np.tile([0.7 * width, 0.7 * width, width / 2, height / 2], (count, 1)),
        np.tile([width, height], (count, 1)),
    )


def timed(do: Callable[[], object], repeats: int) -> float:
    """Median wall seconds, the GPU waited for; one run to warm up."""
    seconds = []
    for _ in range((repeats if torch.cuda.is_available() else 1) + 1):
        wait()
        start = time.perf_counter()
        do()
        wait()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[1:]))


def wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


# --- parts -----------------------------------------------------------------------------------------------------------


def measure_kernels(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    """Images and gradients beside the CPU's; time beside gsplat called bare, on tensors that lie on the GPU."""
    rows: list[dict] = []
    size = 48 if options.dry_run else 512
    for name in ("c0", "c3"):
        capture = house[name]
        cameras = views_of(capture, 4, size, size)
        ours, theirs = (render(capture.gaussians, cameras, max_weight=True, backend=b) for b in BACKENDS)
        for what in ("colour", "alpha", "depth"):
            error = np.abs(getattr(ours, what) - getattr(theirs, what))
            rows.append(
                {
                    "row": f"{name} {what}",
                    "median": float(np.median(error)),
                    "q99": float(np.quantile(error, 0.99)),
                    "max": float(error.max()),
                }
            )
        # What the clamp of alpha explains: the native backend's is 0.99, gsplat's 0.999.
        softer = replace(capture.gaussians, logit_opacities=np.minimum(capture.gaussians.logit_opacities, 4.5))
        ours, theirs = (render(softer, cameras, backend=b) for b in BACKENDS)
        error = np.abs(ours.colour - theirs.colour)
        rows.append(
            {
                "row": f"{name} colour, opacities below 0.99",
                "median": float(np.median(error)),
                "q99": float(np.quantile(error, 0.99)),
                "max": float(error.max()),
            }
        )
        rows.append(
            {"row": f"{name} dominant differs", "share": float((ours.dominant_id != theirs.dominant_id).mean())}
        )
        gradients = []
        for backend in BACKENDS:
            where = "cpu" if backend == "native" else str(gsplat.device())
            tensors = GaussianTensors.of(softer, device=where, requires_grad=True)
            render(tensors, cameras, depth=False, dominant_id=False, backend=backend).colour.square().mean().backward()
            gradients.append([t.grad.cpu().numpy() for t in tensors.tensors()])
        for what, a, b in zip(("means", "quats", "log_scales", "logit_opacities", "sh"), *gradients, strict=True):
            scale = np.abs(a)[a != 0].mean()
            error = np.abs(a - b)[a != 0] / scale
            rows.append(
                {
                    "row": f"{name} gradient {what}",
                    "median": float(np.median(error)),
                    "relative_norm": float(np.linalg.norm(a - b) / np.linalg.norm(a)),
                }
            )
    for times in (1, 7, 33):
        if options.dry_run and times > 1:
            break
        scene = densified(house["c0"].gaussians, times, 3)
        on_gpu = gsplat.DrawableGaussians.of(GaussianTensors.of(scene, device=str(gsplat.device())))
        for count in (1, 32):
            side = 48 if options.dry_run else 1024
            cameras = views_of(house["c0"], min(count, 3) if options.dry_run else count, side, side)
            pose = torch.tensor(cameras.T_camera_frame, dtype=torch.float32, device=gsplat.device())
            K = torch.tensor(cameras.K, dtype=torch.float32, device=gsplat.device())
            g = on_gpu

            def bare(packed, g=g, pose=pose, K=K, side=side):
                return gsplat.load().rasterization(
                    g.means,
                    g.quats,
                    g.scales,
                    g.opacities,
                    g.sh,
                    pose,
                    K,
                    side,
                    side,
                    sh_degree=3,
                    packed=packed,
                    render_mode="RGB",
                )

            row = {"row": f"{len(scene)} Gaussians, {count} cameras"}
            with torch.no_grad():
                row["bare_packed_ms"] = 1e3 * timed(lambda bare=bare: bare(True), 10)
                try:
                    row["bare_unpacked_ms"] = 1e3 * timed(lambda bare=bare: bare(False), 10)
                except torch.cuda.OutOfMemoryError:
                    row["bare_unpacked_ms"] = float("nan")
                draw = functools.partial(_draw_anew, on_gpu, cameras)
                row["ours_ms"] = 1e3 * timed(lambda draw=draw: draw(False), 10)
                row["ours_all_outputs_ms"] = 1e3 * timed(lambda draw=draw: draw(True), 5)
            row["ours_to_numpy_ms"] = 1e3 * timed(lambda: render(scene, cameras, dominant_id=False), 3)  # noqa: B023
            row["ratio"] = row["ours_ms"] / min(row["bare_packed_ms"], row["bare_unpacked_ms"])
            rows.append(row)
    return rows


def _draw_anew(scene: gsplat.DrawableGaussians, cameras: Cameras, everything: bool) -> object:
    """Draw with the cameras moved to the GPU anew."""
    black = np.zeros(3, np.float32)
    return gsplat._draw(scene, gsplat.DeviceViews.of(cameras), black, everything, everything, everything)


def measure_fit(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    """Optimisation steps by both fitters."""
    rows: list[dict] = []
    for what, times, side in (("480 px", 1, None), ("1 MP", 1, 1024), ("1 MP", 7, 1024)):
        if options.dry_run and times > 1:
            break
        rows.append(steps_per_second(house["c0"], what, times, side, options))
    return rows


def measure_merge(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    """The house pair as one tile, by both backends, and its likeness to the photographs."""
    rows: list[dict] = []
    scenes = [house["c0"].placed(), house["c1"].placed()]
    frames = house["c0"].folder / "frames"
    for backend in ("gsplat", *BACKENDS[::-1]):  # the first loads kernels
        with rendered_by(backend):
            seconds, result = profiled(lambda: merge(scenes, "tto", small_tto(options)), options, f"merge by {backend}")
            row = {
                "row": f"merge of c0 and c1 by {backend}",
                "seconds": seconds,
                "gaussians": len(result.gaussians),
                "steps": result.steps,
            }
            with rendered_by("native"):
                psnr = (
                    [
                        compare_renders(result.gaussians, s.cameras, find_images(house[n].cameras, frames)).psnr_db
                        for n, s in zip(("c0", "c1"), scenes, strict=True)
                    ]
                    if not options.dry_run
                    else [np.zeros(1)]
                )
            rows.append(row | {"psnr_db": float(np.concatenate(psnr).mean())})
    return rows


def steps_per_second(capture: Capture, what: str, times: int, side: int | None, options: argparse.Namespace) -> dict:
    """Steps of both fitters; the CPU's on all cores and on one."""
    scene = densified(capture.gaussians, times, 1 if times == 1 else 3)
    cameras = capture.cameras[:: max(1, len(capture.cameras) // 20)]
    if side is not None and not options.dry_run:
        cameras = views_of(capture, 20, side, side)
    one = [cameras[i] for i in range(len(cameras))]
    noise = np.random.default_rng(0).normal(0, 0.003, scene.means.shape).astype(np.float32)
    moved = replace(scene, means=scene.means + noise)
    pictures = [np.clip(render(scene, c, depth=False, dominant_id=False).colour, 0, 1) for c in one]
    pictures = [np.round(255 * picture).astype(np.uint8) for picture in pictures]
    weights = np.full(pictures[0].shape[:3], 255, np.uint8)
    fit = FitOptions(ssim_weight=0.2, huber_delta=0.05, betas=(0.5, 0.999))
    row: dict = {"row": f"steps per second, {what}, {len(scene)} Gaussians"}
    for name, backend, threads, steps in (
        ("one_core", "native", 1, 4),
        ("cpu", "native", None, 30),
        ("gpu", "gsplat", None, 300),
    ):
        set_num_threads(threads)
        fitter = make_fitter(moved, LearningRates(means=1e-5), options=fit, backend=backend)
        targets, masks = [fitter.load(picture) for picture in pictures], fitter.load(weights)
        steps = 3 if options.dry_run else steps
        for i in range(5 if backend == "gsplat" else 1):
            fitter.step(one[i % len(one)], targets[i % len(one)], masks)
        wait()
        start = time.perf_counter()
        for i in range(steps):
            fitter.step(one[i % len(one)], targets[i % len(one)], masks)
        wait()
        row[name] = steps / (time.perf_counter() - start)
        if backend == "gsplat" and options.profile and torch.cuda.is_available():
            with torch.profiler.profile() as seen:
                for i in range(20):
                    fitter.step(one[i % len(one)], targets[i % len(one)], masks)
                wait()
            print(f"-- kernels of 20 steps, {row['row']}")
            table = seen.key_averages().table(sort_by="self_cuda_time_total", row_limit=28, max_name_column_width=60)
            for line in table.splitlines():
                print(line[:62], line[-90:])
    set_num_threads()
    return row | {"gpu_to_cpu": row["gpu"] / row["cpu"], "gpu_to_core": row["gpu"] / row["one_core"]}


def small_tto(options: argparse.Namespace):
    params = default_params("tto")
    return replace(params, max_passes=0.2, longest_side_px=48) if options.dry_run else params


def measure_tile(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    """A tile of 10 m out of captures of 3 M Gaussians in all, SH degree 3."""
    rows = []
    for times in (1, 1, 10) if not options.dry_run else (1,):  # the first loads kernels
        scenes = []
        for name in ("c0", "c1"):
            placed = house[name].placed()
            scenes.append(replace(placed, gaussians=densified(placed.gaussians, times, 3 if times > 1 else 1)))
        middle = np.median(np.concatenate([s.gaussians.means for s in scenes]), 0)
        bounds = np.array([middle - 5, middle + 5])
        seconds, result = profiled(lambda: merge(scenes, "tto", small_tto(options), bounds=bounds), options, "tile")  # noqa: B023
        rows.append(
            {
                "row": "tile of 10 m",
                "gaussians": sum(len(s.gaussians) for s in scenes),
                "seconds": seconds,
                "steps": result.steps,
                "kept": len(result.gaussians),
            }
        )
    return rows


def measure_describe(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    rows = []
    for times in (1, 17) if not options.dry_run else (1,):
        scene = densified(house["c0"].gaussians, times, 1)
        for backend in ("gsplat", *BACKENDS[::-1]) if times == 1 else ("gsplat",):  # the first loads kernels
            with rendered_by(backend):
                run = lambda: describe("c0", scene, house["c0"].cameras, scale_policy="known")  # noqa: B023, E731
                seconds, graph = profiled(run, options, f"describe {len(scene)} by {backend}")
                rows.append(
                    {
                        "row": f"describe by {backend}",
                        "gaussians": len(scene),
                        "seconds": seconds,
                        "nodes": graph.num_nodes,
                    }
                )
    return rows


def measure_pairs(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    """Candidate pairs verified in processes that each prepare every scene once; registration renders on the CPU."""
    captures = dict(house)
    kitchen = options.captures / "kitchen"
    if kitchen.exists() and not options.dry_run:
        captures |= captures_in(kitchen)
    workers = 1 if options.dry_run else os.cpu_count() or 1
    scenes = [(name, c.gaussians, c.cameras) for name, c in captures.items()]
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # of the workers
        os.environ[name] = "1"
    context = multiprocessing.get_context("spawn")
    start = time.perf_counter()
    with context.Pool(min(workers, len(scenes))) as pool:
        graphs = pool.starmap(_describe, scenes)
    views = {scene[0]: (*scene, graph, "known") for scene, graph in zip(scenes, graphs, strict=True)}
    print(f"-- {len(views)} captures described in {time.perf_counter() - start:.1f} s", flush=True)
    pairs = list(itertools.combinations(views, 2))
    many = list(itertools.islice(itertools.cycle(pairs), 2 if options.dry_run else options.pairs))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "views.pickle").write_bytes(pickle.dumps(views))
        start, accepted = time.perf_counter(), set()
        with context.Pool(workers, _start_worker, (Path(folder) / "views.pickle",)) as pool:
            for done, (pair, status) in enumerate(pool.imap_unordered(_register, many), start=1):
                if done in (1, 10, 100):
                    print(f"-- {done} pairs after {time.perf_counter() - start:.1f} s", flush=True)
                accepted |= {pair} if status == "accepted" else set()
        seconds = time.perf_counter() - start
    row = {"row": f"{len(many)} candidate pairs among {len(views)} scenes", "seconds": seconds, "workers": workers}
    return [row | {"edges": len(accepted)}]


_worker_views: dict = {}


def _start_worker(path: Path) -> None:
    set_num_threads(1)
    torch.set_num_threads(1)
    _worker_views.update({name: SceneView(*parts) for name, parts in pickle.loads(path.read_bytes()).items()})


def _describe(name: str, gaussians: Gaussians, cameras: Cameras):
    set_num_threads(2)
    with rendered_by("native"):
        return describe(name, gaussians, cameras, scale_policy="known")


def _register(pair: tuple[str, str]) -> tuple[tuple[str, str], str]:
    return pair, register_pair(_worker_views[pair[0]], _worker_views[pair[1]]).status


def measure_memory(house: dict[str, Capture], options: argparse.Namespace) -> list[dict]:
    """5 M Gaussians of SH degree 3 through 64 cameras at 1 MP, then with 6 GB allowed."""
    scene = densified(house["c0"].gaussians, 1 if options.dry_run else 33, 3)
    side = 32 if options.dry_run else 1024
    cameras = views_of(house["c0"], 4 if options.dry_run else 64, side, side)
    rows, images = [], []
    for allowed in (None, 6e9, 2.5e9):
        if torch.cuda.is_available():
            gsplat._device_cache.clear()
            torch.cuda.empty_cache()
            total = torch.cuda.get_device_properties(0).total_memory
            torch.cuda.set_per_process_memory_fraction(1.0 if allowed is None else allowed / total)
            torch.cuda.reset_peak_memory_stats()
        start = time.perf_counter()
        shown = render(scene, cameras, dominant_id=False)
        seconds = time.perf_counter() - start
        peak = torch.cuda.max_memory_allocated() / 1e9 if torch.cuda.is_available() else 0.0
        images.append(shown.colour)
        rows.append(
            {
                "row": f"{len(scene)} Gaussians, {len(cameras)} views",
                "allowed_gb": (allowed or 0) / 1e9,
                "peak_gb": peak,
                "seconds": seconds,
            }
        )
    if torch.cuda.is_available():
        torch.cuda.set_per_process_memory_fraction(1.0)
    rows.append({"row": "difference of these", "max": float(max(np.abs(images[0] - one).max() for one in images))})
    return rows


def profiled(do: Callable, options: argparse.Namespace, what: str):
    """Wall seconds and the answer; with --profile, where the time goes."""
    profile = cProfile.Profile()
    start = time.perf_counter()
    if options.profile:
        profile.enable()
    answer = do()
    profile.disable()
    wait()
    seconds = time.perf_counter() - start
    if options.profile:
        print(f"-- profile of {what}, {seconds:.2f} s")
        for order in ("tottime", "cumtime"):
            pstats.Stats(profile).sort_stats(order).print_stats(30 if order == "cumtime" else 14)
    return seconds, answer


if __name__ == "__main__":
    main()
