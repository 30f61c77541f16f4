"""Extract local features by a network in an ONNX file of the user: SuperPoint, ALIKED, DISK, XFeat or another.

The network takes one image, (1, 1, H, W) grey or (1, 3, H, W) rgb, and returns keypoints (N, 2), descriptors (N, D) and
optionally scores (N,), with or without a batch dimension of one, as the published exports do. Keypoints are pixels with
centres at whole numbers (SuperPoint, DISK, XFeat), or lie in [-1, 1] over the image (ALIKED).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image

from gsmap.errors import InputError
from gsmap.networks.session import misfit, open_session, run
from gsmap.settings.ranges import require_range
from gsmap.types.localization import Keypoints
from gsmap.types.model import ModelSpec

VERSION = 1
MODELS = ("extractor",)

_MULTIPLE = 32  # image sides are multiples of this, which all these networks accept


@dataclass(frozen=True)
class Params:
    """Settings of the extractor ``onnx``.

    Args:
        max_features: Largest number of features per image, at least 1, the highest scores first; larger localizes more
            photos and is slower.
        min_score: Smallest score, in the unit of the network, of a feature that is kept; larger keeps fewer features.
    """

    max_features: int = 1500
    min_score: float = 0.0

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "max_features")


def make(models: Mapping[str, ModelSpec], params: Params) -> OnnxExtractor:
    """Load the network; see `gsmap.methods.extractor`."""
    return OnnxExtractor(models["extractor"], params)


def probe(spec: ModelSpec) -> None:
    """Reject a model that is no extractor, by running it once.

    Raises:
        InputError: the model's inputs or outputs do not fit, or it fails.
    """
    shape = spec.inputs[0].shape if len(spec.inputs) == 1 else ()
    if len(shape) != 4 or shape[1] not in (1, 3, None):
        raise misfit(spec, "an extractor has one input of shape (1, 1, H, W) or (1, 3, H, W)")
    picture = np.random.default_rng(0).integers(0, 255, (192, 256, 3)).astype(np.uint8)
    OnnxExtractor(spec, Params()).extract(picture)


class OnnxExtractor:
    """An extractor that runs the network on one image at a time; size, channels and names come from the model."""

    def __init__(self, spec: ModelSpec, params: Params) -> None:
        self.spec, self.params = spec, params
        self.session = open_session(spec)
        _, channels, self.height, self.width = spec.inputs[0].shape
        self.grey = channels == 1

    def extract(self, rgb: np.ndarray) -> Keypoints:
        """Extract the features of an image; see `gsmap.methods.extractor`."""
        height, width = (self.height or _round_side(rgb.shape[0])), (self.width or _round_side(rgb.shape[1]))
        image = Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR)
        real = np.asarray(image, np.float32) / 255
        if self.grey:
            real = (real @ np.array([0.299, 0.587, 0.114], np.float32))[..., None]
        dtype = np.float16 if self.spec.inputs[0].dtype == "float16" else np.float32
        feed = {self.spec.inputs[0].name: np.ascontiguousarray(real.transpose(2, 0, 1)[None], dtype)}
        names = [tensor.name for tensor in self.spec.outputs]
        outputs = dict(zip(names, run(self.spec, self.session, names, feed), strict=True))
        pixels, descriptors, scores = self._read(outputs)
        if len(pixels) and np.abs(pixels).max() <= 1.0 + 1e-6:  # relative to the image, as ALIKED gives them
            pixels = (pixels + 1) / 2 * (np.array([width, height]) - 1)
        pixels = (pixels + 0.5) * [rgb.shape[1] / width, rgb.shape[0] / height]
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] >= self.params.min_score][: self.params.max_features]
        vectors = descriptors[order].astype(np.float32)
        vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
        return Keypoints(pixels[order].astype(np.float32), vectors)

    def _read(self, outputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (N, 2) keypoints, (N, D) descriptors and (N,) scores from the network's outputs.

        Raises:
            InputError: the outputs do not fit.
        """
        flat = {name: value[0] if value.ndim > 1 and len(value) == 1 else value for name, value in outputs.items()}
        pixels = _find_output(flat, ("keypoint", "kpts", "points"), lambda v: v.ndim == 2 and v.shape[1] == 2)
        descriptors = _find_output(flat, ("desc", "feat"), lambda v: v.ndim == 2 and min(v.shape) != 2)
        if pixels is None or descriptors is None:
            found = ", ".join(f"{name} {list(value.shape)}" for name, value in outputs.items())
            raise InputError(
                f"{self.spec.path} is no extractor: its outputs are {found or 'empty'}, but keypoints (N, 2) and "
                "descriptors (N, D) are needed",
                code="model_misfit",
            )
        if len(descriptors) != len(pixels) and descriptors.shape[1] == len(pixels):
            descriptors = descriptors.T
        scores = _find_output(flat, ("score", "conf"), lambda v: v.ndim == 1)
        if scores is None or len(scores) != len(pixels):
            scores = np.zeros(len(pixels))
        finite = np.isfinite(descriptors.astype(np.float32)).all(1) if len(descriptors) == len(pixels) else None
        if finite is None or not finite.all():
            raise InputError(
                f"{self.spec.path} returned {len(descriptors)} descriptors for {len(pixels)} keypoints, or NaN",
                code="model_misfit",
            )
        return pixels.astype(np.float64), descriptors, scores.astype(np.float64)


def _find_output(outputs: Mapping[str, np.ndarray], words: tuple[str, ...], fits) -> np.ndarray | None:  # type: ignore[no-untyped-def]
    """Return the output with a fitting shape whose name contains one of the words; by default the only output that
    fits."""
    fitting = {name: value for name, value in outputs.items() if fits(value)}
    named = [value for name, value in fitting.items() if any(word in name.lower() for word in words)]
    if named:
        return named[0]
    return next(iter(fitting.values())) if len(fitting) == 1 else None


def _round_side(side: int) -> int:
    """Round the side of an image to a multiple of 32."""
    return max(_MULTIPLE, round(side / _MULTIPLE) * _MULTIPLE)
