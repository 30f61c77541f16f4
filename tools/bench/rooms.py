"""How well the rooms of a place are told apart, against exact truth.

    python -m tools.make.change CHANGE/test --set test
    python -m tools.bench.rooms CHANGE/test/*
    python -m tools.bench.rooms --made 9101 9102 9103 --rooms 5

Each PLACE is a folder that tools/make/change.py wrote; poses are the true ones. ``--made`` places are flats of more
rooms whose captures are what depth frames show, not trained. Of the rooms that any capture walked through:

rooms   how many of them are found (IoU of the floor over .5), of how many there are, and how many more are claimed.
IoU     mean over those that are found.
doors   pairs of found rooms joined by a door that a capture passed, of how many such pairs; and how many more.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

import gsmap_synthetic as synthetic
from gsmap.objects import find_rooms
from gsmap.types import Room
from gsmap_synthetic.capture import default_routes, unused_doors
from gsmap_synthetic.initialise import from_depth
from tools.harness import argument_parser, timed
from tools.make.change_truth import Truth


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="*", default=[])
    parser.add_argument("--made", type=int, nargs="+", default=[], help="seeds of flats to make")
    parser.add_argument("--rooms", type=int, default=5, help="how many rooms these have")
    parser.add_argument("--only", help="use this capture alone")
    args = parser.parse_args()
    total: Counter[str] = Counter()
    for folder in args.places:
        counts = score(Truth(folder), args.only)
        print(folder.name, said(counts), flush=True)
        total += counts
    for seed in args.made:
        counts = score_made(seed, args.rooms)
        print(seed, said(counts), flush=True)
        total += counts
    print("all", said(total))


def score(truth: Truth, only: str | None = None) -> Counter[str]:
    times = truth.times if only is None else [only]
    captures = [truth.gaussians(when) for when in times]
    eyes = np.concatenate([truth.cameras(when).centers for when in times])
    found, took = timed(find_rooms, captures, eyes)
    counts: Counter[str] = Counter({"ms": round(1000 * took)})
    routes = [json.loads((truth.folder / "truth" / f"{when}.json").read_text())["route"] for when in times]
    floors = {s["room"]: np.array(s["box_m"])[:, :2] for s in truth.states(times[0]) if s["name"] == "floor"}
    return counts + compared(found, floors, routes)


def score_made(seed: int, rooms: int) -> Counter[str]:
    place = synthetic.make_place(seed, rooms=rooms, texel_m=0.03)
    routes = default_routes(place, rooms)
    captures, eyes = [], []
    for i, route in enumerate(routes):
        poses = synthetic.walk(place, route, 30, seed=seed + i)
        frames = synthetic.film(place, poses, size_px=(160, 120), shut=unused_doors(place, route))
        captures.append(from_depth(frames, 12_000, seed=seed))
        eyes.append(poses[:, :3, 3])
    found, took = timed(find_rooms, captures, np.concatenate(eyes))
    counts: Counter[str] = Counter({"ms": round(1000 * took)})
    floors = {i: room.rect_m.reshape(2, 2) for i, room in enumerate(place.rooms)}
    return counts + compared(found, floors, routes)


def compared(found: Sequence[Room], floors: Mapping[int, np.ndarray], routes: Sequence[Sequence[int]]) -> Counter[str]:
    """Counts of what is found; floors are (2, 2) corners by room."""
    walked = {room for route in routes for room in route}
    shares = {(i, room): overlap(one, floors[room]) for i, one in enumerate(found) for room in floors}
    of = {i: room for (i, room), share in shares.items() if share > 0.5}
    right = {i: room for i, room in of.items() if room in walked}
    counts: Counter[str] = Counter()
    counts.update({"rooms of": len(walked), "rooms": len(set(right.values())), "more": len(found) - len(of)})
    counts["IoU"] += round(1000 * sum(shares[i, room] for i, room in right.items()))
    passed = {frozenset(pair) for route in routes for pair in pairwise(route)}
    joined = {frozenset((of[i], of[j])) for i, j in combinations(of, 2) if j in found[i].doors}
    counts.update({"doors of": len(passed), "doors": len(passed & joined), "more doors": len(joined - passed)})
    return counts


def overlap(room: Room, floor: np.ndarray) -> float:
    """IoU of a room's cells with a rectangle (2, 2)."""
    at = room.low + (np.argwhere(room.cells) + 0.5) * room.cell_m
    inside = int(((at >= floor[0]) & (at <= floor[1])).all(1).sum()) * room.cell_m**2
    return inside / (room.area_m2 + float(np.prod(floor[1] - floor[0])) - inside)


def said(counts: Counter[str]) -> str:
    iou = counts["IoU"] / 1000 / max(counts["rooms"], 1)
    return (
        f"rooms {counts['rooms']}/{counts['rooms of']}, {counts['more']} more; IoU {iou:.3f}; doors "
        f"{counts['doors']}/{counts['doors of']}, {counts['more doors']} more; CPU s {counts['ms'] / 1000:.2f}"
    )


if __name__ == "__main__":
    main()
