#!/usr/bin/env python
"""What a street of rooms that look alike does to a map: which edges are accepted, which are used, what is folded.

    python -m tools.bench.alike --cache /tmp/streets                    # decorations repeat, furniture does not
    python -m tools.bench.alike --cache /tmp/streets --repeats nothing  # the control
    python -m tools.bench.alike --cache /tmp/streets --repeats room     # rooms repeated entirely, furniture included
    python -m tools.bench.alike --cache /tmp/streets --leave-out e,k       # without some captures: the street has gaps

Makes the street (`gsmap_synthetic.streets`), captures every two neighbouring rooms of it, and lets `update` make a map
of the captures; all of it is kept under ``--cache``. Prints the accepted edges, right and wrong, by overlap and by the
probability of two places; then what the pose graph makes of them, once ``blind`` to that and once as it is: edges used
and tentative, scenes placed and tentative, components, and how many of these are folded (a scene lies more than 1 m
from where the truth has it in the component's frame).
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap.map.settings import Settings
from gsmap.map.stages.optimize import pose_inputs
from gsmap.optimize import optimize
from gsmap.types import PoseGraph, Sim3
from tools.harness import argument_parser, say

FOLDED_M = 1.0


@dataclass(frozen=True)
class Street:
    """A map of a street and what is true of it.

    Args:
        names: of its captures, by scene id.
        routes: the rooms that each walked.
        S_world_scene: where each lies.
    """

    map: gsmap.map.Map
    names: dict[str, str]
    routes: dict[str, set[int]]
    S_world_scene: dict[str, Sim3]

    def is_right(self, a: str, b: str) -> bool:
        return bool(self.routes[a] & self.routes[b])


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keep streets and their maps here")
    parser.add_argument("--seed", type=int, default=31, help="7 is the street that settings were chosen on")
    parser.add_argument("--repeats", default="decoration", choices=("decoration", "room", "nothing"))
    parser.add_argument("--rooms", type=int, default=15)
    parser.add_argument("--decorations", type=int, default=5)
    parser.add_argument("--steps", type=int, default=120, help="of training, a capture")
    parser.add_argument("--leave-out", default="", metavar="A,B", help="captures that the poses are solved without")
    args = parser.parse_args()
    street = read(args)
    left_out = {f"capture_{letter}" for letter in args.leave_out.split(",") if letter}
    report(street, left_out)


def read(args: argparse.Namespace) -> Street:
    """The street of these options and its map, made where they are not there yet."""
    folder = args.cache / f"{args.repeats}_{args.seed}_{args.rooms}_{args.decorations}_{args.steps}"
    if not (folder / "routes.json").exists():
        make(folder, args)
    routes = json.loads((folder / "routes.json").read_text())
    m = gsmap.map.open_or_create(folder / "map.gsmap")
    begin = time.process_time()
    m.update(*sorted(folder.glob("*.ply")))
    say(f"map up to date: {time.process_time() - begin:.0f} CPU s here, workers aside")
    names = {scene.id: scene.name for scene in m.scenes()}
    truth = {
        scene: Sim3.from_matrix(np.array(json.loads((folder / "truth" / f"{name}.json").read_text())["T_scene_world"]))
        for scene, name in names.items()
    }
    walked = {scene: set(routes[name]) for scene, name in names.items()}
    return Street(m, names, walked, {scene: S.inverse() for scene, S in truth.items()})


def make(folder: Path, args: argparse.Namespace) -> None:
    from gsmap_synthetic import make_captures, write_captures
    from gsmap_synthetic.streets import make_street, street_routes

    begin = time.process_time()
    place = make_street(args.seed, rooms=args.rooms, decorations=args.decorations, repeats=args.repeats)
    routes = street_routes(args.rooms)
    captures = make_captures(
        args.seed, len(routes), steps=args.steps, num_frames=40, num_gaussians=25_000, routes=routes, place=place
    )
    write_captures(folder, captures)
    by_name = {capture.name: route for capture, route in zip(captures, routes, strict=True)}
    (folder / "routes.json").write_text(json.dumps(by_name))
    say(f"street made: {time.process_time() - begin:.0f} CPU s")


def report(street: Street, left_out: set[str]) -> None:
    kept = [scene for scene, name in street.names.items() if name not in left_out]
    settings: Settings = street.map.settings
    edges = [e for e in pose_inputs(street.map.store, settings).edges if {e.target, e.source} <= set(kept)]
    overlaps = {(row.target, row.source): row.overlap for row in street.map.edge_rows()}
    print(f"{len(kept)} captures, {len(edges)} accepted edges")
    for name, wanted in (("right", True), ("wrong", False)):
        rows = [e for e in edges if street.is_right(e.target, e.source) == wanted]
        overlap, look_alike = [overlaps[e.target, e.source] for e in rows], [e.look_alike for e in rows]
        print(f"  {name} {len(rows):3d}   overlap {spread(overlap)}   look-alike {spread(look_alike)}")
    neighbours = [(a, b) for i, a in enumerate(kept) for b in kept[i + 1 :] if street.is_right(a, b)]
    found = {frozenset((e.target, e.source)) for e in edges}
    print(
        f"  of {len(neighbours)} pairs that share a room {sum(frozenset(p) in found for p in neighbours)} are accepted"
    )
    print(
        "           right: used tentative unused   wrong: used tentative unused   scenes: placed tentative alone   "
        "components  folded"
    )
    blind = [replace(edge, look_alike=float("nan"), log_odds_wrong=float("nan")) for edge in edges]
    for name, given in (("blind", blind), ("as it is", edges)):
        answer = optimize(kept, given, params=replace(settings.optimize, marginals=False))
        print(row_of(name, street, answer))


def row_of(name: str, street: Street, answer: PoseGraph) -> str:
    uses = Counter((street.is_right(*key), outcome.use) for key, outcome in answer.outcomes.items())
    statuses = Counter(pose.status for pose in answer.poses.values())
    components = {pose.component for pose in answer.poses.values()}
    folded = sum(off_m(street, answer, k) > FOLDED_M for k in components)
    right, wrong = ([uses[side, use] for use in ("used", "tentative", "unused")] for side in (True, False))
    scenes = [statuses[status] for status in ("placed", "tentative", "isolated")]
    columns = (
        ("{:11d} {:9d} {:6d}", right), ("{:13d} {:9d} {:6d}", wrong), ("{:16d} {:9d} {:5d}", scenes),
        ("{:12d} {:7d}", [len(components), folded]),
    )  # fmt: skip
    return f"{name:>10}" + " ".join(text.format(*values) for text, values in columns)


def off_m(street: Street, answer: PoseGraph, component: int) -> float:
    """How far a scene of a component lies from where the truth has it, seen from the component's first scene."""
    scenes = [scene for scene, pose in answer.poses.items() if pose.component == component]
    first = scenes[0]
    off = [0.0]
    for scene in scenes[1:]:
        found = answer.poses[first].S_map_scene.inverse() @ answer.poses[scene].S_map_scene
        true = street.S_world_scene[first].inverse() @ street.S_world_scene[scene]
        centre = street.map.store.scenes.get(scene).bounds.mean(0)
        off.append(float(np.linalg.norm(found.apply(centre) - true.apply(centre))))
    return max(off)


def spread(values: list[float]) -> str:
    if not values:
        return "-"
    low, middle, high = np.quantile(values, [0, 0.5, 1])
    return f"{low:.3f} to {high:.3f}, median {middle:.3f}"


if __name__ == "__main__":
    main()
