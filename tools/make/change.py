"""Made places that change: captures years apart, with exact truth about what changed.

    python -m tools.make.change OUT --set dev            # OUT/SEED/ for every place of the set
    python -m tools.make.change OUT --seed 101           # one place: t0, then t1 after --edits
    python -m tools.make.change OUT --seed 9 --times 3 --edits share:0.3 --light night

Of a place: NAME.ply and NAME.cameras.json of every capture in a frame of its own, NAME.json (`captured_at`),
frames/CAMERA.jpg; and as truth, truth/NAME.json (`T_scene_world`, `held_out` cameras, `shut` doors, `route`, `objects`
with their states), truth/changes.json (`pairs`: what changed from each time to each later one, see
`gsmap_synthetic.change.true_changes`) and truth/masks/CAMERA.npz (`ids_TIME` and `depth_mm_TIME`: what that camera
would see at every time). Everything in truth but `T_scene_world` is in the place's frame, in metres.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

import gsmap_synthetic as synthetic
from gsmap.errors import ConfigError, GsmapError
from gsmap_synthetic.capture import Frames, default_routes, unused_doors
from gsmap_synthetic.change import sight, states, true_changes
from gsmap_synthetic.edits import edit_place
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from gsmap_synthetic.script import random_edits
from tools.harness import argument_parser, say

HOLD_OUT = 6


@dataclass(frozen=True)
class Visit:
    """One capture of a place.

    Args:
        edits: what happened since the visit before: "none", "default" (every kind), "share:0.3", or counts such as
            "moved:3,small:1".
        light, exposure: by day or night; with an exposure and white balance of its own.
        route: which of the place's default routes is walked.
        steps: number of training steps, in place of ``--steps``; few leave the capture unconverged.
        frames: number of photos, in place of ``--frames``; few leave much of the place to a view or two.
        blur_px: standard deviation in pixels by which the photos are blurred before training.
    """

    name: str
    edits: str = "none"
    light: str = "day"
    exposure: bool = False
    route: int = 0
    steps: int | None = None
    frames: int | None = None
    blur_px: float = 0.0


_T0, _T1 = Visit("t0"), Visit("t1", "default")
_FALSE = (_T0, Visit("e1", exposure=True), Visit("n1", light="night"), Visit("s1"))
_QUALITY = (
    _T0,
    Visit("u1", steps=60),
    Visit("b1", blur_px=2.0),
    Visit("f1", frames=16),
    Visit("u2", steps=150, route=1),
)
_POOR = (Visit("t0", steps=100), _T1), (_T0, replace(_T1, blur_px=1.5)), (_T0, replace(_T1, frames=20))
SETS: dict[str, dict[int, tuple[Visit, ...]]] = {
    # Constants may be chosen on these ...
    "dev": {
        101: (_T0, _T1, Visit("t2", "moved:2,removed:1,added:1,small:1", route=1)),
        202: (_T0, _T1),
        303: (_T0, replace(_T1, exposure=True)),
        313: (_T0, replace(_T1, exposure=True)),
        323: (_T0, replace(_T1, exposure=True)),
    },
    "dev-small": {seed: (_T0, Visit("t1", "small:5,replaced:3,moved:2")) for seed in range(6001, 6007)},
    "dev-false": {111: _FALSE, 121: _FALSE, 131: _FALSE},
    # ... those that differ in training, sharpness and number of photos: the same place, and one that changed ...
    "dev-quality": {141: _QUALITY, 151: _QUALITY, 161: _POOR[0], 171: _POOR[1], 181: _POOR[2]},
    # ... and on these since their scores were looked at one by one ...
    "seen": {
        404: (_T0, _T1, Visit("t2", "moved:3,removed:1,added:1,small:1", route=1)),
        505: (_T0, _T1),
        606: (_T0, replace(_T1, exposure=True)),
        2404: (_T0, _T1),
        2505: (_T0, _T1),
        2606: (_T0, replace(_T1, exposure=True)),
        2707: (_T0, _T1),
    },
    # ... and never on these. Of the pairs in "false" count those with t0: ten, and nothing changed in any.
    "test": {
        3131: (_T0, _T1),
        3232: (_T0, _T1),
        3333: (_T0, replace(_T1, exposure=True)),
        **dict.fromkeys((4141, 4242, 4343, 4444, 4545, 4646), (_T0, _T1)),
    },
    "false": {707: _FALSE, 808: _FALSE, 909: _FALSE, 1010: (_T0, replace(_FALSE[1], name="e1"))},
    "test-quality": {1111: _QUALITY, 1212: _QUALITY, 1313: _POOR[0], 1414: _POOR[1]},
}


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", choices=SETS, help="all places of a set, each in OUT/SEED")
    parser.add_argument("--seed", type=int, help="one place, in OUT itself")
    parser.add_argument("--times", type=int, default=2, help="visits of a place that no set has")
    parser.add_argument("--edits", default="default", help="between them: none, default, share:F, or KIND:N,...")
    parser.add_argument("--light", default="day", choices=("day", "night"), help="of its later visits")
    parser.add_argument("--exposure", action="store_true", help="its later visits have an exposure of their own")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--frames", type=int, default=54, help="per visit")
    parser.add_argument("--gaussians", type=int, default=40_000, help="per visit")
    parser.add_argument("--size", type=int, default=320, help="longer side of the pictures, pixels")
    parser.add_argument("--texel", type=float, default=0.008, help="edge of a texel of the place, metres")
    args = parser.parse_args()
    if (args.set is None) == (args.seed is None):
        parser.error("give either --set or --seed")
    try:
        if args.set:
            for seed, visits in SETS[args.set].items():
                make(args.out / str(seed), seed, visits, args)
        else:
            known = {seed: visits for places in SETS.values() for seed, visits in places.items()}
            later = [Visit(f"t{k}", args.edits, args.light, args.exposure) for k in range(1, args.times)]
            make(args.out, args.seed, known.get(args.seed, (_T0, *later)), args)
    except GsmapError as error:
        say(f"make_change: {error}")
        return 1
    return 0


def make(out: Path, seed: int, visits: tuple[Visit, ...], args: argparse.Namespace) -> None:
    """Build a place, visit it, and write the captures and the truth."""
    place = synthetic.make_place(seed, texel_m=args.texel)
    routes = default_routes(place, 3)
    places, shuts, films, walked = {}, {}, {}, set()
    for k, visit in enumerate(visits):
        began = time.process_time()
        rng = np.random.default_rng([seed, k, 9])
        route = routes[visit.route]
        known = [room for room in route if room in walked] or route  # What nobody saw before cannot be told to change.
        edits = random_edits(place, rng, rooms=known, **asked(visit.edits)) if visit.edits != "none" else []
        if k:
            place = edit_place(place, edits, light=visit.light)
        exposure = {}
        if visit.exposure:
            exposure = {"gain": rng.uniform(0.75, 1.2) * rng.uniform(0.93, 1.07, 3), "gamma": rng.uniform(0.9, 1.15)}
        shut = unused_doors(place, route)
        poses = synthetic.walk(place, route, visit.frames or args.frames, seed=k)
        size_px = (args.size, args.size * 3 // 4)
        frames = synthetic.film(place, poses, size_px=size_px, shut=shut, name=visit.name, **exposure)
        shown = synthetic.shown(len(frames), HOLD_OUT)
        steps = args.steps if visit.steps is None else visit.steps
        gaussians = fit_frames(
            _blurred(frames[shown], visit.blur_px), steps=steps, num_gaussians=args.gaussians, seed=k
        )
        capture = put_in_own_frame(gaussians, frames, visit.name, np.random.default_rng([seed, k, 8]))
        synthetic.write_captures(out, [capture], images=True)
        dated = f"{min(2022, 2026 - len(visits)) + k}-05-14T10:00:00+00:00"
        (out / f"{visit.name}.json").write_text(json.dumps({"captured_at": dated}))
        truth = {
            "T_scene_world": capture.T_scene_world.tolist(),
            "held_out": [name for name, kept in zip(frames.cameras.names, shown, strict=True) if not kept],
            "captured_at": dated,
            "route": [int(room) for room in route],
            "shut": shut,
            "light": visit.light,
            "exposure": {key: np.asarray(value).tolist() for key, value in exposure.items()},
            "edits": [str(edit) for edit in edits],
            "objects": states(place, shut),
        }
        (out / "truth" / f"{visit.name}.json").write_text(json.dumps(truth, indent=1))
        places[visit.name], shuts[visit.name], films[visit.name] = place, shut, frames.cameras
        walked |= set(route)
        print(f"{seed} {visit.name}: {len(gaussians)} Gaussians, {time.process_time() - began:.0f} CPU s", flush=True)
    _write_truth(out, places, shuts, films)


def _blurred(frames: Frames, sigma_px: float) -> Frames:
    """Blur the photos, as motion or defocus does."""
    if not sigma_px:
        return frames
    return replace(frames, images=gaussian_filter(frames.images, (0, sigma_px, sigma_px, 0)))


def asked(edits: str) -> dict:
    """Arguments of `random_edits` for what a `Visit` names.

    Raises:
        ConfigError: not one of the forms.
    """
    if edits == "default":
        return {}
    try:
        pairs = {kind: float(number) for kind, number in (part.split(":") for part in edits.split(","))}
    except ValueError as error:
        raise ConfigError(f"edits are none, default, share:F or KIND:N,..., got {edits!r}") from error
    if "share" in pairs:
        return {"share": pairs["share"]}
    return {"counts": {kind: int(number) for kind, number in pairs.items()}}


def _write_truth(out: Path, places: dict, shuts: dict, films: dict) -> None:
    times = list(places)
    at = {name: states(places[name], shuts[name]) for name in times}
    pairs = {f"{a}:{b}": true_changes(at[a], at[b]) for i, a in enumerate(times) for b in times[i + 1 :]}
    (out / "truth" / "changes.json").write_text(json.dumps({"times": times, "pairs": pairs}, indent=1))
    (out / "truth" / "masks").mkdir(exist_ok=True)
    for cameras in films.values():
        seen = {name: sight(places[name], cameras, shuts[name]) for name in times}
        for i, camera in enumerate(cameras.names):
            arrays = {f"ids_{name}": ids[i] for name, (ids, _) in seen.items()}
            arrays |= {f"depth_mm_{name}": np.round(1000 * m[i]).astype(np.uint16) for name, (_, m) in seen.items()}
            np.savez_compressed(out / "truth" / "masks" / f"{camera}.npz", **arrays)


if __name__ == "__main__":
    sys.exit(main())
