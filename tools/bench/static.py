"""What `gsmap export --static` leaves out and keeps, against exact truth.

    python -m tools.make.change CHANGE/test --set test
    python -m tools.bench.static CHANGE/test/*

Each PLACE is a folder that tools/make/change.py wrote; its captures are ingested, described and placed by their true
poses. Of the Gaussians of all captures, by what they truly are of:

changed   furniture and pictures that moved, left or came between any two visits: the share that is left out.
stayed    furniture and pictures that did not, repainted ones included: the share that is kept.
building  floors, walls, ceilings, doors and windows: the share that is kept.

For objects and changes together, as the export has it, and for each alone. CPU seconds are of comparing visits and of
making objects.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.map.changes.compare import standing_comparisons
from gsmap.map.objects.static_filter import DynamicContent, find_dynamic_content
from gsmap.types import PoseGraph, ScenePose
from tools.harness import argument_parser
from tools.make.change_truth import Truth, owners

_THINGS = ("furniture", "small", "picture", "lamp", "rug")
_BUILDING = ("shell", "wall", "window", "door")
_STAY = ("recoloured", "lighting")
WAYS = ("both", "objects", "changes")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="+")
    total: dict[str, Counter[str]] = {way: Counter() for way in WAYS}
    for folder in parser.parse_args().places:
        counts, seconds = score(Truth(folder))
        for way in WAYS:
            print(
                f"{folder.name} {way:8}", said(counts[way]), f"CPU s {seconds:.1f}" if way == "both" else "", flush=True
            )
            total[way] += counts[way]
    for way in WAYS:
        print(f"all {way:8}", said(total[way]))


def score(truth: Truth) -> tuple[dict[str, Counter[str]], float]:
    """Counts of Gaussians, ``X`` of ``X of``, by what told them; and what that cost."""
    with tempfile.TemporaryDirectory(prefix="static_") as folder, gsmap.map.create(Path(folder) / "m.gsmap") as m:
        m.with_settings({"describe.landmarks": False, "describe.objects": False})
        ids = {}
        for when in truth.times:
            gaussians = formats.read(truth.folder / f"{when}.ply")
            cameras = formats.read_cameras(truth.folder / f"{when}.cameras.json")
            m.ingest(gaussians, cameras=cameras, name=when, captured_at=truth.captured_at(when), scale="known")
            ids[when] = m.store.scenes.get(when).id
        m.describe()
        poses = {ids[when]: ScenePose(ids[when], truth.T_place_scene(when), 0, "placed") for when in truth.times}
        m.store.revisions.save(PoseGraph(poses))
        started = time.process_time()
        known, _ = m.static_content()
        seconds = time.process_time() - started
        passing = find_dynamic_content(m.store, known, standing_comparisons(m.store, m.settings))
        changed = set()
        for a, b in combinations(truth.times, 2):
            for change in truth.changes(a, b):
                if change["kind"] not in _STAY:
                    changed |= {change[side] for side in ("before", "after") if change[side] is not None}
        counts: dict[str, Counter[str]] = {way: Counter() for way in WAYS}
        for when, scene in ids.items():
            means = truth.T_place_scene(when).apply(m.store.scenes.gaussians(scene).means)
            owner = owners(truth, when, means)
            kinds = {state["id"]: state["kind"] for state in truth.states(when)}
            for way in WAYS:
                gone = _only(passing[scene], way).rows(m.store, scene)
                for piece in np.unique(owner[owner >= 0]).tolist():
                    mine = owner == piece
                    what = "changed" if piece in changed else "stayed" if kinds[piece] in _THINGS else "building"
                    if what == "building" and kinds[piece] not in _BUILDING:
                        continue
                    counts[way][f"{what} of"] += int(mine.sum())
                    counts[way][what] += int((mine & (gone if what == "changed" else ~gone)).sum())
    return counts, seconds


def _only(passing: DynamicContent, way: str) -> DynamicContent:
    without = {"both": {}, "objects": {"changes": ()}, "changes": {"things": ()}}[way]
    return replace(passing, **without)


def said(counts: Counter[str]) -> str:
    words = {"changed": "left out", "stayed": "kept", "building": "kept"}
    return "; ".join(
        f"{what} {100 * counts[what] / max(counts[f'{what} of'], 1):.2f} % {done} of {counts[f'{what} of']:,}"
        for what, done in words.items()
    )


if __name__ == "__main__":
    main()
