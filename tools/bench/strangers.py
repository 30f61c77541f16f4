"""Whether photographs of other places are placed: none may be.

    python -m tools.bench.strangers PLACES WORK --count 1000   # of made places that the map does not hold
    python -m tools.bench.strangers PLACES WORK --alike 300    # of rooms that look like rooms of the map

PLACES is what ``tools/make/localize_places.py`` made. Strangers are photographed anew (other seeds; other light and
lenses, changed furniture, somebody in the picture) and looked for in one map of all test places. Rooms that look alike
are those of a street (`gsmap_synthetic.streets`): five decorations come again exactly, with their furniture, which
stands elsewhere; the map holds the first five rooms, photographs are of the next ten. Where a photograph shows little
but the decoration it shows the room that the map holds as well, and nothing in it tells: beside each stands what share
of its pixels differ from the same photograph taken there (by more than a tenth of the range).
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import gsmap_synthetic as synthetic
from gsmap.localize import localize_photo
from gsmap.localize.map_scene import MapScene
from gsmap.localize.params import Params
from gsmap.methods import family
from gsmap.types.localization import LocalizationResult, Photo
from gsmap_synthetic.capture import unused_doors
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from gsmap_synthetic.streets import make_street, street_routes
from tools.fit.localize import index_of, load_place, places
from tools.make.localize_places import CAPTURE_PX, PHOTOS, changed_place, photographs, photographs_alike

FIRST_SEED = 70_000  # of places that are strangers to all that is fitted and tested
STREET_SEED, DECORATIONS, ROOMS = 81, 5, 15


class Map:
    """Some scenes, ready to be asked; each place a component of its own."""

    def __init__(self, scenes: list[MapScene], params: Params) -> None:
        self.scenes, self.params = {scene.scene: scene for scene in scenes}, params
        self.index = index_of(scenes, params)
        self.extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])

    def ask(self, image: np.ndarray, intrinsics: list[float], name: str) -> LocalizationResult:
        photo = Photo(image, np.array(intrinsics), 0.0, name)
        return localize_photo(photo, self.index, self.scenes, self.extractor, self.params)


def strangers(count: int) -> Iterator[tuple[np.ndarray, dict, str]]:
    """Photographs of made places, 24 of each."""
    for number in range(-(-count // PHOTOS)):
        seed = FIRST_SEED + number
        place = synthetic.make_place(seed, rooms=3, texel_m=0.008)
        rng = np.random.default_rng([seed, 31])
        changed = changed_place(place, rng)
        of_place = min(PHOTOS, count - number * PHOTOS)
        for k, (image, told) in enumerate(photographs(place, changed, range(len(place.rooms)), of_place, rng)):
            yield image, told, f"{seed} photo {k}"


def all_places(folder: Path, cache: Path, params: Params) -> list[MapScene]:
    """The captures of all test places, each place a component."""
    out = []
    for number, place in enumerate(places(folder, "test", cache, params)):
        out += [replace(scene, component=number) for scene in place.scenes]
    return out


def street(work: Path):
    """A street and where captures of its first rooms are kept."""
    place = make_street(STREET_SEED, rooms=ROOMS, decorations=DECORATIONS, texel_m=0.008)
    folder = work / f"street_{STREET_SEED}"
    if not (folder / "done").exists():
        for k, route in enumerate(street_routes(ROOMS, DECORATIONS - 1)):
            poses = synthetic.walk(place, route, 40, seed=k)
            frames = synthetic.film(place, poses, size_px=CAPTURE_PX, shut=unused_doors(place, route), name=f"c{k}")
            gaussians = fit_frames(frames, steps=250, num_gaussians=60_000, seed=k)
            capture = put_in_own_frame(gaussians, frames, f"c{k}", np.random.default_rng([STREET_SEED, k]))
            synthetic.write_captures(folder, [capture])
        (folder / "done").touch()
    return place, folder


def report(name: str, rows: list[tuple[str, LocalizationResult, float]], seconds: float) -> None:
    """How many were placed, those by name, and how probable the most probable others were."""
    placed = [(who, one, differs) for who, one, differs in rows if one.is_placed]
    refused = sorted((one.probability for _, one, _ in rows if not one.is_placed), reverse=True)
    print(f"{name}: {len(placed)} of {len(rows)} placed; {seconds / len(rows):.2f} CPU s a photo")
    print("  most probable of those refused: " + ", ".join(f"{p:.3f}" for p in refused[:8]))
    for who, one, differs in placed:
        told = "" if np.isnan(differs) else f", {differs:.0%} of its pixels differ"
        print(f"  {who}: placed, probability {one.probability:.3f}{told}")


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--alike", type=int, default=0)
    args = parser.parse_args()
    params, rows = Params(), []
    if args.count:
        held = Map(all_places(args.places, args.work / "features", params), params)
        seconds = 0.0
        for image, told, name in strangers(args.count):
            began = time.process_time()
            rows.append((name, held.ask(image, told["intrinsics"], name), np.nan))
            seconds += time.process_time() - began
            if rows[-1][1].is_placed or len(rows) % 100 == 0:
                print(f"  {len(rows)}: {sum(one.is_placed for _, one, _ in rows)} placed", flush=True)
        report(f"photographs of other places, in a map of {len(held.scenes)} scenes", rows, seconds)
    if args.alike:
        place, folder = street(args.work)
        held, rows, seconds = Map(load_place(folder, args.work / "features", params), params), [], 0.0
        rng = np.random.default_rng(STREET_SEED)
        for k, (image, told, differs) in enumerate(photographs_alike(place, DECORATIONS, args.alike, rng)):
            said, took = timed(held.ask, image, told["intrinsics"], f"photo {k}")
            seconds += took
            rows.append((f"photo {k}", said, differs))
        share = np.array([differs for _, _, differs in rows])
        for low, high in ((0, 0.05), (0.05, 0.15), (0.15, 0.3), (0.3, 1.01)):
            those = [one for one, s in zip(rows, share, strict=True) if low <= s < high]
            wrong = sum(one.is_placed for _, one, _ in those)
            told = f"{low:.0%} to {min(high, 1):.0%} of the pixels differ from the room of the map"
            print(f"  {told}: {len(those)} photographs, {wrong} placed there")
        report("photographs of rooms that look like those of the map", rows, seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
