"""Times the renderer: CPU time on one thread, wall time on all, pairs per second against the loop's own limit.

    python -m tools.bench.render [--quick] [--json OUT.json] [--capture PLY CAMERAS_JSON]
                                 [--opensplat CHECKOUT]

CPU milliseconds are the smallest of several runs on one thread (`time.process_time`), which neighbours on the machine
disturb least; wall is the smallest on all threads. ``--opensplat`` compiles the CPU rasteriser of an OpenSplat checkout
in a temporary folder against the installed torch and times it on the same scenes in the same run, after giving it
contiguous depths (under current torch it would sort by the wrong numbers). Peers are timed on one thread as well.
"""

from __future__ import annotations

import json
import os
import resource
import time
from pathlib import Path

import numpy as np

from gsmap import _native
from gsmap.render import ChunkIndex, LearningRates, native, num_threads, render, set_num_threads
from gsmap.render.native_fit import NativeFitter
from gsmap.types import Cameras, Gaussians
from tools.harness import argument_parser, timed

BLACK = np.zeros(3, np.float32)


def room(n: int, k: int, seed: int = 0) -> Gaussians:
    """A furnished room: walls, floor, ceiling and 40 boxes covered with flat Gaussians, as trained scenes look."""
    rng = np.random.default_rng(seed)
    boxes = [((0.0, 0.0, 0.0), (5.0, 1.6, 4.0))]
    boxes += [(rng.uniform(-1, 1, 3) * (4.2, 1.2, 3.2), rng.uniform(0.15, 0.6, 3)) for _ in range(40)]
    areas = np.array([s[0] * s[1] + s[1] * s[2] + s[0] * s[2] for _, s in boxes])
    which = rng.choice(len(boxes), n, p=areas / areas.sum())
    center, half = np.array([b[0] for b in boxes])[which], np.array([b[1] for b in boxes])[which]
    axis = rng.integers(0, 3, n)
    point = rng.uniform(-1, 1, (n, 3))
    point[np.arange(n), axis] = rng.choice([-1.0, 1.0], n)
    spacing = np.sqrt(8 * areas.sum() / n)
    scales = spacing * np.exp(rng.normal(0, 0.5, (n, 3))) * 0.5
    scales[np.arange(n), axis] *= 0.1
    quats = np.concatenate([np.ones((n, 1)), rng.normal(0, 0.1, (n, 3))], 1)
    sh = np.concatenate([rng.normal(0, 0.8, (n, 1, 3)), rng.normal(0, 0.1, (n, k - 1, 3))], 1)
    return Gaussians(center + point * half, quats, np.log(scales), rng.normal(1.5, 1.5, n), sh)


def looking(width: int, height: int, views: int = 4) -> Cameras:
    """Cameras in the middle of the room, looking around."""
    T = np.tile(np.eye(4), (views, 1, 1))
    for i, a in enumerate(np.linspace(0, 2 * np.pi, views, endpoint=False)):
        T[i, :3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
        T[i, :3, 3] = [-2.5 * np.sin(a), 0, -2.0 * np.cos(a)]
    focal = 0.6 * width
    return Cameras(T, [[focal, focal, width / 2, height / 2]] * views, [[width, height]] * views)


def smallest(function, repeats: int, clock=time.process_time) -> float:
    """Milliseconds of the fastest of several calls."""
    best = np.inf
    for _ in range(repeats):
        start = clock()
        function()
        best = min(best, clock() - start)
    return 1e3 * best


class Ours:
    """Forward and backward passes of one scene through the native kernel, gradients of all inputs included."""

    def __init__(self, gaussians: Gaussians, cameras: Cameras):
        self.arrays, self.cameras = native.arrays_of(gaussians), cameras
        width, height = cameras.sizes_px[0].tolist()
        self.view = native.View()
        self.gradients = [np.zeros_like(a) for a in self.arrays]
        self.images = native.allocate(1, height, width, len(gaussians), False, False, False)
        self.g_colour = np.random.default_rng(0).normal(size=(height, width, 3)).astype(np.float32)

    def forward(self, i: int) -> None:
        pose, intrinsics = self.cameras.T_camera_frame[i], self.cameras.intrinsics_px[i]
        native.forward(self.view, self.arrays, pose, intrinsics, BLACK, self.images, 0, None)

    def both(self, i: int) -> None:
        self.forward(i)
        for gradient in self.gradients:
            gradient.fill(0)
        self.view.backward(
            *self.arrays,
            background=BLACK,
            colour=self.images["colour"][0],
            depth=None,
            alpha=self.images["alpha"][0],
            g_colour=self.g_colour,
            g_depth=None,
            g_alpha=None,
            gradients=self.gradients,
            g_pose=None,
        )


def measure(name: str, gaussians: Gaussians, cameras: Cameras, repeats: int, limit: float, peer) -> dict:
    """One row of the table: means over the cameras."""
    ours, rows = Ours(gaussians, cameras), []
    for i in range(len(cameras)):
        set_num_threads(1)
        row = {"forward_cpu_ms": smallest(lambda i=i: ours.forward(i), repeats)}
        row["forward_backward_cpu_ms"] = smallest(lambda i=i: ours.both(i), repeats)
        row |= {"pairs": ours.view.pairs, "visible": ours.view.visible, "intersections": ours.view.intersections}
        allowed = 200 * len(gaussians) + 80 * ours.view.intersections
        row["workspace_share_of_bound"] = ours.view.workspace_bytes / allowed
        set_num_threads()
        row["forward_wall_ms"] = smallest(lambda i=i: ours.forward(i), repeats, time.perf_counter)
        row["forward_backward_wall_ms"] = smallest(lambda i=i: ours.both(i), repeats, time.perf_counter)
        rows.append(row)
    out = {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}
    out["gpairs_per_s"] = out["pairs"] / out["forward_cpu_ms"] * 1e-6
    out["share_of_limit"] = out["gpairs_per_s"] / limit
    if peer is not None:
        theirs = peer.measure(gaussians, cameras[[0]])
        ours.forward(0)
        theirs["opensplat_mean_difference"] = float(np.abs(theirs.pop("image") - ours.images["colour"][0]).mean())
        out |= theirs
        out["opensplat_forward_ratio"] = theirs["opensplat_forward_ms"] / rows[0]["forward_cpu_ms"]
        both = rows[0]["forward_backward_cpu_ms"]
        out["opensplat_forward_backward_ratio"] = theirs["opensplat_forward_backward_ms"] / both
    return {"scene": name, **out}


def optimisation_steps(gaussians: Gaussians, cameras: Cameras, steps: int) -> dict:
    """Full steps (render, L1, backward, Adam) per second, on all threads and per core."""
    targets = render(gaussians, cameras, depth=False, dominant_id=False).colour
    noise = np.random.default_rng(0).normal(size=gaussians.means.shape) * 0.003
    moved = Gaussians(gaussians.means + noise, *native.arrays_of(gaussians)[1:])
    out = {"num_gaussians": len(gaussians), "sh_degree": gaussians.sh_degree, "threads": num_threads()}
    for name, threads, clock in (
        ("cpu_ms_per_step", 1, time.process_time),
        ("wall_ms_per_step", None, time.perf_counter),
    ):
        set_num_threads(threads)
        fitter = NativeFitter(moved, LearningRates(means=1e-5))
        for i in range(3):
            fitter.step(cameras[[i % len(cameras)]], targets[[i % len(cameras)]])
        times = []
        for s in range(steps):
            i = s % len(cameras)
            start = clock()
            fitter.step(cameras[[i]], targets[[i]])
            times.append(clock() - start)
        out[name] = 1e3 * float(np.mean(times))
        out[name.replace("per_step", "per_step_median")] = 1e3 * float(np.median(times))
    out["steps_per_s_per_core"] = 1e3 / out["cpu_ms_per_step"]
    out["steps_per_s_wall"] = 1e3 / out["wall_ms_per_step"]
    return out


def site(n: int, repeats: int) -> dict:
    """A site of n Gaussians and a camera that sees about 2 % of it, through an index of chunk boxes."""
    rng = np.random.default_rng(0)
    cells = int(np.sqrt(n / 4096))  # chunk-sized cells in rows, as Morton order leaves them
    cell = np.repeat(np.arange(cells * cells), -(-n // (cells * cells)))[:n]
    means = rng.uniform(0, 1, (n, 3)).astype(np.float32)
    means[:, 0] += cell % cells
    means[:, 2] += cell // cells
    means *= np.float32([2.0, 3.0, 2.0])
    log_scales = np.full((n, 3), np.log(0.02), np.float32) + rng.normal(0, 0.5, (n, 3)).astype(np.float32)
    quats = rng.normal(size=(n, 4)).astype(np.float32)
    gaussians = Gaussians(means, quats, log_scales, rng.normal(size=n), rng.normal(size=(n, 1, 3)))
    index, took = timed(ChunkIndex.build, gaussians)
    built = 1e3 * took
    T = np.eye(4)
    side = 2.0 * cells
    T[:3, 3] = [side / 2, 1.5, side * 0.72]  # near one edge, looking out over it
    cameras = Cameras(T[None], [[384, 384, 320, 240]], [[640, 480]])
    arrays = native.arrays_of(gaussians)
    images, view = native.allocate(1, 480, 640, n, False, False, False), native.View()
    ranges = index.visible_ranges(cameras.T_camera_frame[0], cameras.intrinsics_px[0], 640, 480)

    def run(i):
        native.forward(view, arrays, cameras.T_camera_frame[0], cameras.intrinsics_px[0], BLACK, images, 0, i)

    out = {"num_gaussians": n, "index_build_ms": built, "visible_share": 0.0}
    out["candidates_share"] = float((ranges[:, 1] - ranges[:, 0]).sum() / n)
    for name, threads, clock in (("cpu_ms", 1, time.process_time), ("wall_ms", None, time.perf_counter)):
        set_num_threads(threads)
        out[name] = smallest(lambda: run(index), repeats, clock)
    out["visible_share"] = view.visible / n
    set_num_threads(1)
    out["cpu_ms_without_index"] = smallest(lambda: run(None), 2)
    set_num_threads()
    return out


def read_capture(ply: Path, cameras_json: Path) -> tuple[Gaussians, Cameras]:
    from gsmap import formats

    listed = json.loads(cameras_json.read_text())
    T = np.tile(np.eye(4), (len(listed), 1, 1))
    for i, c in enumerate(listed):
        T[i, :3, :3], T[i, :3, 3] = c["rotation"], c["position"]
    intrinsics = [[c["fx"], c["fy"], c["width"] / 2, c["height"] / 2] for c in listed]
    return formats.read(ply), Cameras(T, intrinsics, [[c["width"], c["height"]] for c in listed])


def main() -> None:
    parser = argument_parser(__doc__)
    house = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "house"
    parser.add_argument("--quick", action="store_true", help="300k Gaussians at 640x480 and the capture only")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--capture", type=Path, nargs=2, default=(house / "c0.ply", house / "c0.cameras.json"))
    parser.add_argument("--opensplat", type=Path, help="a checkout of github.com/pierotofy/OpenSplat")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--no-site", action="store_true", help="leave out the site of 10 million Gaussians")
    args = parser.parse_args()

    peer = None
    if args.opensplat:
        from tools.bench.render_opensplat import OpenSplat

        peer = OpenSplat(args.opensplat)
    set_num_threads(1)
    pairs = _native.blend_limit(2000)
    limit = pairs / smallest(lambda: _native.blend_limit(2000), 9) * 1e-6
    isa = native.use_instruction_set("best")
    set_num_threads()
    report = {"instruction_set": isa, "threads": num_threads(), "limit_gpairs_per_s": limit, "cores": os.cpu_count()}
    print(f"{isa}, {num_threads()} threads; the blending loop alone makes {limit:.2f} G pairs/s per core")
    print(
        f"{'scene':24}{'fwd cpu':>9}{'f+b cpu':>9}{'fwd wall':>9}{'f+b wall':>9}{'Gpair/s':>9}{'limit':>7}{'mem':>6}",
        end="",
    )
    print(f"{'OpenSplat fwd':>15}{'f+b':>8}{'ratio':>13}" if peer else "")

    scenes = []
    for n in (300_000,) if args.quick else (100_000, 300_000, 1_000_000):
        for k in (1, 16):
            for size in ((640, 480),) if args.quick else ((320, 240), (640, 480)):
                name = f"{n // 1000}k SH{int(k**0.5) - 1} {size[0]}x{size[1]}"
                scenes.append((name, lambda n=n, k=k, size=size: (room(n, k), looking(*size))))
    if all(p.exists() for p in args.capture):

        def capture():
            gaussians, cameras = read_capture(*args.capture)
            return gaussians, cameras[:: max(1, len(cameras) // 6)]

        scenes.append((f"capture {args.capture[0].stem}", capture))
    report["scenes"] = []
    for name, make in scenes:
        row = measure(name, *make(), args.repeats, limit, peer)
        report["scenes"].append(row)
        print(f"{name:24}{row['forward_cpu_ms']:9.1f}{row['forward_backward_cpu_ms']:9.1f}", end="")
        print(f"{row['forward_wall_ms']:9.1f}{row['forward_backward_wall_ms']:9.1f}{row['gpairs_per_s']:9.2f}", end="")
        print(f"{row['share_of_limit']:7.0%}{row['workspace_share_of_bound']:6.0%}", end="")
        if peer:
            print(f"{row['opensplat_forward_ms']:15.0f}{row['opensplat_forward_backward_ms']:8.0f}", end="")
            print(f"{row['opensplat_forward_ratio']:6.1f}/{row['opensplat_forward_backward_ratio']:4.1f}x", end="")
        print(flush=True)

    if all(p.exists() for p in args.capture):
        gaussians, cameras = capture()
        report["optimisation"] = optimisation_steps(gaussians, cameras, 12 if args.quick else 36)
        o = report["optimisation"]
        print(f"optimisation of {o['num_gaussians']} Gaussians SH{o['sh_degree']}: ", end="")
        print(f"{o['cpu_ms_per_step']:.1f} CPU ms a step = {o['steps_per_s_per_core']:.1f}/s on one core, ", end="")
        print(f"{o['steps_per_s_wall']:.1f}/s wall on {o['threads']} threads")
    if not args.no_site:
        report["site"] = site(2_000_000 if args.quick else 10_000_000, 5)
        s = report["site"]
        print(f"site of {s['num_gaussians']:,}: {s['visible_share']:.1%} visible, {s['cpu_ms']:.0f} CPU ms, ", end="")
        print(f"{s['wall_ms']:.0f} ms wall, {s['cpu_ms_without_index']:.0f} CPU ms without index", end="")
        print(f" (built in {s['index_build_ms']:.0f})")
    report["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
