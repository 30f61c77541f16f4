"""Embedder that runs an image encoder supplied by the user: CLIP's visual tower, DINO, MobileNet or a similar ONNX
file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError
from gsmap.networks.session import misfit, open_session, run
from gsmap.types.model import ModelSpec
from gsmap.types.views import Mask, SceneContext, View

VERSION = 1
MODELS = ("clip",)
_MARGIN = 0.1  # the crop is the mask's box, enlarged by this share on each side and made square
_BACKGROUND = 0.5  # weight of pixels outside the mask; the remaining weight is on the view's mean colour
_SIDE_PX = 224  # input size of models that accept any size
_BATCH = 16  # crops per run of a model that accepts several


@dataclass(frozen=True)
class Params:
    """Settings of the embedder: none; the constants of this module define the crops."""


def make(context: SceneContext, params: Params) -> ClipEmbedder:
    """Open the encoder; see `gsmap.methods.embedder`."""
    return ClipEmbedder(context.models["clip"])


def embed_text(text: str, models: Mapping[str, ModelSpec]) -> np.ndarray:
    """Compute the vector (F,) of a text with the text tower of the same model; see `gsmap.describe.onnx.text`."""
    from gsmap.describe.onnx import text as tower

    return tower.embed(text, models)


def probe(spec: ModelSpec) -> None:
    """Reject a model that is not an image encoder, by running it once; declared shapes are not sufficient.

    Raises:
        InputError: the model's inputs and outputs do not fit, or it does not run.
    """
    if len(spec.inputs) != 1 or not spec.inputs[0].is_image or len(spec.inputs[0].shape) != 4:
        raise misfit(spec, "an image encoder has one input of shape (N, 3, H, W) or (N, H, W, 3)")
    if not spec.outputs:
        raise misfit(spec, "the model has no outputs")
    ClipEmbedder(spec)


class ClipEmbedder:
    """An image encoder that runs on one crop per mask; size, layout and names come from the model."""

    def __init__(self, spec: ModelSpec) -> None:
        self.spec = spec
        self.session = open_session(spec)
        self.input = spec.inputs[0]
        n, *rest = self.input.shape
        self.channels_last = rest[-1] == 3 and rest[0] != 3
        sides = rest[:2] if self.channels_last else rest[1:]
        self.size = (sides[0] or _SIDE_PX, sides[1] or _SIDE_PX)  # height, width
        self.batch = _BATCH if n is None else n
        self.fixed = n is not None
        # Use the output that the model names as an embedding, or its first output with one vector per picture.
        named = [o.name for o in spec.outputs if o.name in ("image_embeds", "embedding", "embeddings", "pooler_output")]
        flat = [o.name for o in spec.outputs if len(o.shape) == 2]
        self.output = (named or flat or [spec.outputs[0].name])[0]
        self.dim = self._run(np.zeros((1, *self.size, 3), np.float32)).shape[1]

    def embed(self, view: View, masks: Sequence[Mask], points: Sequence[np.ndarray]) -> np.ndarray:
        """Compute features (R, F) of the masks; see `gsmap.methods.embedder`."""
        if not masks:
            return np.zeros((0, self.dim), np.float32)
        crops = np.stack([crop(view.rgb, m.pixels, self.size) for m in masks])
        features = self._run(normalise(crops, self.spec))
        return (features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)).astype(np.float32)

    def embed_picture(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute features of one whole picture (H, W, 3) uint8, and an (F,) mask of the valid features, which is all
        True."""
        crops = crop(rgb, np.ones(rgb.shape[:2], bool), self.size, margin=0.0)[None]
        feature = self._run(normalise(crops, self.spec))[0]
        unit = (feature / max(float(np.linalg.norm(feature)), 1e-12)).astype(np.float32)
        return unit, np.ones(len(unit), bool)

    def _run(self, pictures: np.ndarray) -> np.ndarray:
        """Compute features (R, F) of normalized pictures (R, H, W, 3)."""
        out = []
        for start in range(0, len(pictures), self.batch):
            part = pictures[start : start + self.batch]
            used = len(part)
            if self.fixed and used < self.batch:
                part = np.concatenate([part, np.zeros((self.batch - used, *part.shape[1:]), part.dtype)])
            part = part if self.channels_last else part.transpose(0, 3, 1, 2)
            dtype = np.float16 if self.input.dtype == "float16" else np.float32
            feed = {self.input.name: np.ascontiguousarray(part, dtype)}
            value = run(self.spec, self.session, [self.output], feed)[0].astype(np.float32)
            if value.ndim == 3:  # tokens: the first is the class token
                value = value[:, 0]
            elif value.ndim == 4:  # a feature map: its mean
                value = value.mean((2, 3)) if value.shape[1] >= value.shape[3] else value.mean((1, 2))
            if value.ndim != 2 or len(value) < used:
                raise InputError(
                    f"model {self.spec.kind} ({self.spec.path}) returns shape {list(value.shape)} for {used} pictures",
                    code="model_misfit",
                )
            out.append(value[:used])
        return np.concatenate(out)


def crop(
    rgb: np.ndarray,
    pixels: np.ndarray,
    size: tuple[int, int],
    margin: float = _MARGIN,
    background: float = _BACKGROUND,
) -> np.ndarray:
    """Crop the square around a mask, (height, width, 3) float32 in [0, 1], padded with the mean colour of the view."""
    rows, columns = np.flatnonzero(pixels.any(1)), np.flatnonzero(pixels.any(0))
    centre = np.array([rows[0] + rows[-1] + 1, columns[0] + columns[-1] + 1]) / 2
    side = max(rows[-1] + 1 - rows[0], columns[-1] + 1 - columns[0]) * (1 + 2 * margin)
    low = np.floor(centre - side / 2).astype(int)
    side = max(2, int(np.ceil(side)))
    mean = rgb.reshape(-1, 3).mean(0)
    square = np.tile(mean, (side, side, 1))
    row = slice(max(low[0], 0), min(low[0] + side, rgb.shape[0]))
    column = slice(max(low[1], 0), min(low[1] + side, rgb.shape[1]))
    part = rgb[row, column].astype(np.float64)
    outside = ~pixels[row, column, None]
    part = np.where(outside, background * part + (1 - background) * mean, part)
    at_row, at_column = row.start - low[0], column.start - low[1]
    square[at_row : at_row + part.shape[0], at_column : at_column + part.shape[1]] = part
    from PIL import Image  # imported here, as the recipe key does not need it

    image = Image.fromarray(np.clip(square + 0.5, 0, 255).astype(np.uint8))
    image = image.resize((size[1], size[0]), Image.Resampling.BICUBIC)
    return np.asarray(image, np.float32) / 255


def normalise(pictures: np.ndarray, spec: ModelSpec) -> np.ndarray:
    """Convert pictures (..., 3) in [0, 1] to the range that the model expects: ``(rgb - mean) / std``."""
    return ((pictures - np.asarray(spec.mean, np.float32)) / np.asarray(spec.std, np.float32)).astype(np.float32)
