"""Made places, captured as people capture: what the verdict's model is fitted on and tested on.

    python -m tools.make.verdict_places OUT --set fit          # OUT/fit/SEED/ for every place of the set
    python -m tools.make.verdict_places OUT --set test

Of a place: two to four captures, NAME.ply, NAME.cameras.json, truth/NAME.json (`T_scene_world`, and what is wrong with
the capture). Seeds of the two sets are apart, and so are their places. What is made already is not made again.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import gsmap_synthetic as synthetic
from gsmap.errors import ConfigError
from gsmap_synthetic import perturb
from gsmap_synthetic.capture import default_routes, unused_doors
from gsmap_synthetic.court import court_captures
from gsmap_synthetic.edits import edit_place
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from gsmap_synthetic.place import Place
from gsmap_synthetic.plan import make_plan, with_twin
from gsmap_synthetic.script import random_edits
from tools.harness import argument_parser

SETS = {"fit": range(20_000, 20_046), "test": range(30_000, 30_017)}
COURTS = (*range(20_042, 20_046), *range(30_015, 30_017))  # outdoors, with rows of columns that are all alike
SENSED = range(20_032, 20_042)  # places that are filmed with a depth sensor
SIZE_PX = (240, 180)


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", choices=SETS, required=True)
    args = parser.parse_args()
    for seed in SETS[args.set]:
        make(args.out / args.set / str(seed), seed)
    return 0


def make(folder: Path, seed: int) -> None:
    """A place and its captures, each with faults of its own."""
    if (folder / "done").exists():
        return
    began = time.process_time()
    if seed in COURTS:
        captures = court_captures(seed, 5, steps=100, num_gaussians=40_000, size_px=SIZE_PX, vary_exposure=True)
        synthetic.write_captures(folder, captures)
        (folder / "done").touch()
        print(f"{seed}: a court, {len(captures)} captures ({time.process_time() - began:.0f} CPU s)", flush=True)
        return
    rng, rooms, twin = layout(seed)
    place = synthetic.make_place(seed, rooms=rooms, twin=twin, texel_m=0.012)
    told = []
    for k in range(int(rng.integers(2, 5))):
        capture, faults = visit(place, seed, k, rng)
        synthetic.write_captures(folder, [capture])
        path = folder / "truth" / f"{capture.name}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"faults": faults}))
        told.append(f"{capture.name} {' '.join(faults) or 'as it is'}")
    (folder / "done").touch()
    print(f"{seed}: {'; '.join(told)} ({time.process_time() - began:.0f} CPU s)", flush=True)


def layout(seed: int) -> tuple[np.random.Generator, int, bool]:
    """What everything else is drawn from, how many rooms a wing has, and whether there is a second one like it."""
    rng = np.random.default_rng([seed, 21])
    rooms, twin = int(rng.integers(3, 6)), bool(rng.random() < 0.15) and seed not in COURTS
    return rng, 3 if twin else rooms, twin


def twin_m(seed: int) -> float:
    """How far a place's second wing lies beside the first; NaN where there is none."""
    _, rooms, twin = layout(seed)
    if not twin:
        return float("nan")
    plan, doors = make_plan(np.random.default_rng([seed, 1]), rooms)
    wings, _ = with_twin(plan, doors, seed)
    return float(wings[len(plan)].rect_m[0] - plan[0].rect_m[0])


def visit(place: Place, seed: int, k: int, rng: np.random.Generator) -> tuple[synthetic.DemoCapture, dict[str, Any]]:
    """One capture of the place, and what is wrong with it, each fault by its name and size."""
    faults: dict[str, Any] = {}

    def has(name: str, share: float, value: Any) -> bool:
        """Whether the capture has a fault that a share of all captures have; numbers are drawn either way."""
        if rng.random() < share:
            faults[name] = np.asarray(value).round(4).tolist()
            return True
        return False

    doors = default_routes(place, len(place.doors))
    route: tuple[int, ...] = doors[int(rng.integers(len(doors)))]
    if rng.random() < 0.3:
        route = route[:1]
    shut = unused_doors(place, route) if rng.random() < 0.7 else []
    if has("changed", 0.35 if k else 0.0, share := rng.uniform(0.1, 0.8)):
        try:
            place = edit_place(place, random_edits(place, rng, rooms=list(route), share=share), light="day")
        except ConfigError:  # These rooms hold too little to change so much of.
            del faults["changed"]
    steps = int(rng.choice([40, 120, 250]))
    frames = synthetic.film(
        place, synthetic.walk(place, route, int(rng.integers(30, 50)), seed=k), size_px=SIZE_PX, shut=shut, name=f"c{k}"
    )
    if seed in SENSED and has("sensed", 1.0, strength := rng.uniform(0.5, 2.0)):
        frames = perturb.sensed(frames, rng, strength)
    gaussians = fit_frames(frames, steps=steps, num_gaussians=int(rng.integers(15_000, 32_000)), seed=k)
    cameras = frames.cameras
    gain = rng.uniform(0.75, 1.2) * rng.uniform(0.92, 1.08, 3)
    if has("exposure", 0.4, gain):
        gaussians = perturb.tinted(gaussians, gain, rng.uniform(0.85, 1.2))
    if has("haze", 0.15, thickness := rng.uniform(0.01, 0.05)):
        gaussians = perturb.strewn(gaussians, rng, thickness, size_m=0.3, opacity=0.05)
    if has("strays", 0.2, many := rng.uniform(0.01, 0.06)):
        gaussians = perturb.strewn(gaussians, rng, many, size_m=0.03, opacity=0.6)
    if has("sensor", 0.3, (noise_m := rng.uniform(0.003, 0.02), bend_m := rng.uniform(0.003, 0.03))):
        gaussians = perturb.bent(gaussians, rng, noise_m, bend_m)
    if has("cut", 0.3, left := rng.uniform(0.35, 0.8)):
        gaussians, cameras = perturb.cut(gaussians, cameras, rng, left)
    if has("few_cameras", 0.2, count := int(rng.integers(6, 13))):
        cameras = cameras[np.linspace(0, len(cameras) - 1, min(count, len(cameras))).round().astype(int)]
    faults["steps"] = steps
    # The truth is that of the frame that was trained in; cameras and Gaussians move into the capture's own together.
    capture = put_in_own_frame(
        gaussians, replace_cameras(frames, cameras), f"c{k}", np.random.default_rng([seed, k, 8])
    )
    return capture, faults


def replace_cameras(frames: synthetic.Frames, cameras) -> synthetic.Frames:
    """The frames of these cameras alone."""
    rows = [frames.cameras.names.index(name) for name in cameras.names]
    return replace(frames, images=frames.images[rows], cameras=cameras, depths_m=None)


if __name__ == "__main__":
    sys.exit(main())
