"""How well photographs tell what differs from the map: photographs of made places, unchanged and changed, with truth.

    python -m tools.bench.photo_changes PLACES WORK --set fit          # tools/make/localize_places.py made PLACES
    python -m tools.bench.photo_changes PLACES WORK --set test

Of every place, photographs are taken by other lenses from other standpoints: of the place as it was captured (by day in
other exposures, and by night), and of the place with furniture moved, removed, replaced, added and painted. Poses are
the true ones sharpened and judged as localisation does; what it would refuse is left out. Photographs are made once,
in WORK. Said are: boxes in photographs of unchanged places, by light, and of how many changes that a photograph shows
(half a percent of the picture and more, of what can be compared) a fifth of the pixels are in a region. A box is right
where a fifth of it changed. Doors, which captures saw open or shut, are left out.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import gsmap_synthetic as synthetic
from gsmap.errors import ConfigError
from gsmap.formats import read, read_cameras
from gsmap.localize import MapScene, Params
from gsmap.localize.candidates import PoseCandidate
from gsmap.localize.differences import compare_photo, render_capture_views
from gsmap.localize.localization import evaluate_pose, make_placement, scale_photo
from gsmap.types import Cameras, Sim3
from gsmap.types.localization import Photo
from gsmap_synthetic.change import pixel_kinds, sight, states
from gsmap_synthetic.edits import edit_place
from gsmap_synthetic.place import Place
from gsmap_synthetic.script import random_edits
from tools.make.localize_places import PHOTO_PX, SETS, _pose

PHOTOS = 12  # of each kind and place
TRIES, SHOWN = 30, 0.03  # standpoints of the changed place, until one shows so much change
MATCHES = 20  # features that agree on a rough pose, as they would have to be found
SEEN = 0.005  # of the picture: a smaller change is none that must be found
TEXEL_M = 0.012


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--set", choices=SETS, required=True)
    parser.add_argument("--most", type=int, default=3, help="places")
    parser.add_argument("--make", action="store_true", help="the photographs alone")
    parser.add_argument("-v", action="store_true")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    found: dict[str, list[dict]] = {}
    for seed in list(SETS[args.set])[: args.most]:
        path = args.work / f"{seed}.npz"
        if not path.exists():
            began = time.process_time()
            np.savez_compressed(path, **photographs(seed))
            print(f"{seed}: photographs in {time.process_time() - began:.0f} CPU s", flush=True)
        if not args.make:
            for kind, row in measured(args.places / args.set / str(seed), path, args.v):
                found.setdefault(kind, []).append(row)
    for kind, rows in found.items():
        say(kind, rows)
    return 0


def photographs(seed: int) -> dict[str, np.ndarray]:
    """Pictures (N, H, W, 3), truth (N, H, W) of `pixel_kinds` and ids, kinds, poses and intrinsics."""
    twin = bool(np.random.default_rng([seed, 31]).random() < 0.2)  # as make_localize_places draws it
    rng = np.random.default_rng([seed, 47])
    place = synthetic.make_place(seed, rooms=3, twin=twin, texel_m=TEXEL_M)
    night = edit_place(place, light="night")
    changed = place
    with contextlib.suppress(ConfigError):
        edits = random_edits(place, rng, rooms=range(len(place.rooms)), share=0.5)
        changed = edit_place(place, edits)
    then, rooms = states(place), range(len(place.rooms))
    out: dict[str, list] = {name: [] for name in ("rgb", "truth", "ids", "kind", "pose", "lens", "doors")}
    leaves = [thing.id for thing in place.objects if thing.kind == "door"]
    for kind, seen in (("day", place), ("night", night), ("changed", changed)):
        now = states(seen)
        for _ in range(PHOTOS):
            pose, focal = _pose(place, rooms, rng), rng.uniform(0.55, 0.95)
            for _ in range(TRIES if seen is changed else 0):  # somewhere from where a change is seen
                if _shows_change(place, changed, pose, then, now):
                    break
                pose = _pose(place, rooms, rng)
            gain, gamma = rng.uniform(0.6, 1.4) * rng.uniform(0.95, 1.05, 3), rng.uniform(0.85, 1.2)
            frames = synthetic.film(seen, pose[None], size_px=PHOTO_PX, gain=gain, gamma=gamma, focal=focal)
            ids, before = (sight(one, frames.cameras)[0][0] for one in (seen, place))
            truth = pixel_kinds(ids, before, now, then) if seen is changed else np.zeros(ids.shape, np.uint8)
            # What changed, one by one: by the object that is seen now, or was.
            subject = np.where(truth == 3, before, ids)
            out["rgb"].append(frames.images[0])
            out["truth"].append(truth)
            out["ids"].append(np.where(truth > 0, subject, -1).astype(np.int16))
            shut = sight(place, frames.cameras, range(len(place.doors)))[0][0]
            out["doors"].append(np.isin(shut, leaves))
            out["kind"].append(kind)
            out["pose"].append(pose)
            out["lens"].append(frames.cameras.intrinsics_px[0])
    return {name: np.array(values) for name, values in out.items()}


def _shows_change(place: Place, changed: Place, pose: np.ndarray, then: list[dict], now: list[dict]) -> bool:
    """Whether a small picture from a pose shows a change that must be found."""
    small = Cameras(pose[None], np.array([[36.0, 36, 24, 18]]), np.array([[48, 36]]))
    ids, before = (sight(one, small)[0][0] for one in (changed, place))
    return bool((pixel_kinds(ids, before, now, then) > 0).mean() >= SHOWN)


def measured(folder: Path, path: Path, verbose: bool) -> Iterator[tuple[str, dict]]:
    """What is found in each photograph, beside what is true."""
    scenes = [_placed(folder, k) for k in range(2)]
    params = Params()
    eyes = {one.scene: render_capture_views(one, read_cameras(folder / f"{one.scene}.cameras.json")) for one in scenes}
    by_id = {one.scene: one for one in scenes}
    with np.load(path) as told:
        held = {name: told[name] for name in told.files}
    for number, kind in enumerate(held["kind"].tolist()):
        photo = Photo(held["rgb"][number], held["lens"][number], 0.0, f"{kind} {number}")
        picture, scale = scale_photo(photo, params.views.image_size_px)
        rough = PoseCandidate(0, held["pose"][number], picture.intrinsics_px, MATCHES, tuple(by_id))
        judged = evaluate_pose(picture, rough, by_id, params.verdict.aliased_prior)
        where = make_placement(photo.name, judged, 0.0, picture, scale, by_id, params.verdict)
        if not where.is_placed:
            continue
        began = time.process_time()
        support = [by_id[scene] for scene in where.scenes]
        pose = (where.T_map_camera, where.covariance, where.intrinsics_px)
        options = (params.views.image_size_px, params.min_change_fraction)
        found = compare_photo(photo, *pose, support, eyes, *options)
        seconds = time.process_time() - began
        known = ~held["doors"][number]
        truth = (held["truth"][number] > 0) & known
        regions = [one for one in found.regions if known[one.mask].mean() > 0.5]
        boxes = [one.box_px for one in regions]
        right = [truth[int(y0) : int(y1), int(x0) : int(x1)].mean() >= 0.2 for x0, y0, x1, y1 in boxes]
        mask = np.zeros(truth.shape, bool)
        for one in regions:
            mask |= one.mask
        things = []
        ids = held["ids"][number]
        for thing in np.unique(ids[ids >= 0]):
            mine = (ids == thing) & known & found.compared
            if mine.mean() >= SEEN:
                things.append(float(mask[mine].mean()))
        row = {
            "boxes": len(boxes),
            "right": sum(right),
            "things": things,
            "cpu": seconds,
            "judged": found.compared_fraction,
        }
        kinds = [
            (one.kind, int(np.bincount(held["truth"][number][one.mask], minlength=4)[1:].argmax()) + 1)
            for one, fits in zip(regions, right, strict=True)
            if fits
        ]
        row["kinds"] = kinds
        if verbose:
            strengths = [f"{one.kind} {one.strength:.2f} {one.share:.1%}" for one in regions]
            print(
                f"  {photo.name} compared {found.compared_fraction:.0%}: {strengths} right {right}; "
                f"things {np.round(things, 2)}"
            )
        yield kind, row


def _placed(folder: Path, k: int) -> MapScene:
    told = json.loads((folder / "truth" / f"c{k}.json").read_text())
    gaussians = read(folder / f"c{k}.ply")
    S = Sim3.from_matrix(np.array(told["T_scene_world"])).inverse()

    def none() -> object:
        raise AssertionError("features are not needed")

    return MapScene(f"c{k}", S, 0, None, lambda: gaussians, none)  # type: ignore[arg-type]


def say(kind: str, rows: list[dict]) -> None:
    things = np.array([share for row in rows for share in row["things"]])
    boxes, right = sum(row["boxes"] for row in rows), sum(row["right"] for row in rows)
    pure = sum(row["boxes"] > 0 for row in rows)
    print(
        f"{kind}: {len(rows)} photographs, {boxes} boxes in {pure} of them, {right} of them right; "
        f"{int((things > 0.2).sum())} of {len(things)} changes met; {np.mean([r['cpu'] for r in rows]):.2f} CPU s"
    )
    kinds = [pair for row in rows for pair in row["kinds"]]
    if kinds:
        for true, word in ((1, "new"), (2, "recoloured"), (3, "vacated")):
            mine = [k for k, t in kinds if t == true]
            print(f"    {word}: " + ", ".join(f"{mine.count(k)} {k}" for k in sorted(set(mine))))


if __name__ == "__main__":
    sys.exit(main())
