"""What the page of `gsmap.view` shows: the newest poses, the current edges, arrays read when they are asked for."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.map import reports
from gsmap.map.metres import metres_of_scenes
from gsmap.map.one_state import of_one_state
from gsmap.store import Store
from gsmap.view import ViewEdge, ViewMap, ViewScene

if TYPE_CHECKING:
    from gsmap.map.settings import Settings


@of_one_state
def view_of(store: Store, settings: Settings) -> ViewMap:
    """The living scenes, each with its newest graph, and the edges between them."""
    placed = store.revisions.get()
    poses = placed.poses if placed else {}
    metres = metres_of_scenes(store, settings, placed) if placed else {}
    scenes = [
        ViewScene(
            scene,
            poses.get(scene.id),
            partial(store.scenes.gaussians, scene.id),
            partial(store.graphs.load, scene.id),
            partial(store.scenes.cameras, scene.id),
            metres.get(scene.id, 1.0),
        )
        for scene in store.scenes.list()
    ]
    edges = [
        ViewEdge(
            row.target,
            row.source,
            row.status,
            row.reason,
            row.used if placed else None,
            row.num_inliers,
            row.overlap,
        )
        for row in reports.edge_rows(store)
    ]
    return ViewMap(Path(store.location).name, scenes, edges)
