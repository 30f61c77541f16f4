"""How well photographs of made places find the views that show the same, alone and among a thousand scenes.

    python -m tools.make.localize_places PLACES --set fit && python -m tools.make.localize_places PLACES --set test
    python -m tools.bench.views PLACES --cache FOLDER [--scenes 1000]

Photographs are of the test places, which had no part in fitting; the crowd is made of the captures that words were
fitted on (see `bench_localize.Others`). A view is right as far as its matches agree with the truth; a photograph that
has 8 right ones in one view, or 12 in all, can be found, and it is where the first 24 views hold as many.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap.localize import index_recipe, new_segment, resection, view_index
from gsmap.localize.features import quantize, quantize_angles
from gsmap.localize.localization import SMOOTH_PX, extract_features, scale_photo
from gsmap.localize.matching import FeatureSet, match_features
from gsmap.localize.params import Params
from gsmap.localize.retrieval import ViewIndex, retrieve_views
from gsmap.localize.vocabulary import load_vocabulary
from gsmap.methods import family
from gsmap.types.segments import Segment, merged
from tools.bench.localize import Others
from tools.fit.localize import Place, places

IN_ONE, IN_ALL = 8, 12


class Asked:
    """A photograph, and how many right matches it has with each view of its place."""

    def __init__(self, place: Place, told: dict, params: Params, extractor) -> None:
        self.picture, _ = scale_photo(place.photo(told), params.views.image_size_px)
        self.found = extract_features(self.picture, extractor, SMOOTH_PX)
        self.right: dict[tuple[str, int], int] = {}
        mine, truth = (
            FeatureSet(quantize(self.found.descriptors), quantize_angles(self.found)),
            np.array(told["T_world_camera"]),
        )
        for scene in place.scenes:
            held = scene.features
            for view, (a, b) in enumerate(zip(held.starts[:-1], held.starts[1:], strict=True)):
                rows, columns = match_features(mine, FeatureSet(held.descriptors[a:b], held.angles[a:b]))
                points = scene.S_metric_scene.apply(held.points[a:b][columns])
                picture = (self.picture.intrinsics_px, self.picture.size_px)
                agree = resection.find_inliers(self.found.pixels[rows], points, truth, *picture)
                self.right[scene.scene, view] = int(agree.sum())

    def has(self, views: list[tuple[str, int]]) -> bool:
        counts = [self.right.get(view, 0) for view in views]
        return max(counts, default=0) >= IN_ONE or sum(counts) >= IN_ALL


def crowd(made: list[Place], num_scenes: int, params: Params) -> Segment:
    """A segment of so many scenes that show something else."""
    rng = np.random.default_rng(7)
    kept = [scene.features for place in made for scene in place.scenes]
    others = Others(
        load_vocabulary(kept[0].descriptors.shape[1]), np.concatenate([found.descriptors for found in kept])
    )
    parts = []
    for start in range(0, num_scenes, 64):
        there = []
        for number in range(start, min(start + 64, num_scenes)):
            found = kept[number % len(kept)]
            found = found if number < len(kept) else others.like(found, rng)
            there.append((replace(found, scene=f"{number:032x}"), "0" * 32))
        parts.append(new_segment(there))
    return merged(parts)


def say(name: str, asked: list[tuple[Asked, ViewIndex]], params: Params) -> None:
    """One line: scenes and views that were found, and what it costs."""
    first, good, seconds = [], 0, []
    for one, index in asked:
        views, took = timed(retrieve_views, index, one.found, one.picture.intrinsics_px, params.max_views)
        seconds.append(took)
        own = {scene for scene, _ in one.right}
        scenes = list(dict.fromkeys(scene for scene, _ in views))
        first.append(next((k for k, scene in enumerate(scenes) if scene in own), len(scenes) + 99))
        good += one.has(views)
    ranks = ", ".join(f"{sum(rank < k for rank in first)} in {k}" for k in (1, 3, 6))
    print(
        f"{name}: of {len(asked)} photographs that can be found {good} have right views among the first "
        f"{params.max_views}; right scene first {ranks}; {np.median(seconds):.2f} CPU s each (median)",
        flush=True,
    )


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--only", nargs="+", help="photographs of these test places (seeds) alone")
    parser.add_argument("--scenes", type=int, nargs="*", default=[100, 1000])
    args = parser.parse_args()
    params = Params()
    extractor = family("extractor").get("sift").make({}, params.extractors["sift"])
    test, fitted = (places(args.places, split, args.cache, params) for split in ("test", "fit"))
    shots: list[tuple[Asked, Segment]] = []
    for place in [place for place in test if args.only is None or place.seed in args.only]:
        own = new_segment([(scene.features, "0" * 32) for scene in place.scenes])
        made = [Asked(place, told, params, extractor) for told in place.photos]
        shots += [(one, own) for one in made if one.has(list(one.right))]
    say("in its own place alone", [(one, view_index([own])) for one, own in shots], params)
    for count in args.scenes:
        with tempfile.TemporaryDirectory() as folder:
            store = gsmap.map.create(Path(folder) / "crowd.gsmap").store
            whole = crowd(fitted, count, params)
            store.indexes.save_segment(index_recipe(), [m for m in whole.members if m is not None], whole.arrays, ())
            (stored,) = store.indexes.segments(index_recipe())
            size = store.arrays.size_bytes("indexes", stored.id) / 1e6
            print(f"{count} scenes: {stored.num_nodes} features, {size:.0f} MB on the disk")
            say(f"among {count} scenes", [(one, view_index([own, stored])) for one, own in shots], params)
    return 0


if __name__ == "__main__":
    sys.exit(main())
