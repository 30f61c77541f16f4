"""Associate the masks of several views to object nodes of one scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gsmap.describe.cloud import downsample


@dataclass(eq=False)
class Node:
    """An object under construction: points (n, 3), a unit feature (F,), and the views that show it."""

    points: np.ndarray
    feature: np.ndarray
    confidences: list[float] = field(default_factory=list)
    views: set[int] = field(default_factory=set)
    part: int | None = None

    @cached_property
    def box(self) -> np.ndarray:
        """(2, 3) box of the points; see `box_of`."""
        return box_of(self.points)


def associate(nodes: list[Node], region: Node, tau: float, cell: float) -> Node:
    """Merge a region (a node seen once) into the most similar node, or start a new node; return the node.

    Similarity is the cosine of the features plus the generalized IoU of the boxes (Graph-GSReg, tau_asso); regions of
    the same part of the segmenter always form one node. Merging unites the points, thins them to one per cell of size
    ``cell``, and averages the features over all merged regions.
    """
    best = _counterpart(nodes, region, tau)
    if best is None:
        nodes.append(region)
        return region
    united = np.concatenate([best.points, region.points])
    best.points = downsample(united, united, cell)[0]
    best.__dict__.pop("box", None)
    seen = len(best.confidences)
    mean = (best.feature * seen + region.feature) / (seen + 1)
    best.feature = mean / max(np.linalg.norm(mean), 1e-12)
    best.confidences += region.confidences
    best.views |= region.views
    return best


def make_region(
    points: np.ndarray, feature: np.ndarray, confidence: float, view: int, cell: float, part: int | None = None
) -> Node:
    """Return one mask as a node of its own."""
    return Node(downsample(points, points, cell)[0], feature, [confidence], {view}, part)


def _counterpart(nodes: list[Node], region: Node, tau: float) -> Node | None:
    if region.part is not None:
        return next((n for n in nodes if n.part == region.part), None)
    if not nodes:
        return None
    score = np.stack([n.feature for n in nodes]) @ region.feature + giou(np.stack([n.box for n in nodes]), region.box)
    best = int(np.argmax(score))
    return nodes[best] if score[best] > tau else None


def giou(boxes: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Compute the generalized IoU (M,) in (-1, 1] of axis-parallel boxes (M, 2, 3) with one box (2, 3).

    This is Rezatofighi et al. 2019 in 3D: IoU minus the share of the common hull that neither box covers. Flat boxes
    get a thickness of a thousandth of the hull, so that two equal planes have an IoU of 1.
    """
    low, high = np.minimum(boxes[:, 0], box[0]), np.maximum(boxes[:, 1], box[1])
    pad = 0.5e-3 * (high - low).max(1, keepdims=True) + 1e-12
    boxes = np.stack([boxes[:, 0] - pad, boxes[:, 1] + pad], 1)
    other = np.stack([box[0] - pad, box[1] + pad], 1)
    inter = np.clip(np.minimum(boxes[:, 1], other[:, 1]) - np.maximum(boxes[:, 0], other[:, 0]), 0, None).prod(1)
    hull = (np.maximum(boxes[:, 1], other[:, 1]) - np.minimum(boxes[:, 0], other[:, 0])).prod(1)
    union = (boxes[:, 1] - boxes[:, 0]).prod(1) + (other[:, 1] - other[:, 0]).prod(1) - inter
    return inter / union - (hull - union) / hull


def box_of(points: np.ndarray) -> np.ndarray:
    """Compute the box (2, 3) of the points, without the outermost 2 percent on each side."""
    # As `numpy.percentile`, which takes ten times as long for few points.
    last = len(points) - 1
    at = last * np.array([[0.02], [0.98]] if len(points) > 20 else [[0.0], [1.0]])
    low = np.floor(at).astype(int)[:, 0]
    high = np.minimum(low + 1, last)
    ordered = np.partition(points, np.unique([low, high]), axis=0)
    step, share = ordered[high] - ordered[low], at - low[:, None]
    box: np.ndarray = np.where(share < 0.5, ordered[low] + step * share, ordered[high] - step * (1 - share))
    return box
