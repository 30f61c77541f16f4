"""Networks that stand in for SAM and CLIP, whose weights may not be had: DeepLab's classes and MobileNet's features.

DeepLab knows 20 classes of things and gives one mask a class; its connected parts are taken for things. It is made a
segmenter by an entry point, as another package would add one.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from gsmap.networks.session import misfit, open_session, run
from gsmap.types.model import ModelSpec
from gsmap.types.views import Mask, SceneContext, View

VERSION = 1
MODELS = ("deeplab",)
SCALING = "mean=0.501961,0.501961,0.501961;std=0.501961,0.501961,0.501961"  # (rgb - 128) / 128
DEEPLAB, MOBILENET = "deeplabv3_mnv2_pascal.onnx", "mobilenet_v1_embedding.onnx"


@dataclass(frozen=True)
class Params:
    """Which parts of a class are things.

    Args:
        min_area: parts of a smaller share of the image are dropped.
    """

    min_area: float = 0.002


def make(context: SceneContext, params: Params) -> DeepLab:
    """Open the model; see `gsmap.methods.segmenter`."""
    return DeepLab(params, context.models["deeplab"])


def probe(spec: ModelSpec) -> None:
    """Refuse what gives no map of classes."""
    if len(spec.inputs) != 1 or len(spec.outputs) != 1 or len(spec.outputs[0].shape) != 4:
        raise misfit(spec, "it takes one picture and gives (1, classes, H, W)")


class DeepLab:
    """Connected parts of the classes of a view."""

    def __init__(self, params: Params, spec: ModelSpec) -> None:
        self.params, self.spec, self.session = params, spec, open_session(spec)

    def segment(self, view: View) -> list[Mask]:
        """One mask per connected part of a class; sure by its mean probability. Background (class 0) is no thing."""
        height, width = view.rgb.shape[:2]
        side = self.spec.inputs[0].shape[-1] or 513
        scale = side / max(height, width)
        size = round(width * scale), round(height * scale)
        picture = np.zeros((side, side, 3), np.float32)
        small = np.asarray(Image.fromarray(view.rgb).resize(size, Image.Resampling.BILINEAR), np.float32) / 255
        picture[: size[1], : size[0]] = (small - np.array(self.spec.mean)) / np.array(self.spec.std)
        logits = run(self.spec, self.session, None, {self.spec.inputs[0].name: picture.transpose(2, 0, 1)[None]})[0][0]
        share = np.exp(logits - logits.max(0))
        share = (share / share.sum(0))[:, : size[1], : size[0]]
        rows = np.minimum((np.arange(height) * scale).astype(int), size[1] - 1)
        columns = np.minimum((np.arange(width) * scale).astype(int), size[0] - 1)
        share = share[:, rows][:, :, columns]
        classes, masks = share.argmax(0), []
        for kind in np.unique(classes[classes > 0]):
            labels, count = ndimage.label(classes == kind)
            for part in range(1, count + 1):
                pixels = labels == part
                if pixels.mean() >= self.params.min_area:
                    masks.append(Mask(pixels, float(share[kind][pixels].mean())))
        return masks


def install(folder: Path) -> None:
    """Make this module the segmenter ``deeplab`` of this process."""
    info = folder / "bench_paper_networks-1.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-paper-networks\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[gsmap.segmenters]\ndeeplab = {__name__}\n")
    sys.path.append(str(folder))
