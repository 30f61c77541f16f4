"""How many frames of a clip are placed, each alone and all together.

    python -m tools.bench.clips PLACES WORK                  # clips of ten frames through made places
    python -m tools.bench.clips PLACES WORK --house DATA     # and the house's photographs, ten of one capture at a time
    python -m tools.bench.clips PLACES WORK --focal-unknown  # nothing is said of the lens
    python -m tools.bench.clips PLACES WORK --alike          # clips of rooms that look like those of the map instead

PLACES is what ``tools/make/localize_places.py`` made; clips are of its places for testing. Somebody walks with a phone
through two rooms in other light, one frame every half second (a step, and some twelve degrees of turn); the place is as
its captures show it. Truth is exact. A frame's coverage is the share of its pixels whose surface a capture shows where
it is (5 cm and 2 % of the depth), as ``tools/bench/localize.py`` has it. The house's photographs are every sixth frame
of a capture, in the map of the others: farther apart than a clip's frames. Rooms that look alike are those of streets
whose decorations come again, with their furniture elsewhere; a map holds the first three rooms of each, and of a clip
through the others no frame may be placed. Clips through the map's own rooms stand beside them.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gsmap_synthetic as synthetic
from gsmap.localize import localize_photo, localize_together
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.params import Params
from gsmap.methods import family
from gsmap.types.localization import LocalizationResult, Photo
from gsmap_synthetic.capture import default_routes
from gsmap_synthetic.streets import make_street
from tools.bench.localize import World, house_shots, unknown_focal, world
from tools.fit.localize import WRONG_DEG, WRONG_M, Place, camera_error, index_of, places
from tools.make.localize_places import DECORATIONS, TIMES, made_place

FRAMES, STEPS, CLIPS = 10, 120, 4
CLOSE_DEG, CLOSE_M = 1.0, 0.05


@dataclass(eq=False)
class Frame:
    """A frame of a clip: its photo, where it was taken (camera to component), and how much of it the map covers."""

    photo: Photo
    T_metric_camera: np.ndarray
    coverage: float


@dataclass
class Answer:
    """What was said of a frame.

    Args:
        deg, metres: its error; NaN of what was refused.
        nees: normalised squared error by the covariance, of six degrees of freedom.
    """

    coverage: float
    deg: float = np.nan
    metres: float = np.nan
    nees: float = np.nan

    @property
    def placed(self) -> bool:
        return bool(np.isfinite(self.deg))

    def within(self, deg: float, metres: float) -> bool:
        return self.placed and self.deg < deg and self.metres < metres


def made_clips(place: Place, params: Params) -> Iterator[list[Frame]]:
    """Clips through a made place."""
    rng = np.random.default_rng([int(place.seed), 77])
    real = made_place(int(place.seed))
    for number in range(CLIPS):
        route = default_routes(real, 2)[number % 2]
        poses = synthetic.walk(real, route, STEPS, seed=50 + number)
        start = int(rng.integers(0, len(poses) - FRAMES))
        poses = poses[start : start + FRAMES]
        shot = synthetic.film(
            real,
            poses,
            size_px=(480, 360),
            focal=rng.uniform(0.6, 0.85),
            gain=rng.uniform(0.7, 1.3) * rng.uniform(0.95, 1.05, 3),
            gamma=rng.uniform(0.9, 1.15),
        )
        assert shot.depths_m is not None
        frames = []
        for k, pose in enumerate(poses):
            intrinsics = shot.cameras.intrinsics_px[k]
            photo = Photo(shot.images[k], intrinsics, 0.0, f"{place.seed} clip {number} frame {k}")
            coarse = shot.depths_m[k][2::4, 2::4]
            size = (coarse.shape[1], coarse.shape[0])
            has = np.zeros(coarse.shape, bool)
            for one in render_scenes(place.scenes, pose, intrinsics / 4, size):
                has |= (one.alpha > 0.9) & (np.abs(one.depth_m - coarse) < 0.05 + 0.02 * coarse)
            frames.append(Frame(photo, pose, float(has.mean())))
        yield frames


def street_clips(place: Place) -> Iterator[tuple[str, list[Frame]]]:
    """Clips through the rooms of a street that a map holds (``own``), and through those that look alike (``alike``)."""
    seed = int(place.seed)
    real = make_street(seed, rooms=DECORATIONS * TIMES, decorations=DECORATIONS, texel_m=0.008)
    own = [(a, a + 1) for a in range(DECORATIONS - 1)]
    alike = [(a, a + 1) for a in range(DECORATIONS, DECORATIONS * TIMES - 1, DECORATIONS)]
    for kind, routes in (("own", own), ("alike", alike)):
        for route in routes:
            rng = np.random.default_rng([seed, route[0]])
            poses = synthetic.walk(real, route, 60, seed=77)[10 : 10 + 4 * FRAMES : 4]
            shot = synthetic.film(real, poses, size_px=(480, 360), focal=0.7, gain=rng.uniform(0.8, 1.2))
            name = f"{seed} rooms {route[0]} and {route[1]}"
            photos = (Photo(shot.images[k], shot.cameras.intrinsics_px[k], 0.0, f"{name} {k}") for k in range(FRAMES))
            yield kind, [Frame(photo, pose, 1.0) for photo, pose in zip(photos, poses, strict=True)]


def house_clips(data: Path, held: World) -> Iterator[tuple[list[Frame], set[str]]]:
    """Ten photographs of one capture, and the scenes of the others; each photograph in one clip at the least."""
    for name in ("c0", "c1", "c2", "c3"):
        shots = list(house_shots(data, held, [name]))
        for first in (0, len(shots) - FRAMES):
            frames = []
            for shot in shots[first : first + FRAMES]:
                frames.append(Frame(shot.photo, shot.T_world_camera, shot.coverage))
            yield frames, shots[0].allowed


def answer(frame: Frame, said: LocalizationResult, truth: np.ndarray, metres_per_unit: float) -> Answer:
    if said.T_map_camera is None:
        return Answer(frame.coverage)
    xi = camera_error(said.T_map_camera, truth)
    deg, metres = float(np.degrees(np.linalg.norm(xi[:3]))), float(np.linalg.norm(xi[3:]) * metres_per_unit)
    return Answer(frame.coverage, deg, metres, float(xi @ np.linalg.solve(said.covariance, xi)))


def say(name: str, answers: Sequence[Answer], seconds: float) -> None:
    """One line: recall of the frames that are covered by a fifth, wrong ones, errors, covariance, cost."""
    told = [one for one in answers if one.coverage >= 0.2]
    placed = [one for one in answers if one.placed]
    wrong = sum(one.deg > WRONG_DEG or one.metres > WRONG_M for one in placed)
    close = sum(one.within(CLOSE_DEG, CLOSE_M) for one in told)
    right = sum(one.within(WRONG_DEG, WRONG_M) for one in told)
    middle = np.median([(one.deg, 100 * one.metres) for one in placed] or [(np.nan, np.nan)], axis=0)
    nees = np.quantile([one.nees for one in placed] or [np.nan], (0.5, 0.9)) / np.array([5.35, 10.6])
    print(
        f"{name}: {right} of {len(told)} frames covered by 20 % placed right ({right / max(len(told), 1):.1%}), "
        f"{close} within {CLOSE_DEG:g} deg and {100 * CLOSE_M:g} cm; {wrong} of {len(placed)} wrong; "
        f"median {middle[0]:.2f} deg {middle[1]:.1f} cm; NEES by its expectation {nees[0]:.2f}, 90 % {nees[1]:.2f}; "
        f"{seconds / max(len(answers), 1):.2f} CPU s a frame",
        flush=True,
    )


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--set", default="test", choices=("fit", "test"))
    parser.add_argument("--house", type=Path, metavar="DATA")
    parser.add_argument("--alike", action="store_true")
    parser.add_argument("--focal-unknown", action="store_true")
    parser.add_argument("-v", action="store_true")
    args = parser.parse_args()
    params = Params()
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    said: dict[str, list[Answer]] = {"alone": [], "together": []}
    seconds = dict.fromkeys(said, 0.0)

    def ask(frames, truth_of, *options):
        for name in said:
            began = time.process_time()
            photos = [unknown_focal(frame.photo) if args.focal_unknown else frame.photo for frame in frames]
            if name == "alone":
                found = [localize_photo(photo, *options) for photo in photos]
            else:
                found = localize_together(photos, *options)
            seconds[name] += time.process_time() - began
            for frame, one in zip(frames, found, strict=True):
                said[name].append(answer(frame, one, *truth_of(frame, one)))
                if args.v and name == "together":
                    last = said[name][-1]
                    error = f"{last.deg:.2f} deg {100 * last.metres:.1f} cm NEES {last.nees:.1f}"
                    told = error if last.placed else one.reason
                    print(f"  {frame.photo.name} covered {frame.coverage:.0%}: {told}", flush=True)

    if args.alike:
        told: dict[tuple[str, str], list[Answer]] = {}
        for place in places(args.places, f"{args.set}_streets", args.work / "features", params):
            scenes = {scene.scene: scene for scene in place.scenes}
            index = index_of(place.scenes, params)
            for kind, frames in street_clips(place):
                before = {name: len(answers) for name, answers in said.items()}
                ask(frames, lambda frame, one: (frame.T_metric_camera, 1.0), index, scenes, extractor, params)
                for name, answers in said.items():
                    told.setdefault((kind, name), []).extend(answers[before[name] :])
        for name in said:
            own, alike = told["own", name], [one.placed for one in told["alike", name]]
            right = sum(one.within(WRONG_DEG, WRONG_M) for one in own)
            print(
                f"clips through a street, {name}: {right} of {len(own)} frames placed right in the map's own rooms, "
                f"{sum(one.placed for one in own) - right} wrong; of rooms that look alike {sum(alike)} "
                f"of {len(alike)} placed",
                flush=True,
            )
        return 0
    for place in places(args.places, args.set, args.work / "features", params):
        scenes = {scene.scene: scene for scene in place.scenes}
        index = index_of(place.scenes, params)
        for frames in made_clips(place, params):
            ask(frames, lambda frame, one: (frame.T_metric_camera, 1.0), index, scenes, extractor, params)
    for name, answers in said.items():
        say(f"made clips, {name}", answers, seconds[name])
    if args.house:
        said, seconds = {name: [] for name in said}, dict.fromkeys(said, 0.0)
        held = world(args.house / "house", args.work, ["c0", "c1", "c2", "c3", "c5"])
        here = held.localizer

        def truth_of(frame, one):
            if not one.is_placed:
                return np.eye(4), 1.0
            return held.truth_of(frame.T_metric_camera, one.scenes[0]), here.metres.get(one.component, 1.0)

        for frames, allowed in house_clips(args.house / "house", held):
            ask(frames, truth_of, here.index.only(allowed), here.placed, here.extractor, here.params, here.metres)
        for name, answers in said.items():
            say(f"ten photographs of the house, {name}", answers, seconds[name])
    return 0


if __name__ == "__main__":
    sys.exit(main())
