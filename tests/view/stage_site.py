"""A site for the 3D view of the page: made scenes as trees, a map that names them, and the view alone, bundled."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import threading
import time
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsmap.formats import spz, tiles3d
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Gaussians, Sim3

PAGE = Path(__file__).parents[2] / "gsmap" / "view" / "page"
HERE = Path(__file__).parent / "stage_page"


def bundle(name: str, out: Path, platform: str = "browser") -> Path:
    """A script of ``stage_page``, bundled; skips where the page's packages are not installed."""
    esbuild = PAGE / "node_modules" / ".bin" / "esbuild"
    if not esbuild.exists() or not shutil.which("node"):
        pytest.skip("needs the page's packages: tools/build_page.sh")
    options = ["--bundle", "--format=esm", f"--platform={platform}", "--log-level=warning", f"--outfile={out}"]
    # What the scripts import lies beside the page, not beside them.
    subprocess.run([esbuild, HERE / name, *options], check=True, cwd=PAGE)
    return out


def room(seed: int, count: int = 3000, degree: int = 1) -> Gaussians:
    """Flat Gaussians on the six sides of a room of 4 x 3 x 2.4, its floor at y = 0 (down is +y); colours that turn."""
    rng = np.random.default_rng(seed)
    size = np.array([4.0, 2.4, 3.0])
    side = rng.integers(0, 6, count)
    means = rng.uniform(0, 1, (count, 3)) * size
    axis = side // 2
    means[np.arange(count), axis] = (side % 2) * size[axis]
    means -= [size[0] / 2, size[1], size[2] / 2]
    log_scales = rng.uniform(np.log(0.04), np.log(0.09), (count, 3))
    log_scales[: count // 3] -= np.log(15)  # smaller than a pixel: what is added to every covariance shows
    log_scales[np.arange(count), axis] = np.log(0.004)
    base = np.array([[1.2, -0.6, -0.6], [-0.6, 1.2, -0.6], [-0.6, -0.6, 1.2], [1, 1, -0.8], [1, -0.8, 1], [-0.8, 1, 1]])
    sh = np.zeros((count, (degree + 1) ** 2, 3))
    sh[:, 0] = base[side] + rng.normal(0, 0.4, (count, 3))
    sh[:, 1:] = rng.normal(0, 0.25, sh[:, 1:].shape)
    quats = rng.normal([1, 0, 0, 0], 0.05, (count, 4))
    return Gaussians(means, quats, log_scales, rng.uniform(1, 4, count), sh)


def pose(x: float, turn_deg: float = 0.0, scale: float = 1.0) -> np.ndarray:
    """(4, 4) [s R | t]: along x, turned about the vertical."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    out = np.eye(4)
    out[:3, :3] = scale * np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    out[0, 3] = x
    return out


def site(
    folder: Path, scenes: list[tuple[Gaussians, np.ndarray]], *, max_per_tile: int = 600, overview: bool = True
) -> dict[str, Any]:
    """Writes trees, overview and ``map.json`` into a folder; returns the map."""
    rows, shares, counts, corners = [], [], [], []
    for i, (g, S) in enumerate(scenes):
        path = folder / f"scene{i}" / "tileset.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        tiles3d.write(path, g, max_per_tile=max_per_tile)
        root = json.loads(path.read_text())["root"]
        coarse = tiles3d.read_content(path.parent / root["content"]["uri"])
        shares.append(transform_gaussians(replace(coarse, sh=coarse.sh[:, :1]), Sim3.from_matrix(S)))
        counts.append(len(coarse))
        box = np.stack([np.quantile(g.means, q, axis=0) for q in (0.01, 0.99)]).astype(float)
        ends = np.array([[box[k >> a & 1][a] for a in range(3)] for k in range(8)]) @ S[:3, :3].T + S[:3, 3]
        corners.append(ends)
        corner = [(-0.2, -0.15), (0.2, -0.15), (0.2, 0.15), (-0.2, 0.15)]
        frusta = [[[x, -1.2, 0], *([x + dx, -1.2 + dy, 0.3] for dx, dy in corner)] for x in (-1, 0, 1)]
        frusta = (np.array(frusta) @ S[:3, :3].T + S[:3, 3]).tolist()
        nodes = {"landmarks": ends[:4].tolist()}
        (path.parent / "extras.json").write_text(json.dumps({"layers": nodes, "cameras": frusta}))
        rows.append(
            {"id": f"s{i}", "name": f"scene {i}", "num_gaussians": len(g), "num_cameras": 3, "captured_at": None,
             "component": 0, "status": "placed", "S_map_scene": S.tolist(), "box": box.tolist(),
             "corners": ends.tolist(), "sigma_m": 0.1, "ellipsoid": np.diag([0.04, 0.01, 0.09]).tolist(),
             "middle": ends.mean(0).tolist(), "tileset": f"scene{i}/tileset.json", "extras": f"scene{i}/extras.json",
             "tags": [], "prior": None, "prior_number": None}
        )  # fmt: skip
    (folder / "overview.spz").write_bytes(spz.pack("overview", Gaussians.concatenate(shares)))
    every = np.concatenate(corners)
    component = {"component": 0, "num_scenes": len(rows), "up": [0, -1, 0], "metres_per_unit": 1.0,
                 "scale_sigma": None,
                 "box": [every.min(0).tolist(), every.max(0).tolist()], "merged": None,
                 "plan": None,
                 "overview": {"uri": "overview.spz", "pending": 0, "scenes": list(range(len(rows))), "counts": counts,
                              "frame": None, "outline": None, "size": None, "has_ceiling": False}
                 if overview else None}  # fmt: skip
    edges = [{"target": i, "source": i + 1, "status": "accepted", "used": True, "one_pair": False, "undecided": False,
              "review": None,
              "note": "", "reason": "", "probability": 0.9, "overlap": 0.5, "num_inliers": 9, "doubt": 0.0,
              "detail": ""} for i in range(len(rows) - 1)]  # fmt: skip
    out = {"schema": 1, "state": "1", "title": "made", "actions": False, "revision": 1, "components": [component],
           "scenes": rows, "edges": edges, "revisions": [], "changes": [], "photos": [],
           "counts": {"gaussians": sum(len(g) for g, _ in scenes)}, "graph": None, "history": None}  # fmt: skip
    (folder / "map.json").write_text(json.dumps(out))
    return out


class Served:
    """A folder over HTTP, with the view at ``/view``; it keeps what was asked for, and can be slow."""

    def __init__(self, folder: Path) -> None:
        self.asked: list[str] = []
        self.slow_s: dict[str, float] = {}
        self.waiting: dict[str, int] = {}  # path to how often it answers 202 yet
        outer = self

        class Handler(SimpleHTTPRequestHandler):
            def do_GET(self) -> None:
                path = self.path.split("?")[0]
                outer.asked.append(self.path)
                for part, seconds in outer.slow_s.items():
                    if part in path:
                        time.sleep(seconds)
                if outer.waiting.get(path, 0) > 0:
                    outer.waiting[path] -= 1
                    body = json.dumps({"progress": 0.5, "waiting": 0, "retry_s": 0.2}).encode()
                    self.send_response(202)
                    self.send_header("Content-Length", str(len(body)))
                    self.end_headers()
                    self.wfile.write(body)
                    return
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the page no longer wants it
                    super().do_GET()

            def translate_path(self, path: str) -> str:
                path = path.split("?")[0]
                return str(HERE / "index.html") if path == "/view" else super().translate_path(path)

            def log_message(self, *_: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
