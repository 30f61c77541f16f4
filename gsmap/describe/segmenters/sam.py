"""Segmenter that runs Segment Anything from its published ONNX exports, prompted by a grid of points.

Contract (segment-anything, ``scripts/export_onnx_model.py``; MobileSAM and others export the same): the encoder takes a
picture whose longer side is 1024 and returns ``image_embeddings``; the decoder takes these with ``point_coords``
(1, P, 2) in the 1024 frame, ``point_labels`` (1, P), ``mask_input``, ``has_mask_input``, ``orig_im_size``, and returns
``masks`` (1, M, H, W), logits at the picture's size, and ``iou_predictions`` (1, M). If the export accepts any batch
size, the decoder processes many prompts at once. Thresholds and box suppression are as in SAM's automatic mask
generator.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmap.networks.session import misfit, open_session, run
from gsmap.settings.ranges import require_range
from gsmap.types.model import ModelSpec
from gsmap.types.views import Mask, SceneContext, View

VERSION = 1
MODELS = ("sam-encoder", "sam-decoder")
SAM_SIDE_PX = 1024
# Inputs of the published SAM decoder export (segment-anything, scripts/export_onnx_model.py).
DECODER_INPUTS = ("image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size")
_BATCH = 64  # prompts per run of a decoder that accepts several
_MIN_STABILITY = 0.9  # IoU between the masks cut one logit above and one logit below zero
_MAX_BOX_IOU = 0.7  # of two masks whose boxes overlap more, the mask with the lower predicted IoU is dropped
_MIN_AREA, _MAX_AREA = 0.002, 0.9  # fractions of the view
_PIXEL_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_PIXEL_STD = np.array([58.395, 57.12, 57.375], np.float32)


@dataclass(frozen=True)
class Params:
    """Settings of SAM's automatic mask generator.

    Args:
        points_per_side: Number of point prompts, at least 1, along each side of a view; larger finds more small objects
            and takes longer.
        min_iou: Smallest intersection over union in [0, 1], as predicted by SAM, of a mask that is kept; larger keeps
            fewer masks.
    """

    points_per_side: int = 16
    min_iou: float = 0.86

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "points_per_side")
        require_range(self, "[0, 1]", "min_iou")


def make(context: SceneContext, params: Params) -> SamSegmenter:
    """Open the two models; see `gsmap.methods.segmenter`."""
    return SamSegmenter(params, *(context.models[kind] for kind in MODELS))


def probe(spec: ModelSpec) -> None:
    """Reject a model that is not a SAM encoder or decoder, by its inputs and outputs.

    Raises:
        InputError: the inputs or outputs do not fit; the message says which.
    """
    problem = _encoder_problem(spec) if spec.kind == "sam-encoder" else _decoder_problem(spec)
    if problem:
        raise misfit(spec, problem)


def _encoder_problem(spec: ModelSpec) -> str:
    if len(spec.inputs) != 1 or not spec.inputs[0].is_image:
        return "a SAM encoder takes one image, (1, 3, 1024, 1024) or (H, W, 3)"
    if any(side not in (1, 3, SAM_SIDE_PX, None) for side in spec.inputs[0].shape):
        return f"a SAM encoder takes images of {SAM_SIDE_PX} x {SAM_SIDE_PX} pixels"
    return "" if any(len(t.shape) == 4 for t in spec.outputs) else "a SAM encoder returns embeddings (1, C, h, w)"


def _decoder_problem(spec: ModelSpec) -> str:
    missing = [name for name in DECODER_INPUTS if name not in {t.name for t in spec.inputs}]
    if missing:
        return f"the published SAM decoder export also takes {', '.join(missing)}"
    absent = [name for name in ("masks", "iou_predictions") if name not in {t.name for t in spec.outputs}]
    return f"the model has no output {', '.join(absent)}" if absent else ""


class SamSegmenter:
    """A segmenter that returns the masks of everything that SAM finds."""

    def __init__(self, params: Params, encoder: ModelSpec, decoder: ModelSpec) -> None:
        self.params = params
        self.encoder, self.decoder = open_session(encoder), open_session(decoder)
        self.encoder_spec, self.decoder_spec = encoder, decoder
        shapes = {t.name: t.shape for t in decoder.inputs}
        self.batch = _BATCH if shapes["point_coords"][0] is None and shapes["point_labels"][0] is None else 1
        self.types = {t.name: np.float64 if t.dtype == "double" else np.float32 for t in decoder.inputs}

    def segment(self, view: View) -> list[Mask]:
        """Segment a view by a grid of prompts, and drop unstable, too small, too large or duplicate masks."""
        height, width = view.rgb.shape[:2]
        embeddings = self._encode(view.rgb)
        side = (np.arange(self.params.points_per_side) + 0.5) / self.params.points_per_side
        grid = np.stack(np.meshgrid(side * width, side * height), -1).reshape(-1, 2)
        boxes, scores, masks = [], [], []
        for start in range(0, len(grid), self.batch):
            for logits, iou in self._decode(embeddings, grid[start : start + self.batch], height, width):
                inner, outer = (logits > 1).sum(), (logits > -1).sum()
                pixels = logits > 0
                share = pixels.mean()
                if (
                    iou >= self.params.min_iou
                    and inner >= _MIN_STABILITY * max(outer, 1)
                    and _MIN_AREA <= share <= _MAX_AREA
                ):
                    rows, columns = np.flatnonzero(pixels.any(1)), np.flatnonzero(pixels.any(0))
                    boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
                    scores.append(float(iou))
                    masks.append(pixels)
        keep = suppress(np.array(boxes, float).reshape(-1, 4), np.array(scores), _MAX_BOX_IOU)
        return [Mask(masks[i], min(1.0, scores[i])) for i in keep]

    def _encode(self, rgb: np.ndarray) -> np.ndarray:
        """Compute the embeddings (1, C, h, w) of a picture."""
        height, width = rgb.shape[:2]
        scale = SAM_SIDE_PX / max(height, width)
        size = (round(width * scale), round(height * scale))
        from PIL import Image  # imported here, as the recipe key does not need it

        large = np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BILINEAR), np.float32)
        tensor = self.encoder_spec.inputs[0]
        if len(tensor.shape) == 3:  # exports that normalize and pad inside the network
            picture = large
        else:
            normal = (large - _PIXEL_MEAN) / _PIXEL_STD
            padded = np.zeros((SAM_SIDE_PX, SAM_SIDE_PX, 3), np.float32)
            padded[: size[1], : size[0]] = normal
            picture = padded[None] if tensor.shape[-1] == 3 else padded.transpose(2, 0, 1)[None]
        if tensor.dtype == "uint8":
            picture = picture.astype(np.uint8)
        outputs = run(self.encoder_spec, self.encoder, None, {tensor.name: picture})
        return next(o for o in outputs if o.ndim == 4)

    def _decode(
        self, embeddings: np.ndarray, points: np.ndarray, height: int, width: int
    ) -> Iterator[tuple[np.ndarray, float]]:
        """Yield the logits (H, W) and the predicted IoU of each mask of each prompt."""
        count = len(points)
        scale = SAM_SIDE_PX / max(height, width)
        # A prompt without a box needs a padding point labelled -1 (by the contract of the export).
        coords = np.zeros((count, 2, 2))
        coords[:, 0] = points * scale
        labels = np.tile([1.0, -1.0], (count, 1))
        feed = {
            "image_embeddings": embeddings,
            "point_coords": coords,
            "point_labels": labels,
            "mask_input": np.zeros((1, 1, 256, 256)),
            "has_mask_input": np.zeros(1),
            "orig_im_size": np.array([height, width]),
        }
        feed = {name: value.astype(self.types[name]) for name, value in feed.items()}
        masks, scores = run(self.decoder_spec, self.decoder, ["masks", "iou_predictions"], feed)
        # Of four masks the first is for prompts of several points; the generator uses the remaining three.
        first = 1 if masks.shape[1] == 4 else 0
        for prompt in range(masks.shape[0]):
            for m in range(first, masks.shape[1]):
                yield masks[prompt, m], scores[prompt, m]


def suppress(boxes: np.ndarray, scores: np.ndarray, max_iou: float) -> list[int]:
    """Apply non-maximum suppression to boxes (M, 4) ``x0 y0 x1 y1``; return the rows to keep, the best first."""
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    left = np.argsort(-scores, kind="stable")
    keep = []
    while len(left):
        best, left = left[0], left[1:]
        keep.append(int(best))
        low, high = np.maximum(boxes[best, :2], boxes[left, :2]), np.minimum(boxes[best, 2:], boxes[left, 2:])
        inter = np.clip(high - low, 0, None).prod(1)
        left = left[inter <= max_iou * (areas[best] + areas[left] - inter)]
    return keep
