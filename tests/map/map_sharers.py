"""A run of ``update`` for tests of several at once: ``map_sharers.py MAP LOG SECONDS``.

Jobs are stood in for: each notes in LOG which it is and which run it belongs to, takes its time, and finds that scenes
lie a metre apart.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np

from gsmap.types import Cameras, NodeLayer, Registration, SceneGraph, Sim3
from gsmap.types.prepared_scene import PreparedScene

LOG, SECONDS = "SHARERS_LOG", "SHARERS_SECONDS"


def _note(text: str) -> None:
    with open(os.environ[LOG], "a") as log:
        log.write(f"{os.environ['SHARERS_RUN']} {text}\n")
    time.sleep(float(os.environ[SECONDS]))


def prepared(scene: str) -> PreparedScene:
    """A prepared scene without surface cells and views."""
    no_points = np.zeros((0, 3), np.float32)
    return PreparedScene(
        scene=scene,
        unit_m=1.0,
        centre=np.zeros(3),
        is_surface=np.zeros(50, bool),
        points=no_points,
        colours=no_points,
        normals=no_points,
        sides=np.zeros(0, np.int8),
        sample=no_points,
        cameras=Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2), np.int64)),
        num_own=0,
        image_colours=np.zeros((0, 3), np.uint8),
        image_depths=np.zeros(0, np.float16),
    )


def describe_scene(path: str, scene: str, *_: Any) -> tuple[SceneGraph, PreparedScene]:
    _note(f"graph {scene}")
    rng = np.random.default_rng(0)
    embeddings = rng.normal(size=(4, 8)).astype(np.float32)
    layer = NodeLayer(
        positions=rng.normal(size=(4, 3)),
        embeddings=embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True),
        types=np.zeros(4, dtype=np.int32),
        extents=np.zeros((4, 2, 3)),
        weights=np.ones(4),
        num_views=np.ones(4, dtype=np.int32),
        features=np.zeros((4, 1)),
        descriptor_id="test",
    )
    return SceneGraph(scene, {"objects": layer}, np.array([0.0, 0, 1]), 1.0), prepared(scene)


def register_scenes(path: str, target: tuple[str, str], source: tuple[str, str], *_: Any) -> Registration:
    _note("edge " + "-".join(sorted((target[0], source[0]))))
    pose = Sim3(np.eye(3), np.array([1.0, 0, 0]))
    return Registration(target[0], source[0], "accepted", "", pose, 100.0 * np.eye(7), 50, 60, 0.5, "graph:objects")


def main() -> None:
    import gsmap.map
    from gsmap.cli.console import start_logging
    from gsmap.map.stages import describe, register

    describe.describe_scene, register.register_scenes = describe_scene, register_scenes
    register.prepare_missing = lambda *_: None
    os.environ |= {LOG: sys.argv[2], SECONDS: sys.argv[3], "SHARERS_RUN": str(os.getpid())}
    start_logging(0, False)

    def progress(stage: str, fraction: float, text: str = "") -> None:
        print(f"{stage}: {text}", file=sys.stderr, flush=True)

    print("ready", flush=True)
    sys.stdin.readline()
    with gsmap.map.open(sys.argv[1], progress) as m:
        m.update()
        print(sorted((row.pair, row.status, row.used) for row in m.edge_rows()))
        print([(row.name, row.status, row.component) for row in m.scene_rows()], [r.number for r in m.revision_rows()])


if __name__ == "__main__":
    from gsmap.cli.stopping import stoppable

    with stoppable():
        main()
