"""A scene as segmenters and embedders observe it: its surface, rendered views, and masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.types.cameras import Cameras
from gsmap.types.model import ModelSpec


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a surface.

    Args:
        points: (N, 3) float64, scene frame and unit.
        lab: (N, 3) float32 CIE L*a*b* (D65).
        areas: (N,) the surface each point stands for: a disc that holds its 8 nearest neighbours, divided among them;
            square scene units.
        index: (N,) rows of the Gaussians the points are the centres of.
    """

    points: np.ndarray
    lab: np.ndarray
    areas: np.ndarray
    index: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def evenly(self, count: int) -> PointCloud:
        """Return every n-th point, at most ``count``, with the area of each point multiplied by n."""
        step = -(-len(self) // count)
        if step <= 1:
            return self
        rows = np.arange(0, len(self), step)
        return PointCloud(self.points[rows], self.lab[rows], step * self.areas[rows], self.index[rows])


@dataclass(frozen=True, eq=False)
class SceneContext:
    """The data of a scene that segmenters and embedders get before the first view.

    Args:
        cloud: the surface, with its colours; scene frame and unit.
        num_gaussians: of the scene; ``cloud.index`` and ``View.dominant_id`` are rows of these.
        up: (3,) unit vector against gravity, scene frame, or None where it is unknown.
        unit_m: metres per scene unit to assume.
        models: checked ONNX models by kind; those that the method names are there.
    """

    cloud: PointCloud
    num_gaussians: int
    up: np.ndarray | None
    unit_m: float
    models: Mapping[str, ModelSpec] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class View:
    """A rendered view.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, scene units, 0 where nothing was drawn.
        alpha: (H, W) float32.
        dominant_id: (H, W) int32 row of the Gaussian that weighs most, -1 where nothing was drawn.
        camera: `Cameras` of length 1, of the render's size.
    """

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    dominant_id: np.ndarray
    camera: Cameras


@dataclass(frozen=True, eq=False)
class Mask:
    """A mask of one part of a view, such as an object.

    Args:
        pixels: (H, W) bool.
        confidence: confidence of the segmenter, in [0, 1].
        part: masks with the same part show the same object in all views; None if the segmenter does not track objects.
    """

    pixels: np.ndarray
    confidence: float
    part: int | None = None
