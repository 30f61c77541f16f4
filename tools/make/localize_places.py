"""Made places with photographs: what localisation's model is fitted on and tested on.

    python -m tools.make.localize_places OUT --set fit          # OUT/fit/SEED/ for every place of the set
    python -m tools.make.localize_places OUT --set test

Of a place: captures (NAME.ply, NAME.cameras.json, truth/NAME.json with ``T_scene_world``), photos/NAME.jpg taken at
other times by other lenses from other standpoints, and photos.json with the truth of each. Seeds of the two sets are
apart, and so are their places. What is made already is not made again.

Beside them, in OUT/fit_streets and OUT/test_streets, streets whose decorations come again exactly, with their
furniture standing elsewhere (`gsmap_synthetic.streets`): captures are of the first room of each decoration, and so are
some photographs; the others are of later rooms, which look alike and are not in the map. Of those ``differs`` says what
share of the pixels differs (by more than a tenth of the range) from the same photograph taken in the room of the map.

In OUT/fit_courts and OUT/test_courts, courts under a sky (`gsmap_synthetic.court`), with captures of 20 to 45
photographs each that are trained from sparse points, as those of a person with a camera are.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import gsmap_synthetic as synthetic
from gsmap.errors import ConfigError
from gsmap_synthetic import perturb
from gsmap_synthetic.capture import default_routes, look_along, unused_doors
from gsmap_synthetic.court import cloudy, make_court, stroll
from gsmap_synthetic.edits import edit_place
from gsmap_synthetic.initialise import from_features
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from gsmap_synthetic.place import Place
from gsmap_synthetic.script import random_edits
from gsmap_synthetic.streets import make_street, street_routes
from gsmap_synthetic.train import Params as TrainParams
from gsmap_synthetic.train import train
from tools.harness import argument_parser

SETS = {"fit": range(50_000, 50_012), "test": range(60_000, 60_006)}
STREETS = {"fit": range(50_100, 50_108), "test": range(60_100, 60_104)}
COURTS = {"fit": range(50_200, 50_206), "test": range(60_200, 60_204)}
CAPTURE_PX, PHOTO_PX = (400, 300), (480, 360)
SPARSE_POINTS, SPARSE_TRAINING = 8000, TrainParams(steps=400, splits=5, split_share=0.4)  # of captures of courts
PHOTOS = 24
DECORATIONS, TIMES = 3, 4  # of a street, and how often each comes
PHOTOS_OF_MAP, PHOTOS_ALIKE = 24, 36
DIFFERS = 0.1


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", choices=SETS, required=True)
    parser.add_argument("--only", type=int)
    args = parser.parse_args()
    for seed in SETS[args.set]:
        if args.only in (None, seed):
            make(args.out / args.set / str(seed), seed)
    for seed in STREETS[args.set]:
        if args.only in (None, seed):
            make_alike(args.out / f"{args.set}_streets" / str(seed), seed)
    for seed in COURTS[args.set]:
        if args.only in (None, seed):
            make_outdoors(args.out / f"{args.set}_courts" / str(seed), seed)
    return 0


def make_outdoors(folder: Path, seed: int) -> None:
    """A court, two captures of a part of it from few photographs, and photographs from elsewhere in that part."""
    if (folder / "done").exists():
        return
    began = time.process_time()
    rng = np.random.default_rng([seed, 31])
    place, sky = make_court(seed), cloudy(seed)
    middle, apart = rng.uniform(16.0, 48.0), rng.uniform(1.0, 6.0)
    for k in range(2):
        count = int(rng.integers(20, 46))
        poses = stroll(place, middle + (k - 0.5) * apart, count, k)
        light = {"gain": rng.uniform(0.8, 1.15), "gamma": rng.uniform(0.9, 1.15)}
        frames = synthetic.film(place, poses, size_px=PHOTO_PX, sky=sky, name=f"c{k}", **light)
        gaussians = train(from_features(frames, SPARSE_POINTS, seed=k), frames, SPARSE_TRAINING, seed=k)
        capture = put_in_own_frame(gaussians, frames, f"c{k}", np.random.default_rng([seed, k, 8]))
        synthetic.write_captures(folder, [capture])
    (folder / "photos").mkdir(exist_ok=True)
    told = []
    for i in range(PHOTOS):
        pose = stroll(place, middle + rng.uniform(-4, 4), 200, 100 + i)[int(rng.integers(200))]
        pose[:2, 3] += rng.normal(size=2)
        focal, gain, gamma = rng.uniform(0.55, 0.95), rng.uniform(0.7, 1.3), rng.uniform(0.85, 1.2)
        shot = synthetic.film(place, pose[None], size_px=PHOTO_PX, gain=gain, gamma=gamma, focal=focal, sky=sky)
        Image.fromarray(shot.images[0]).save(folder / "photos" / f"p{i:03d}.jpg", quality=88)
        told.append(
            {
                "file": f"p{i:03d}.jpg",
                "T_world_camera": pose.tolist(),
                "intrinsics": shot.cameras.intrinsics_px[0].tolist(),
                "gain": gain,
                "changed": False,
                "occluded": 0.0,
            }
        )
    (folder / "photos.json").write_text(json.dumps(told))
    (folder / "done").touch()
    print(f"{seed}: a court, {time.process_time() - began:.0f} CPU s", flush=True)


def make(folder: Path, seed: int) -> None:
    """A place, its captures, each with faults of its own, and photographs of it."""
    if (folder / "done").exists():
        return
    began = time.process_time()
    rng, twin = drawn(seed)
    place = made_place(seed)
    routes = default_routes(place, 2)
    for k, route in enumerate(routes):
        synthetic.write_captures(folder, [_capture(place, route, k, seed, rng)])
    _photograph(place, folder, rng)
    write_differences(place, folder, routes, len(place.rooms))
    (folder / "done").touch()
    print(f"{seed}: {'a twin, ' if twin else ''}{time.process_time() - began:.0f} CPU s", flush=True)


def make_alike(folder: Path, seed: int) -> None:
    """A street, captures of its first rooms, photographs of these and of the rooms that look like them."""
    if (folder / "done").exists():
        return
    began = time.process_time()
    rng = np.random.default_rng([seed, 31])
    place = make_street(seed, rooms=DECORATIONS * TIMES, decorations=DECORATIONS, texel_m=0.008)
    routes = street_routes(DECORATIONS)
    for k, route in enumerate(routes):
        synthetic.write_captures(folder, [_capture(place, route, k, seed, rng)])
    (folder / "photos").mkdir(exist_ok=True)
    changed, told = changed_place(place, rng), []
    shots = [({}, shot) for shot in photographs(place, changed, range(DECORATIONS), PHOTOS_OF_MAP, rng)]
    shots += [
        ({"differs": differs}, (image, said))
        for image, said, differs in photographs_alike(place, DECORATIONS, PHOTOS_ALIKE, rng)
    ]
    for i, (more, (image, said)) in enumerate(shots):
        Image.fromarray(image).save(folder / "photos" / f"p{i:03d}.jpg", quality=88)
        told.append({"file": f"p{i:03d}.jpg", **said, **more})
    (folder / "photos.json").write_text(json.dumps(told))
    write_differences(place, folder, routes, DECORATIONS)
    (folder / "done").touch()
    print(f"{seed}: a street, {time.process_time() - began:.0f} CPU s", flush=True)


def photographs_alike(
    place: Place, decorations: int, count: int, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, dict[str, Any], float]]:
    """Photographs of the rooms of a street whose decorations came before, as `photographs`, and what share of their
    pixels differs from the same photograph taken where the decoration comes first."""
    for image, told in photographs(place, place, range(decorations, len(place.rooms)), count, rng):
        here = np.array(told["T_world_camera"])
        poses = np.stack([here, where_first(place, decorations, here)])
        focal = told["intrinsics"][0] / PHOTO_PX[0]
        views = synthetic.film(place, poses, size_px=PHOTO_PX, focal=focal).images
        yield image, told, float(apart(*views).mean())


def where_first(place: Place, decorations: int, T_world_camera: np.ndarray) -> np.ndarray:
    """(4, 4) the same standpoint in the room of a street where its decoration comes first."""
    xy = T_world_camera[:2, 3]
    room = int(np.argmin([np.linalg.norm(one.center - xy) for one in place.rooms]))
    out = T_world_camera.copy()
    out[:2, 3] -= (place.rooms[1].center - place.rooms[0].center) * (room - room % decorations)
    return out


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(H, W) bool: where two pictures (H, W, 3) uint8 differ."""
    out: np.ndarray = np.abs(one.astype(np.int16) - other).max(2) > DIFFERS * 255
    return out


def write_differences(place: Place, folder: Path, routes: Sequence[tuple[int, ...]], decorations: int) -> None:
    """differs.npz: where captures show what photographs do (``T_map_camera`` of the place: their own standpoints, or in
    the room that looks like theirs), and which pixels of those then are others (``apart``, photo by capture, at half
    size): the doors that the walk left shut, and in rooms that look alike the furniture.

    Of photographs in which nothing has changed and nobody stands; ``photo`` are their numbers. With as many
    ``decorations`` as rooms no room looks like another.
    """
    poses, differ, numbers = [], [], []
    size = (PHOTO_PX[0] // 2, PHOTO_PX[1] // 2)
    for number, told in enumerate(json.loads((folder / "photos.json").read_text())):
        if told["changed"] or told["occluded"]:
            continue
        here, focal = np.array(told["T_world_camera"]), told["intrinsics"][0] / PHOTO_PX[0]
        there = where_first(place, decorations, here)
        photo = synthetic.film(place, here[None], size_px=size, focal=focal).images[0]
        seen = [
            synthetic.film(place, there[None], size_px=size, focal=focal, shut=unused_doors(place, route)).images[0]
            for route in routes
        ]
        poses.append(there)
        differ.append(np.stack([apart(photo, one) for one in seen]))
        numbers.append(number)
    np.savez_compressed(folder / "differs.npz", T_map_camera=poses, apart=np.stack(differ), photo=numbers)


def drawn(seed: int) -> tuple[np.random.Generator, bool]:
    """What a place's captures and photographs are drawn from, and whether it has a twin."""
    rng = np.random.default_rng([seed, 31])
    return rng, bool(rng.random() < 0.2)


def made_place(seed: int) -> Place:
    """The place of a seed."""
    return synthetic.make_place(seed, rooms=3, twin=drawn(seed)[1], texel_m=0.008)


def changed_place(place: Place, rng: np.random.Generator) -> Place:
    """The same after a third of its furniture was changed."""
    with contextlib.suppress(ConfigError):  # some rooms hold too little to change so much of
        return edit_place(place, random_edits(place, rng, rooms=list(range(len(place.rooms))), share=0.3))
    return place


def _capture(
    place: Place, route: tuple[int, ...], k: int, seed: int, rng: np.random.Generator
) -> synthetic.DemoCapture:
    frames = synthetic.film(
        place,
        synthetic.walk(place, route, 40, seed=k),
        size_px=CAPTURE_PX,
        shut=unused_doors(place, route),
        gain=rng.uniform(0.8, 1.15),
        gamma=rng.uniform(0.9, 1.15),
        name=f"c{k}",
    )
    if rng.random() < 0.3:
        frames = perturb.sensed(frames, rng, rng.uniform(0.3, 1.2))
    gaussians = fit_frames(frames, steps=int(rng.choice([120, 250])), num_gaussians=60_000, seed=k)
    if rng.random() < 0.3:
        gaussians = perturb.strewn(gaussians, rng, rng.uniform(0.005, 0.03), size_m=0.05, opacity=0.6)
    if rng.random() < 0.3:
        gaussians = perturb.bent(gaussians, rng, rng.uniform(0.001, 0.006), rng.uniform(0.002, 0.015))
    return put_in_own_frame(gaussians, frames, f"c{k}", np.random.default_rng([seed, k, 8]))


def _photograph(place: Place, folder: Path, rng: np.random.Generator) -> None:
    (folder / "photos").mkdir(exist_ok=True)
    changed = changed_place(place, rng)
    told = []
    for i, (image, said) in enumerate(photographs(place, changed, range(len(place.rooms)), PHOTOS, rng)):
        Image.fromarray(image).save(folder / "photos" / f"p{i:03d}.jpg", quality=88)
        told.append({"file": f"p{i:03d}.jpg", **said})
    (folder / "photos.json").write_text(json.dumps(told))


def photographs(
    place: Place, changed: Place, rooms: Sequence[int], count: int, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """Photographs (H, W, 3) and what is true of them: along other walks and from anywhere, by other lenses, in other
    light, every fourth of what has changed, in every sixth somebody."""
    for i in range(count):
        pose = _pose(place, rooms, rng)
        width = PHOTO_PX[0]
        focal, gain, gamma = rng.uniform(0.55, 0.95), rng.uniform(0.6, 1.4), rng.uniform(0.85, 1.2)
        seen = changed if i % 4 == 3 else place
        shot = synthetic.film(
            seen, pose[None], size_px=PHOTO_PX, gain=gain * rng.uniform(0.95, 1.05, 3), gamma=gamma, focal=focal
        ).images[0]
        hidden = 0.0
        if i % 6 == 5:
            shot, hidden = occluded(shot, rng)
        yield (
            shot,
            {
                "T_world_camera": pose.tolist(),
                "intrinsics": [focal * width, focal * width, width / 2, PHOTO_PX[1] / 2],
                "gain": gain,
                "changed": seen is not place,
                "occluded": hidden,
            },
        )


def _pose(place: Place, rooms: Sequence[int], rng: np.random.Generator) -> np.ndarray:
    """A standpoint in the free part of one of some rooms, at the height of a hand, looking about level."""
    while True:
        room = place.rooms[rooms[int(rng.integers(len(rooms)))]]
        xy = room.center + (rng.random(2) - 0.5) * (room.size_m - 0.6)
        if room.is_free(xy[None])[0]:
            break
    return look_along(*xy, rng.uniform(0.9, 1.8), rng.uniform(0, 2 * np.pi), rng.normal(-0.1, 0.2))


def occluded(
    image: np.ndarray, rng: np.random.Generator, shares: tuple[float, float] = (0.05, 0.2)
) -> tuple[np.ndarray, float]:
    """Somebody stands in the picture (H, W, 3) uint8: an upright blob of such a share of it, clothed in stripes."""
    height, width = image.shape[:2]
    share = rng.uniform(*shares)
    tall = rng.uniform(0.5, 0.95) * height
    wide = share * width * height / tall
    x = rng.uniform(wide / 2, width - wide / 2)
    v, u = np.mgrid[0:height, 0:width]
    body = (np.abs(u - x) < wide / 2 * np.clip((v - (height - tall)) / (0.15 * tall), 0, 1)) & (v > height - tall)
    stripes = rng.uniform(0, 255, (6, 3))[(v // max(4, int(tall / 12))) % 6]
    out = np.where(body[..., None], stripes + rng.normal(0, 12, image.shape), image)
    return np.clip(out, 0, 255).astype(np.uint8), float(body.mean())


if __name__ == "__main__":
    sys.exit(main())
