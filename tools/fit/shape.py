"""Fit what speaks for and against a pose that was found by shape alone (gsmap/register/by_shape.json).

    python -m tools.fit.shape --cache FOLDER --seeds 600 606 --write

Rooms of made flats, scanned without colours and with the noise of a depth sensor, against captures of the same flat and
of another: every pose that is proposed, with what was measured under it, and whether it is right (3 degrees and 15 cm).
No real scan has a part in it.
"""

from __future__ import annotations

import json
import pickle
import time
from pathlib import Path

import numpy as np

import gsmap.register
from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.rotations import angle_between
from gsmap.localize.scan import as_gaussians
from gsmap.register import Params, SceneView
from gsmap.register.by_shape import _NAMES, PRIOR, evaluate_by_shape, shape_features
from gsmap.types import NodeLayer, SceneGraph
from gsmap.types.scan import Scan
from gsmap_synthetic import DemoCapture, Place, film, make_captures, make_place, walk
from tools.bench.scan import lifted, noisy
from tools.fit.monotone import fit_curves
from tools.harness import argument_parser

_DEG, _M = 3.0, 0.15
_SIZE_PX = (200, 150)
_COUNTS = (8, 3, 1)
_RIDGE = 1e-3

Sample = tuple[np.ndarray, bool]


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(600, 605), metavar=("FIRST", "END"))
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    samples: list[list[Sample]] = []
    before: list[DemoCapture] = []
    for seed in range(*args.seeds):
        path = args.cache / f"shape_{seed}.pickle"
        if not path.exists():
            began = time.process_time()
            place = make_place(seed, rooms=3)
            captures = make_captures(
                seed, 2, place=place, steps=0, num_frames=30, num_gaussians=30_000, size_px=_SIZE_PX
            )
            args.cache.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(of_place(seed, place, captures, before[:1])))
            before = captures
            print(f"{seed}: {time.process_time() - began:.0f} CPU s", flush=True)
        samples.append(pickle.loads(path.read_bytes()))
    x = np.array([row for place in samples for row, _ in place])
    right = np.array([ok for place in samples for _, ok in place])
    print(f"{right.sum()} right, {(~right).sum()} wrong")
    home = np.concatenate([np.full(len(place), k) for k, place in enumerate(samples)])
    held = np.empty(len(x))
    for k in range(len(samples)):
        held[home == k] = odds(x[home == k], *fit_curves(x[home != k], right[home != k], ridge=_RIDGE))
    prior = np.log(PRIOR / (1 - PRIOR))
    given = held + prior > np.log(9)
    print(f"left out in turn: {given[right].mean():.0%} of the right given, {given[~right].sum()} wrong ones")
    knots, worth, base = fit_curves(x, right, ridge=_RIDGE)
    for name, k, w in zip(_NAMES, knots, worth, strict=True):
        print(name, np.round(k, 2).tolist(), np.round(w, 2).tolist())
    if args.write:
        curves = {
            name: {"knots": np.round(k, 4).tolist(), "worth": np.round(w, 4).tolist()}
            for name, k, w in zip(_NAMES, knots, worth, strict=True)
        }
        stored = {"base": round(base, 4), "least": round(1 / len(x), 4), "curves": curves}
        path = Path(gsmap.register.__file__).with_name("by_shape.json")
        path.write_text(json.dumps(stored, indent=1) + "\n")


def odds(x: np.ndarray, knots: list[np.ndarray], worth: list[np.ndarray], base: float) -> np.ndarray:
    """(N,) log-odds."""
    return base + sum((np.interp(c, k, w) for c, k, w in zip(x.T, knots, worth, strict=True)), np.zeros(len(x)))


def of_place(seed: int, place: Place, own: list[DemoCapture], others: list[DemoCapture]) -> list[Sample]:
    """Poses of scans of a flat in captures of it, and in those of another."""
    found: list[Sample] = []
    targets = [(capture, True) for capture in own] + [(capture, False) for capture in others]
    for room in range(len(place.rooms)):
        for count in _COUNTS:
            frames = noisy(film(place, walk(place, (room,), 8, seed=seed + 50)[:count], size_px=_SIZE_PX), seed)
            assert frames.depths_m is not None
            poses = frames.cameras.T_frame_camera
            points = np.concatenate(
                [lifted(frames.depths_m[i], frames.cameras.intrinsics_px[i], poses[i])[0] for i in range(len(frames))]
            )
            gaussians = as_gaussians(Scan(points), 0.02)
            source = view("scan", gaussians, synthesise_cameras(gaussians))
            for capture, same in targets:
                target = view(capture.name, capture.gaussians, capture.cameras)
                for judged in evaluate_by_shape(target, source, Params()):
                    S, T = judged.proposal.S_target_source, capture.T_scene_world
                    middle = source.centre
                    off = float(np.linalg.norm(S.apply(middle) - T[:3, :3] @ middle - T[:3, 3]))
                    turned = float(np.degrees(angle_between(S.rotation, T[:3, :3])))
                    right = same and turned < _DEG and off < _M
                    found.append((shape_features(judged.proposal, judged.evidence), right))
    return found


def view(name: str, gaussians, cameras) -> SceneView:
    """A scene without a graph, in metres."""
    graph = SceneGraph(name, {"landmarks": NodeLayer.empty("none")})
    return SceneView(name, gaussians, cameras, graph, "known")


if __name__ == "__main__":
    main()
