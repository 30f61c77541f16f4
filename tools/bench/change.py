"""How well gsmap keeps a place that changes: registration, merging, changes and the past, against exact truth.

    python -m tools.make.change CHANGE/test --set test
    python -m tools.bench.change CHANGE/test/*

Each PLACE is a folder that tools/make/change.py wrote. Of each a map is made as anybody would (`gsmap update PLACE`,
dates from the sidecars) and scored (see tools/bench/change_scores.py):

register  error of every pair of captures in the map, and how it was taken.
merge     PSNR in exact masks at the newest photographs, all and those held out; what changed pixels show (old, mix,
          new); how much still stands in the air that things left; and what is dropped of each older capture.
changes   objects found, claims right, IoU, kinds, moves, false changes; of pairs that did not change, false changes.
as-of     the map as of the first capture's date, at that capture's photographs, beside that capture alone.
"""

from __future__ import annotations

import argparse
import inspect
import itertools
import json
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gsmap import formats
from gsmap import map as maps
from gsmap.errors import ConfigError
from gsmap.types import Gaussians, PosedScene, Sim3
from tools.bench import change_scores as scores
from tools.harness import argument_parser, cpu_s, say, timed

PARTS = ("register", "merge", "changes", "as-of")
PREFER = "merge.mergers.tto.prefer"
COUNTS = ("objects", "found", "kind_right", "claims", "right", "false", "moved_true", "moved_right", "moved_symmetric")
COUNTS += ("moved_symmetric_right", "moved_symmetric_said", "moved_claimed", "moved_wrong")


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="+")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--times", nargs="+", help="only these captures of every place")
    parser.add_argument("--ways", nargs="+", help="only these ways of merging")
    parser.add_argument("--true-poses", action="store_true", help="changes under true poses, without a map")
    parser.add_argument("--work", type=Path, help="keep maps and exports here, and use those that are there")
    parser.add_argument("--json", type=Path, help="write all figures here")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for folder in args.places:
            place = Place(folder, args.times, (args.work or Path(scratch)) / folder.name, args.true_poses)
            for part in args.parts:
                for row in PART[part](place, args):
                    rows.append({"part": part, "place": folder.name, **row})
                    print(shown(rows[-1]), flush=True)
    for line in losses(rows):
        print(line)
    total = Counter()
    for row in rows:
        total.update({key: row[key] for key in COUNTS if row["part"] == "changes"})
    if total:
        print("all pairs:", ", ".join(f"{key} {total[key]}" for key in COUNTS))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    return 0


class Place:
    """A made place, and a map of it."""

    def __init__(self, folder: Path, times: list[str] | None, work: Path, true_poses: bool) -> None:
        self.truth, self.work, self.true_poses = scores.Truth(folder), work, true_poses
        self.times = [t for t in self.truth.times if times is None or t in times]
        self.map_path = work / ("-".join(self.times) + ".gsmap")

    @property
    def changed(self) -> bool:
        """Whether anything changed between any two of its times."""
        return any(self.truth.changes(self.times[0], t) for t in self.times[1:])

    def map(self) -> maps.Map:
        """The map, made where it is not there yet."""
        if not self.map_path.exists():
            self.work.mkdir(parents=True, exist_ok=True)
            with maps.create(self.map_path) as m:
                m.update(*(self.truth.folder / f"{t}.ply" for t in self.times))
        return maps.open(self.map_path)

    def poses(self) -> dict[str, Sim3]:
        """Where the map puts each capture, in the place's frame: brought there by the newest's true pose."""
        if self.true_poses:
            return {t: self.truth.T_place_scene(t) for t in self.times}
        with self.map() as m:
            S_map = {row.name: row.S_map_scene for row in m.scene_rows()}
        S_place_map = self.place_map(S_map[self.times[-1]])
        return {t: S_place_map @ S_map[t] for t in self.times}

    def place_map(self, S_map_newest: Sim3) -> Sim3:
        return self.truth.T_place_scene(self.times[-1]) @ S_map_newest.inverse()

    def placed(self, time: str, S_place_scene: Sim3) -> PosedScene:
        """A capture in the place's frame, where the map puts it."""
        from gsmap.geometry.transforms import transform_cameras, transform_gaussians

        folder = self.truth.folder
        gaussians = transform_gaussians(formats.read(folder / f"{time}.ply"), S_place_scene)
        cameras = transform_cameras(formats.read_cameras(folder / f"{time}.cameras.json"), S_place_scene)
        return PosedScene(gaussians, cameras, time, self.truth.captured_at(time))

    def exported(self, way: str, **options: Any) -> tuple[Gaussians, Sim3, float] | None:
        """The merged map, its pose in the place's frame, and CPU seconds; None where gsmap has no such way."""
        path = self.map_path
        if way == "undated":
            path = self.work / f"undated-{self.map_path.name}"
            if not path.exists():
                self.map().close()
                shutil.copytree(self.map_path, path)
        with self.map() if path == self.map_path else maps.open(path) as m:
            if way == "undated":
                for row in m.scene_rows():
                    m.edit(row.name, captured_at="none")
            view = m
            if way in ("newest", "best", "both"):
                try:
                    view = m.with_settings({PREFER: way})
                except ConfigError:
                    return None
            if not set(options) <= set(inspect.signature(m.export).parameters):
                return None
            out, began = self.work / f"{'-'.join(self.times)}-{way}", cpu_s()
            shutil.rmtree(out, ignore_errors=True)
            view.export(out, tile_size_m=0, merge="union" if way == "union" else "tto", **options)
            S_map_newest = next(r.S_map_scene for r in m.scene_rows() if r.name == self.times[-1])
        parts = [formats.read(path) for path in sorted(out.rglob("*.ply"))]
        return Gaussians.concatenate(parts), self.place_map(S_map_newest), cpu_s() - began


def register(place: Place, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    with place.map() as m:
        scenes = {row.name: row for row in m.scene_rows()}
        edges = {frozenset((e.source_name, e.target_name)): e.status for e in m.edge_rows()}
    for i, a in enumerate(place.times):
        for b in place.times[i + 1 :]:
            status = edges.get(frozenset((a, b)), "none")
            row = {"pair": f"{a}:{b}", "status": status}
            if scenes[a].component == scenes[b].component and scenes[a].S_map_scene and scenes[b].S_map_scene:
                told = scenes[b].S_map_scene.inverse() @ scenes[a].S_map_scene
                true = place.truth.T_place_scene(b).inverse() @ place.truth.T_place_scene(a)
                middle = formats.read_cameras(place.truth.folder / f"{a}.cameras.json").centers.mean(0, keepdims=True)
                row["cm"] = 100 * float(np.linalg.norm(told.apply(middle) - true.apply(middle)))
                turn = np.trace(told.rotation @ true.rotation.T)
                row["deg"] = float(np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1))))
            yield row


def merge(place: Place, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    truth, newest, older = place.truth, place.times[-1], place.times[:-1]
    if not place.changed:
        return
    for way in args.ways or ("alone", "union", "undated", "dated", "newest", "best", "both"):
        if way == "alone":
            made: Any = (truth.gaussians(newest), Sim3.identity(), 0.0)
        else:
            made = place.exported(way)
        if made is None:
            say(f"{truth.folder.name}: this gsmap does not merge with {way} preferred")
            continue
        merged, S_place_map, seconds = made
        row = {"way": way, "cpu_s": round(seconds, 1), **scores.score_merge(truth, newest, older, merged, S_place_map)}
        means = S_place_map.apply(merged.means)
        row["ghosts"] = {t: scores.score_ghosts(truth, newest, t, means)["left"] for t in older}
        yield row
    yield from drops(place)


def drops(place: Place) -> Iterator[dict[str, Any]]:
    """What merging drops of each older capture before it fits anything."""
    from gsmap.merge.changes import resolve_changes

    poses = place.poses()
    scenes = [place.placed(t, poses[t]) for t in place.times]
    left = resolve_changes(scenes).scenes  # the newest is preferred
    for time_, before, after in zip(place.times[:-1], scenes, left, strict=False):
        dropped = ~scores.kept_rows(before.gaussians.means, after.gaussians.means)
        yield {"way": f"drops of {time_}", **scores.score_drops(place.truth, place.times[-1], time_, dropped)}


def changes(place: Place, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    try:
        from gsmap.change import compare
    except ImportError:
        say("this gsmap has no gsmap.change")
        return
    poses, times = place.poses(), place.times
    pairs = [(times[0], t) for t in times[1:]]
    if place.changed:
        pairs = sorted({*itertools.pairwise(times), (times[0], times[-1])})
    for a, b in pairs:
        report, took = timed(compare, place.placed(a, poses[a]), place.placed(b, poses[b]))
        row = {"pair": f"{a}:{b}", "cpu_s": round(took, 1)}
        found = scores.claims_of(report.changes, Sim3.identity())
        yield row | scores.score_changes(place.truth, a, b, found)


def as_of(place: Place, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    truth, first, later = place.truth, place.times[0], place.times[1:]
    if not place.changed:
        return
    made = place.exported("as-of", as_of=truth.captured_at(first))
    if made is None:
        say("this gsmap exports no map as of a date")
        return
    kinds, held = scores.masks(truth, first, later), truth.held_out(first)
    cameras, photographs = truth.cameras(first), truth.photographs(first)
    # The map lies where the newest's true pose puts it; what the first was registered by is not at fault here.
    with place.map() as m:
        S_map_first = next(r.S_map_scene for r in m.scene_rows() if r.name == first)
    ways = {"alone": (truth.gaussians(first), Sim3.identity())}
    ways["as of its date"] = made[0], truth.T_place_scene(first) @ S_map_first.inverse()
    for way, (gaussians, S_place_map) in ways.items():
        from gsmap.geometry.transforms import transform_gaussians

        shown_ = scores.pictures(transform_gaussians(gaussians, S_place_map), cameras)
        row = {"way": way, "psnr": scores.psnr_by_kind(shown_, photographs, kinds)}
        yield row | {"held": scores.psnr_by_kind(shown_[held], photographs[held], kinds[held])}


def shown(row: dict[str, Any]) -> str:
    """One line of the table."""
    head = f"{row['place']:>6} {row.get('way') or row.get('pair')!s:16}"
    if row["part"] == "register":
        where = f"{row['deg']:.2f} deg {row['cm']:.1f} cm" if "cm" in row else "not in one component"
        return f"{head} {row['status']:10} {where}"
    if row["part"] == "changes":
        moved = f"moved {row['moved_right']}/{row['moved_true']}, symmetric {row['moved_symmetric_right']}/"
        moved += f"{row['moved_symmetric']}, wrong {row['moved_wrong']}/{row['moved_claimed']}"
        return (
            f"{head} found {row['found']}/{row['objects']} kinds {row['kind_right']}/{row['found']} "
            f"right {row['right']}/{row['claims']} P {row['precision']:.2f} R {row['recall']:.2f} IoU {row['iou']:.2f} "
            f"{moved}; {row['cpu_s']} CPU s"
        )
    if "gone" in row:
        false = f"{row['false']:.2%} (of what is not lit otherwise {row['false_unlit']:.2%})"
        return f"{head} gone {row['gone']:.1%} painted {row['painted']:.1%} false {false}"
    kinds = ("new", "recoloured", "vacated", "changed", "same")
    figures = " ".join(f"{k} {row['psnr'][k]:.2f} ({row['held'][k]:.2f})" for k in kinds)
    if "old_mix_new" not in row:
        return f"{head} {figures}"
    shares = "/".join(f"{x:.3f}" for x in row["old_mix_new"])
    ghosts = " ".join(f"{t} {x:.1%}" for t, x in row["ghosts"].items())
    return f"{head} {figures} old/mix/new {shares} ghosts {ghosts} n {row['gaussians']} {row['cpu_s']} CPU s"


def losses(rows: list[dict[str, Any]]) -> Iterator[str]:
    """For each way of merging, over all places: the worst losses against the newest alone, and against dated tto."""
    merged = {(row["place"], row["way"]): row for row in rows if row["part"] == "merge" and "psnr" in row}
    for way in dict.fromkeys(way for _, way in merged):
        own = {place: row for (place, w), row in merged.items() if w == way}
        parts = [f"{way:8} at worst"]
        alone = [(merged[place, "alone"], row) for place, row in own.items() if (place, "alone") in merged]
        for kind in ("changed", "new", "recoloured", "vacated") if alone else ():
            lost = np.nanmax([a["psnr"][kind] - row["psnr"][kind] for a, row in alone])
            parts.append(f"{kind} {lost:+.2f} dB below alone,")
        dated = [(merged[place, "dated"], row) for place, row in own.items() if (place, "dated") in merged]
        if dated:
            gained = min(row["held"]["same"] - d["held"]["same"] for d, row in dated)
            parts.append(f"held same {gained:+.2f} dB against dated,")
        parts.append(f"old or mix {max(sum(row['old_mix_new'][:2]) for row in own.values()):.3f}")
        yield " ".join(parts)


PART = {"register": register, "merge": merge, "changes": changes, "as-of": as_of}

if __name__ == "__main__":
    sys.exit(main())
