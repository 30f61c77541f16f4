"""What the page of `gsmap view` shows, and what it costs: fidelity, bytes, memory, seconds.

python -m tools.bench.view fidelity MAP       the page against gsmap's own full render from five of the map's cameras
python -m tools.bench.view large              500 made scenes of 100,000 Gaussians: cold, then warm
python -m tools.bench.view trees              CPU seconds to make levels of detail, a million Gaussians
python -m tools.bench.view catalog            map.json of a map of 500 scenes: seconds, and after a change

Chromium draws without a graphics card here (SwiftShader): its seconds are an upper bound, its memory holds what a card
would.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]
for folder in ("", "tests/view"):
    sys.path.insert(0, str(ROOT / folder))

from gsmap.errors import NotFoundError  # noqa: E402
from gsmap.geometry.morton import morton_order  # noqa: E402
from gsmap.geometry.transforms import transform_cameras, transform_gaussians  # noqa: E402
from gsmap.types import Gaussians, PoseGraph, Scene, ScenePose, Sim3  # noqa: E402
from gsmap.view import Params, ViewMap, ViewScene, ViewServer  # noqa: E402
from gsmap.view.trees import sketch, write_tree  # noqa: E402

_SIDE = 6.0


@lru_cache(maxsize=4)
def made_room(seed: int, count: int, sh_degree: int = 1) -> Gaussians:
    """Flat Gaussians on the floor, the walls and boxes of a room of 6 x 5 x 2.5, along their Morton curve."""
    rng = np.random.default_rng(seed)
    boxes = [np.array([[0.0, 0, 0], [_SIDE, 5, 2.5]])]
    for _ in range(12):
        low = rng.uniform([0, 0, 0], [5, 4, 0.1])
        boxes.append(np.stack([low, low + rng.uniform(0.3, 1.2, 3)]))
    parts, colours, axes = [], [], []
    for i, box in enumerate(boxes):
        n = count // 2 if i == 0 else count // (2 * (len(boxes) - 1)) + 1
        at, axis, end = rng.uniform(box[0], box[1], (n, 3)), rng.integers(0, 3, n), rng.integers(0, 2, n)
        at[np.arange(n), axis] = box[end, axis]
        shade = rng.uniform(-1, 1.2, (3, 2, 3))[axis, end] + 0.3 * np.sin(at @ rng.uniform(2, 9, (3, 3)))
        parts.append(at)
        colours.append(shade)
        axes.append(axis)
    means, sh0, axis = (np.concatenate(values)[:count] for values in (parts, colours, axes))
    scales = np.full((count, 3), np.log(0.02))
    scales[np.arange(count), axis] = np.log(0.002)
    sh = rng.normal(0, 0.08, (count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = sh0
    # Turned about their normals and of many sizes, or they would pack far better than trained ones do.
    scales += rng.normal(0, 0.5, (count, 3))
    half, quats = rng.uniform(0, np.pi, count), np.zeros((count, 4))
    quats[:, 0], quats[np.arange(count), 1 + axis] = np.cos(half), np.sin(half)
    made = Gaussians(means, quats, scales, rng.normal(2.5, 1, count), sh)
    return made[morton_order(made.means)]


@dataclass
class SyntheticPageSource:
    """So many rooms on a grid, no two alike: what repeats would pack as no map does."""

    num_scenes: int
    count: int
    actions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        scenes, across = [], int(np.ceil(np.sqrt(self.num_scenes)))
        for i in range(self.num_scenes):
            g = made_room(i, self.count)
            bounds = np.stack([g.means.min(0), g.means.max(0)]).astype(float)
            at = np.array([i % across * (_SIDE + 0.5), i // across * (_SIDE + 0.5), 0.0])
            pose = ScenePose(f"{i:032x}", Sim3(np.eye(3), at), 0, "placed", np.diag([1e-6] * 7))
            scene = Scene(f"{i:032x}", f"room {i}", self.count, g.sh_degree, 0, bounds)
            scenes.append(ViewScene(scene, f"{i:032x}-v1", pose))
        self.view = ViewMap("made", scenes, state="made", revision=1)

    def state(self) -> str:
        return self.view.state

    def content(self) -> ViewMap:
        return self.view

    def source(self, scene: str) -> Gaussians:
        return made_room(int(scene, 16), self.count)

    def extras(self, scene: str) -> dict[str, Any]:
        return {"layers": {}, "cameras": []}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)

        def nothing(*_: object) -> Any:
            raise NotFoundError(f"no {name} of a made map")

        return nothing


def memory_mb(process: int) -> dict[str, float]:
    """Resident megabytes of the kinds of Chromium's processes below one; shared pages count in part (PSS)."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            children.setdefault(parent, []).append(int(entry.name))
    found: dict[str, float] = {}
    todo = [process]
    while todo:
        one = todo.pop()
        todo += children.get(one, [])
        try:
            words = Path(f"/proc/{one}/cmdline").read_text().split("\0")
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        kind = next((word.removeprefix("--type=") for word in words if word.startswith("--type=")), "browser")
        pss = next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        found[kind] = round(found.get(kind, 0.0) + pss / 1024, 1)
    return found


def bytes_so_far(page: Any) -> int:
    """What came over the wire, headers and all."""
    return sum(
        int(message["params"]["encodedDataLength"])
        for message in page.messages
        if message.get("method") == "Network.loadingFinished"
    )


def look(url: str, settle_s: float) -> dict[str, Any]:
    """Opens a page as a person does; what it had cost at the first picture, and when it had settled."""
    from headless import Page

    with tempfile.TemporaryDirectory() as folder, Page(url, Path(folder) / "profile", 1280, 800) as page:
        start = time.perf_counter()
        page.wait("window.gsmap && window.gsmap.splats > 0 && window.gsmap.frames > 0", settle_s)
        said: dict[str, Any] = {"first_picture_s": round(time.perf_counter() - start, 2)}
        said["first_picture_bytes"] = bytes_so_far(page)
        said["first_picture_splats"] = page.value("window.gsmap.splats")
        end = time.perf_counter() + settle_s
        while not page.value("window.gsmap.settled") and time.perf_counter() < end:
            time.sleep(1)
        said["settled_s"] = round(time.perf_counter() - start, 1) if page.value("window.gsmap.settled") else None
        state = page.value("window.gsmap")
        said |= {name: state[name] for name in ("splats", "bytesReceived", "bytesUploaded", "pending", "error")}
        said["uploaded_over_received"] = round(state["bytesUploaded"] / max(1, state["bytesReceived"]), 2)
        said["js_heap_mb"] = round(page.value("performance.memory.usedJSHeapSize") / 1e6, 1)
        said["memory_mb"] = memory_mb(page._process.pid)
        said["failures"] = page.failures()[:5]
        return said


def large(args: argparse.Namespace) -> None:
    page_source = SyntheticPageSource(args.scenes, args.gaussians)
    with tempfile.TemporaryDirectory() as cache_folder:
        for name in ("cold", "warm"):
            cpu = time.process_time()
            with ViewServer(page_source, Path(cache_folder), Params()).start() as server:
                said = look(server.url, args.settle)
            report(f"large {name}", said | {"server_cpu_s": round(time.process_time() - cpu, 1)})


def trees(args: argparse.Namespace) -> None:
    for count, degree in ((100_000, 1), (args.gaussians, 1), (args.gaussians, 3)):
        g = made_room(0, count, degree)
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            write_tree(Path(folder) / "tree", g)
            cpu = time.process_time() - start
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        start = time.process_time()
        sketch(g, 512)
        brief = time.process_time() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        said = {"cpu_s_per_million": round(cpu / count * 1e6, 2), "bytes_per_gaussian": round(size / count, 1)}
        said |= {"sketch_ms": round(1000 * brief, 1), "peak_mb": round(peak), "source_mb": round(g.nbytes / 2**20)}
        report(f"trees {count:,} SH{degree}", said)


def catalog(args: argparse.Namespace) -> None:
    from gsmap.map import create
    from gsmap.map.page.source import MapPageSource
    from gsmap.types import Cameras

    none = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2)), (), True)
    with tempfile.TemporaryDirectory() as folder, create(Path(folder) / "m.gsmap") as m:
        poses = {}
        for i in range(args.scenes):
            scene, _ = m.store.scenes.add(made_room(i, 50), none, name=f"room {i}")
            poses[scene.id] = ScenePose(scene.id, Sim3(np.eye(3), np.array([7.0 * i, 0, 0])), 0, "placed", np.eye(7))
        m.store.revisions.save(PoseGraph(poses))
        page_source = MapPageSource(m.store, m.settings)
        for name in ("first", "same", "changed"):
            if name == "changed":
                m.edit("room 3", name="another")
            wall, cpu = time.perf_counter(), time.process_time()
            page_source.content()
            took = {"ms": round(1000 * (time.perf_counter() - wall), 1)}
            report(f"catalog {args.scenes} {name}", took | {"cpu_ms": round(1000 * (time.process_time() - cpu), 1)})


def fidelity(args: argparse.Namespace) -> None:
    """The 3D view alone, through the real server, so that no panel lies over the picture."""
    from headless import Page
    from stage_site import bundle

    import gsmap
    from gsmap.evaluate.images import psnr
    from gsmap.render import render

    with tempfile.TemporaryDirectory() as name, gsmap.open(args.map) as m:
        folder = Path(name)
        page_folder = folder / "page"
        page_folder.mkdir()
        bundle("stage.ts", page_folder / "page.js")
        (page_folder / "style.css").write_text(
            "html, body { margin: 0; height: 100% } canvas { display: block; width: 100%; height: 100% }"
        )
        (page_folder / "index.html").write_text(
            '<!doctype html><html><head><link rel="icon" href="data:," /><link rel="stylesheet" href="style.css" />'
            '</head><body><canvas tabindex="0"></canvas><script type="module" src="page.js"></script></body></html>'
        )
        from gsmap.map.page.source import MapPageSource, cache_folder

        page_source = MapPageSource(m.store, m.settings)
        placed = [
            entry for entry in page_source.content().scenes if entry.pose is not None and entry.pose.component == 0
        ]
        union = Gaussians.concatenate(
            [transform_gaussians(m.store.scenes.gaussians(e.scene.id), e.S_map_scene) for e in placed]
        )
        cameras = []
        for k in range(5):
            entry = placed[k % len(placed)]
            own = m.store.scenes.cameras(entry.scene.id)
            row = (2 * k + 1) * len(own) // 10
            cameras.append(transform_cameras(own[row : row + 1], entry.S_map_scene))
        width, height = cameras[0].sizes_px[0].tolist()
        with (
            ViewServer(page_source, cache_folder(), m.settings.view, page=page_folder).start() as server,
            Page(server.url, folder / "profile", width, height) as page,
        ):
            page.wait("!!window.gsmap?.stage", 60)
            page.value("fetch('map.json').then((r) => r.json()).then((map) => gsmap.stage.show(map, 0))")
            found = []
            for k, camera in enumerate(cameras):
                pose, K, size = (v[0].tolist() for v in (camera.T_frame_camera, camera.intrinsics_px, camera.sizes_px))
                page.value(f"void gsmap.stage.standAtCamera({pose}, {K}, {size})")
                page.value("new Promise((done) => setTimeout(done, 500))")
                page.wait("gsmap.state.settled", args.settle)
                picture = page.picture()
                truth = np.clip(render(union, camera, dominant_id=False, depth=False).colour[0], 0, 1)
                found.append(psnr(picture, truth))
                splats = page.value("gsmap.state.splats")
                report(f"fidelity camera {k}", {"psnr_db": round(float(found[-1]), 2), "splats": splats})
            report("fidelity", {"worst_db": round(float(min(found)), 2), "mean_db": round(float(np.mean(found)), 2)})


def report(what: str, said: dict[str, Any]) -> None:
    print(json.dumps({"what": what, **said}), flush=True)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("what", choices=["fidelity", "large", "trees", "catalog"])
    parser.add_argument("map", nargs="?", help="of fidelity")
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--gaussians", type=int, default=None, help="of a scene")
    parser.add_argument("--settle", type=float, default=240.0, help="seconds to wait for all levels")
    args = parser.parse_args()
    args.gaussians = args.gaussians or (1_000_000 if args.what == "trees" else 100_000)
    if args.what == "fidelity" and not args.map:
        parser.error("fidelity needs a map")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    globals()[args.what](args)


if __name__ == "__main__":
    main()
