"""Changes that gsmap claims among captures of a place that did not change.

    python -m tools.bench.unchanged HOUSE/*.ply          # NAME.cameras.json beside each NAME.ply

Each capture is dated a month after the one before, and a map of them is made. Of every pair in the order of the files,
under the map's poses: a line for each claim, with its place and size in metres and its evidence. Every claim is wrong.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap import map as maps
from gsmap.change import compare
from gsmap.geometry.metric_scale import in_metres
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map.metric_scales import metres_of_scenes
from gsmap.types import PosedScene
from tools.harness import argument_parser

SURE = 0.8


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--work", type=Path, help="keep the map here, or use the one that is there")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        scenes = placed(args.captures, (args.work or Path(scratch)) / "unchanged.gsmap")
    claims = []
    for older, newer in itertools.combinations(scenes, 2):
        found = [change for change in compare(older, newer).changes if change.kind != "lighting"]
        claims += found
        pair = f"{older.scene_id}:{newer.scene_id}"
        for change in found:
            at, size = change.box.mean(0).round(2).tolist(), np.ptp(change.box, axis=0).round(2).tolist()
            told = " ".join(f"{name} {value:.2f}" for name, value in change.evidence.items())
            print(f"{pair} {change.kind:11} {change.confidence:.3f} at {at} size {size} {told}", flush=True)
        print(f"{pair} {len(found)} claims", flush=True)
    sure = sum(change.confidence >= SURE for change in claims)
    print(f"claims {len(claims)}, of these with a confidence of {SURE} and more {sure}")
    return 0


def placed(captures: list[Path], path: Path) -> list[PosedScene]:
    """The captures that the map places, in its frame and in the given order."""
    if not path.exists():
        with maps.create(path) as m:
            for k, capture in enumerate(captures):
                m.update(capture, captured_at=f"{2025 + k // 12}-{k % 12 + 1:02d}-01")
    with maps.open(path) as m:
        graph = m.store.revisions.get()
        metres = {} if graph is None else metres_of_scenes(m.store, graph)
        rows = {row.name: row for row in m.scene_rows() if row.S_map_scene is not None}
    scenes = []
    for capture in captures:
        if capture.stem in rows:
            row = rows[capture.stem]
            S = in_metres(row.S_map_scene, metres[row.id])
            gaussians = transform_gaussians(formats.read(capture), S)
            cameras = transform_cameras(formats.read_cameras(capture.with_name(f"{capture.stem}.cameras.json")), S)
            scenes.append(PosedScene(gaussians, cameras, row.name, row.captured_at))
    return scenes


if __name__ == "__main__":
    sys.exit(main())
