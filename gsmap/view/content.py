"""What the page is told: the map as JSON, the splats as bytes that a graphics card takes as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from gsmap.formats.tiles3d import coarser
from gsmap.geometry.boxes import box_corners
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.geometry.transforms import transform_gaussians
from gsmap.geometry.voxels import covariances
from gsmap.types import Cameras, Gaussians, Scene, SceneGraph, ScenePose, Sim3

MAX_SPLATS = 1_500_000
_MAX_NODES = 2_000
_MAX_CAMERAS = 300
_LEAST_OPACITY = 1 / 255
_MAX_SPLAT_TO_SCENE = 0.5  # a Gaussian wider than that is a fog that hides everything


@dataclass(frozen=True)
class ViewScene:
    """One scene: what is known of it, and how to load the rest when the page asks.

    Args:
        pose: None where nothing placed it; it is then a component of its own.
        metres_per_unit: of the map's frame; cameras are drawn a decimetre long.
        gaussians, graph, cameras: called from the server's threads; graph and cameras may give None.
    """

    scene: Scene
    pose: ScenePose | None
    gaussians: Callable[[], Gaussians]
    graph: Callable[[], SceneGraph | None] = lambda: None
    cameras: Callable[[], Cameras | None] = lambda: None
    metres_per_unit: float = 1.0


@dataclass(frozen=True)
class ViewEdge:
    """One pair that was tried.

    Args:
        target, source: scene ids.
        status: ``accepted``, ``rejected`` or ``no_match``, a review included.
        used: what the last optimize made of it: True, False or ``"tentative"``; None before.
    """

    target: str
    source: str
    status: str
    reason: str = ""
    used: bool | str | None = None
    num_inliers: int = 0
    overlap: float = 0.0


@dataclass(frozen=True)
class ViewMap:
    """A map as the page shows it.

    Args:
        up: (3,) direction against gravity in the map frame.
        max_splats: over all scenes; a scene beyond its share is shown by a coarser level, merged and not thinned.
    """

    title: str
    scenes: list[ViewScene]
    edges: list[ViewEdge] = field(default_factory=list)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    max_splats: int = MAX_SPLATS

    def summary(self) -> dict[str, Any]:
        """Everything the page lists, without splats, nodes and cameras."""
        components = 1 + max((s.pose.component for s in self.scenes if s.pose is not None), default=-1)
        scenes = []
        for index, entry in enumerate(self.scenes):
            pose = entry.pose
            scenes.append(
                {
                    "name": entry.scene.name,
                    "id": entry.scene.id,
                    "num_gaussians": entry.scene.num_gaussians,
                    "captured_at": entry.scene.captured_at,
                    "component": pose.component if pose else components + index,
                    "status": pose.status if pose else "not placed",
                    "S_map_scene": _pose(entry).matrix().tolist(),
                    "corners": _pose(entry).apply(box_corners(entry.scene.bounds)).tolist(),
                }
            )
        at = {entry.scene.id: index for index, entry in enumerate(self.scenes)}
        edges = [
            {**asdict(edge), "target": at[edge.target], "source": at[edge.source]}
            for edge in self.edges
            if edge.target in at and edge.source in at
        ]
        return {"title": self.title, "up": list(self.up), "scenes": scenes, "edges": edges}

    def splats(self, index: int) -> bytes:
        """Rows of 10 little-endian float32 in the map frame: mean (3), covariance (xx xy xz yy yz zz), RGBA in 4 bytes.

        Colours are of SH degree 0; what is transparent, not finite or larger than half its scene is left out.
        """
        entry = self.scenes[index]
        g = entry.gaussians()
        finite = np.isfinite(g.means).all(1) & np.isfinite(g.log_scales).all(1) & np.isfinite(g.quats).all(1)
        largest = float(np.ptp(entry.scene.bounds, axis=0).max()) * _MAX_SPLAT_TO_SCENE
        shown = finite & (g.opacities > _LEAST_OPACITY) & (g.scales.max(1, initial=0) < max(largest, 1e-6))
        if not shown.any():
            return b""
        g = replace(g, sh=g.sh[:, :1])[shown]
        g, _ = coarser(g, max(1000, self.max_splats // len(self.scenes)))
        g = transform_gaussians(g, _pose(entry))
        rows = np.empty((len(g), 10), "<f4")
        rows[:, :3] = g.means
        rows[:, 3:9] = covariances(g).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        rgba = np.concatenate([rgb_of_sh0(g.sh[:, 0]), g.opacities[:, None]], axis=1)
        rows[:, 9:].view("u1")[:] = np.round(np.clip(rgba, 0, 1) * 255)
        return rows.tobytes()

    def extras(self, index: int) -> dict[str, Any]:
        """Nodes and cameras of one scene in the map frame."""
        entry = self.scenes[index]
        S_map_scene = _pose(entry)
        graph, cameras = entry.graph(), entry.cameras()
        layers = {}
        for name, layer in (graph.layers if graph else {}).items():
            strongest = np.argsort(-layer.weights, kind="stable")[:_MAX_NODES]
            layers[name] = S_map_scene.apply(layer.positions[strongest]).tolist()
        frusta = []
        if cameras is not None and not cameras.synthesised:
            every = -(-len(cameras) // _MAX_CAMERAS)
            for pose, (fx, fy, cx, cy), (width, height) in zip(
                cameras.T_frame_camera[::every],
                cameras.intrinsics_px[::every],
                cameras.sizes_px[::every],
                strict=True,
            ):
                rays = [
                    [(u - cx) / fx, (v - cy) / fy, 1] for u, v in ((0, 0), (width, 0), (width, height), (0, height))
                ]
                long = 0.1 / (S_map_scene.scale * entry.metres_per_unit)
                local = np.vstack([np.zeros((1, 3)), np.array(rays) * long])
                frusta.append(S_map_scene.apply(local @ pose[:3, :3].T + pose[:3, 3]).tolist())
        return {"layers": layers, "cameras": frusta}


def _pose(entry: ViewScene) -> Sim3:
    return entry.pose.S_map_scene if entry.pose is not None else Sim3.identity()
