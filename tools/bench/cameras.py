"""Whether captures with few cameras, or none, register as they do with all of them.

A folder holds captures (NAME.ply, NAME.cameras.json) and truth/NAME.json with T_scene_world; pairs of different folders
share nothing. Every capture is described and registered with all its cameras, with ten of them spread over the walk,
with the first ten alone, and with none, for which gsmap makes views itself. Scales are known, and landmarks alone
propose: what differs between the rows is what cameras say.

    python -m tools.make.scenes place FOLDER --seed 501 --captures 4 --steps 200 --gaussians 30000
    python -m tools.bench.cameras FOLDER FOLDER ...
    python -m tools.bench.cameras FOLDER --cameras none --verbose
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, say, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import itertools
import json
from collections import Counter
from pathlib import Path

import numpy as np

from gsmap.describe import Params as DescribeParams
from gsmap.describe import describe
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.ingest import read_captures, synthesise_cameras
from gsmap.register import SceneView, register_pair
from gsmap.types import Cameras, Gaussians, SceneGraph, Sim3

KINDS = ("all", "spread", "first", "none")
BANDS = ((0.25, 1.01), (0.1, 0.25), (0.01, 0.1), (0.0, 0.01))
LANDMARKS = DescribeParams(objects=False, things=False)


class Capture:
    """One capture with its truth, described as often as its cameras tell another vertical."""

    def __init__(self, place: str, name: str, gaussians: Gaussians, cameras: Cameras, S_scene_world: Sim3) -> None:
        self.place, self.name, self.gaussians, self.cameras = place, name, gaussians, cameras
        self.S_scene_world = S_scene_world
        self.points = surface_cloud(gaussians).points
        self.graphs: dict[bytes, SceneGraph] = {}
        self.centres = solid_centres(gaussians, S_scene_world)

    def view(self, kind: str, count: int) -> SceneView:
        """The capture with so many of its cameras; without any, with those that gsmap makes when it is added."""
        n = len(self.cameras)
        rows = {
            "all": range(n),
            "spread": np.unique(np.linspace(0, n - 1, count).round().astype(int)),
            "first": range(min(count, n)),
        }
        cameras = synthesise_cameras(self.gaussians) if kind == "none" else self.cameras[list(rows[kind])]
        # By landmarks alone and in metres, a graph depends on cameras through the vertical they tell.
        up = estimate_up(self.points, cameras)
        key = b"" if up is None else up.tobytes()
        if key not in self.graphs:
            name = f"{self.place}-{self.name}"
            self.graphs[key] = describe(name, self.gaussians, cameras, LANDMARKS, scale_policy="known")
        return SceneView(f"{self.place}-{self.name}", self.gaussians, cameras, self.graphs[key], "known")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cameras", default=",".join(KINDS), help="which of " + ", ".join(KINDS))
    parser.add_argument("--count", type=int, default=10, help="how many cameras few are")
    parser.add_argument("--verbose", action="store_true", help="one line per pair")
    options = parser.parse_args()
    captures = [capture for folder in options.folders for capture in read(folder)]
    overlaps = {(a, b): overlap(a, b) for a, b in itertools.combinations(captures, 2)}
    heads = [f"{low:.0%} to {min(high, 1):.0%}" for low, high in BANDS[:-1]] + ["apart"]
    print(f"{'cameras':10s}" + "".join(f"{h:>26s}" for h in heads) + f"{'CPU s':>8s}")
    for kind in options.cameras.split(","):
        views = {c: c.view(kind, options.count) for c in captures}
        answers: Counter[tuple[int, str]] = Counter()
        seconds = []
        for (a, b), share in overlaps.items():
            found, took = timed(register_pair, views[a], views[b])
            seconds.append(took)
            said, text = judged(a, b, found)
            band = next(i for i, (low, high) in enumerate(BANDS) if low <= share < high)
            answers[band, said] += 1
            if options.verbose:
                say(f"{kind:7s}{a.name}-{b.name} {share:.2f} {said}: {text}")
        cells = [
            " ".join(f"{answers[i, said]} {said}" for said in ("right", "wrong", "refused")) for i in range(len(BANDS))
        ]
        print(f"{kind:10s}" + "".join(f"{c:>26s}" for c in cells) + f"{np.median(seconds):8.2f}", flush=True)


def read(folder: Path) -> list[Capture]:
    """The captures of a folder whose truth is known."""
    out = []
    for capture in read_captures(folder):
        truth = folder / "truth" / f"{capture.name}.json"
        if truth.exists():
            S = Sim3.from_matrix(np.array(json.loads(truth.read_text())["T_scene_world"]))
            out.append(Capture(folder.name, capture.name, capture.gaussians, capture.cameras, S))
    return out


def overlap(a: Capture, b: Capture) -> float:
    """The smaller of both directions' share of solid Gaussians within 8 cm of one of the other's."""
    if a.place != b.place:
        return 0.0
    centres = {"a": a.centres, "b": b.centres}
    (share,) = true_overlaps(list(centres), centres.__getitem__).values()
    return share


def judged(a: Capture, b: Capture, found) -> tuple[str, str]:
    """``right`` (within 5 deg and 30 cm), ``wrong`` or ``refused``; and what there is to say."""
    figures = {k: round(v, 3) for k, v in found.evidence.items()}
    if found.status != "accepted":
        return "refused", f"{found.reason} {figures}"
    if a.place != b.place:
        return "wrong", str(figures)
    truth = a.S_scene_world @ b.S_scene_world.inverse()
    error = pose_error(found.S_target_source, truth, scene_centroid(b.gaussians))
    right = error.rre_deg < 5 and error.centroid_m < 0.3
    return "right" if right else "wrong", f"{error.rre_deg:.2f} deg {100 * error.centroid_m:.1f} cm {figures}"


if __name__ == "__main__":
    main()
