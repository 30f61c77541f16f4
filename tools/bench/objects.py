"""How well things and objects are told apart and followed, against exact truth.

    python -m tools.make.change CHANGE/test --set test
    python -m tools.bench.objects CHANGE/test/*

Each PLACE is a folder that tools/make/change.py wrote; poses are the true ones. Of every capture:

pieces    furniture (and pictures) of at least 60 Gaussians that one thing covers with an IoU of more than a half.
listed    of these, those whose object is listed as one, and not as a part of the building.
building  listed objects most of which is building.

Of the first two captures, of pieces that both show:

kept      what stayed is one object of both captures.
gone, new what left or came is absent where it was not.
moved     what moved is one object, or absent from both places when it stood in the other.
false     what stayed and is called absent, or was not seen and is.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from gsmap import formats
from gsmap.change import compare
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.describe.objects.segments import find_segments
from gsmap.objects import (
    MatchedSegments,
    RenderedViews,
    SegmentedScene,
    find_changed_segment,
    make_objects,
    render_views,
)
from gsmap.types import MapObject, ObjectObservation, PosedScene, Segments
from tools.harness import argument_parser, timed
from tools.make.change_truth import Truth, owners

_SHOWN = 60  # Gaussians of a piece that a capture shows, or else it says little of it
_MOVED_M = 0.02
_KINDS = {"furniture": "furniture", "small": "furniture", "picture": "pictures"}


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="+")
    parser.add_argument("--changes", action="store_true", help="ask what changed, too, for what moved or left")
    args = parser.parse_args()
    total: Counter[str] = Counter()
    for folder in args.places:
        counts = score(Truth(folder), args.changes)
        print(folder.name, _said(counts))
        total += counts
    print("all", _said(total))


def score(truth: Truth, with_changes: bool) -> Counter[str]:
    """Counts by what is scored; ``X`` of ``X of``."""
    counts: Counter[str] = Counter()
    captures, whose, found = [], [], []
    for when in truth.times:
        gaussians = formats.read(truth.folder / f"{when}.ply")
        cameras = formats.read_cameras(truth.folder / f"{when}.cameras.json")
        started = time.process_time()
        cloud = surface_cloud(gaussians)
        up = estimate_up(cloud.points, cameras)
        between = time.process_time()
        things = find_segments(gaussians, cloud, up, 1.0)
        counts["things ms"] += round(1000 * (time.process_time() - between))
        counts["surface ms"] += round(1000 * (between - started))
        counts["captures"] += 1
        captures.append(SegmentedScene(when, truth.T_place_scene(when), things))
        whose.append(owners(truth, when, truth.gaussians(when).means))
        found.append(_pieces(counts, truth.states(when), things, whose[-1]))

    def eyes(capture: SegmentedScene) -> RenderedViews:
        gaussians = formats.read(truth.folder / f"{capture.scene}.ply")
        cameras = formats.read_cameras(truth.folder / f"{capture.scene}.cameras.json")
        return render_views(gaussians, cameras, members=capture.segments.members)

    moved, parted = _told(truth, captures) if with_changes else ([], [])
    told = MatchedSegments(moved, parted)
    objects, took = timed(make_objects, captures, 0, eyes, match=lambda scenes: told)
    counts["objects ms"] += round(1000 * took)
    _listed(counts, truth, captures, whose, found, objects)
    _followed(counts, truth, captures, whose, objects)
    return counts


def _told(truth: Truth, captures: list[SegmentedScene]) -> tuple[list[Any], list[Any]]:
    """What the changes between the first two captures say of their things, as `make_objects` takes it."""
    sides = [
        PosedScene(truth.gaussians(when), truth.cameras(when), when, f"2026-01-0{i + 1}T00:00:00+00:00")
        for i, when in enumerate(truth.times[:2])
    ]
    older, newer = captures[:2]
    moved: list[Any] = []
    parted: list[Any] = []
    for change in compare(*sides).changes:
        if change.kind in ("appeared", "disappeared", "replaced", "moved"):
            before = older.scene, find_changed_segment(older.segments.members, change.before)
            after = newer.scene, find_changed_segment(newer.segments.members, change.after)
            parted += [(before, newer.scene)] * (before[1] >= 0) + [(after, older.scene)] * (after[1] >= 0)
            moved += [(before, after)] * (change.kind == "moved" and min(before[1], after[1]) >= 0)
    return moved, parted


def _pieces(counts: Counter[str], states: list[dict[str, Any]], things: Segments, owner: np.ndarray) -> dict[int, str]:
    """Count the pieces, and return the kind of piece that each thing covers."""
    covered = {}
    for state in states:
        mine = owner == state["id"]
        if state["kind"] not in _KINDS or mine.sum() < _SHOWN:
            continue
        found = things.members[mine & (things.members >= 0)]
        shared = np.bincount(found, minlength=len(things))
        union = np.bincount(things.members[things.members >= 0], minlength=len(things)) + mine.sum() - shared
        overlap = shared / np.maximum(union, 1)
        is_found = bool(overlap.max(initial=0) > 0.5)
        if is_found:
            covered[int(np.argmax(overlap))] = _KINDS[state["kind"]]
        counts[f"pieces: {_KINDS[state['kind']]} of"] += 1
        counts[f"pieces: {_KINDS[state['kind']]}"] += is_found
    return covered


def _listed(
    counts: Counter[str],
    truth: Truth,
    captures: list[SegmentedScene],
    whose: list[np.ndarray],
    found: list[dict[int, str]],
    objects: list[MapObject],
) -> None:
    at = {one.scene: i for i, one in enumerate(captures)}
    kinds = [{state["id"]: state["kind"] for state in truth.states(one.scene)} for one in captures]
    for thing in objects:
        shown = [(at[s.scene], s.thing) for s in thing.sightings if s.thing >= 0]
        for i, segment in shown:
            if segment in found[i]:
                counts[f"listed: {found[i][segment]} of"] += 1
                counts[f"listed: {found[i][segment]}"] += not thing.is_building
        i, segment = max(shown, key=lambda one: captures[one[0]].segments.sample_counts[one[1]])
        piece = _of(captures[i], whose[i], segment)
        if not thing.is_building:
            counts["building of"] += 1
            counts["building"] += kinds[i].get(piece) in ("shell", "window", "door", None)


def _followed(
    counts: Counter[str],
    truth: Truth,
    captures: list[SegmentedScene],
    whose: list[np.ndarray],
    objects: list[MapObject],
) -> None:
    before, after = ({s["id"]: s for s in truth.states(when)} for when in truth.times[:2])
    sightings = [{s.scene: s for s in thing.sightings} for thing in objects]
    unseen = [ObjectObservation(one.scene, "unseen") for one in captures]
    shown = [[mine.get(unseen[i].scene, unseen[i]) for i in (0, 1)] for mine in sightings]
    told = [[_of(captures[i], whose[i], both[i].thing) for i in (0, 1)] for both in shown]
    said = [[one.state for one in both] for both in shown]
    for piece in sorted({*before, *after}):
        shown = [int((owner == piece).sum()) for owner in whose[:2]]
        was, is_ = (s.get(piece, {}).get("present", False) for s in (before, after))
        kind = (after.get(piece) or before[piece])["kind"]
        if kind not in _KINDS:
            continue
        older = [i for i, of in enumerate(told) if of[0] == piece]
        newer = [i for i, of in enumerate(told) if of[1] == piece]
        left, came = any(said[i][1] == "absent" for i in older), any(said[i][0] == "absent" for i in newer)
        if was and is_ and min(shown) >= _SHOWN:
            T = [np.array(s[piece]["T_place_object"]) for s in (before, after)]
            if np.linalg.norm(T[0][:3, 3] - T[1][:3, 3]) > _MOVED_M:
                what, right = "moved", (left and came) or bool({*older} & {*newer})
            else:
                what, right = f"kept {_KINDS[kind]}", bool({*older} & {*newer})
                counts["false"] += left or came
        elif was and not is_ and shown[0] >= _SHOWN:
            what, right = "gone", left
        elif is_ and not was and shown[1] >= _SHOWN:
            what, right = "new", came
        else:
            continue
        counts[f"{what} of"] += 1
        counts[what] += right


def _of(capture: SegmentedScene, owner: np.ndarray, thing: int) -> int:
    """The piece that most of a thing's Gaussians are of."""
    if thing < 0:
        return -1
    ids, counts = np.unique(owner[capture.segments.members == thing], return_counts=True)
    return int(ids[np.argmax(counts)])


def _said(counts: Counter[str]) -> str:
    shares = [f"{name} {counts[name]}/{counts[f'{name} of']}" for name in sorted(counts) if f"{name} of" in counts]
    each = {name: counts[name] / counts["captures"] / 1000 for name in ("surface ms", "things ms", "objects ms")}
    cost = ", ".join(f"{name[:-3]} {seconds:.2f}" for name, seconds in each.items())
    return f"{'; '.join(shares)}; false {counts['false']}; CPU s a capture: {cost}"


if __name__ == "__main__":
    main()
