"""Segmenters: one file each; from a view to masks with a confidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gsmap.describe.cloud import Cloud
from gsmap.describe.models import ModelSpec
from gsmap.describe.views import View
from gsmap.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Mask:
    """A part of a view.

    Args:
        pixels: (H, W) bool.
        confidence: how sure the segmenter is of it, in [0, 1].
        part: masks of one part show one thing in all views, where the segmenter knows; they need not be associated.
    """

    pixels: np.ndarray
    confidence: float
    part: int | None = None


class Segmenter(Protocol):
    """Finds masks, view by view."""

    def segment(self, view: View) -> list[Mask]: ...


SEGMENTERS = ("builtin", "sam")


def params_of(name: str) -> object:
    """The default parameters of a segmenter.

    Raises:
        ConfigError: no segmenter of that name.
    """
    if name == "builtin":
        from gsmap.describe.segmenters import builtin as module
    elif name == "sam":
        from gsmap.describe.segmenters import sam as module
    else:
        raise ConfigError(f"there is no segmenter {name!r}; choose {' or '.join(SEGMENTERS)}")
    return module.Params()


def make_segmenter(
    name: str, params: object, cloud: Cloud, num_gaussians: int, models: Mapping[str, ModelSpec]
) -> Segmenter:
    """A segmenter ready for the views of one scene.

    Raises:
        ConfigError: no segmenter of that name, or its models were not given.
    """
    if name == "builtin":
        from gsmap.describe.segmenters.builtin import BuiltinSegmenter

        return BuiltinSegmenter(params, cloud, num_gaussians)
    params_of(name)
    from gsmap.describe.segmenters.sam import SamSegmenter

    missing = [kind for kind in ("sam-encoder", "sam-decoder") if kind not in models]
    if missing:
        raise ConfigError(f"segmenter sam needs the models {' and '.join(missing)}: add them with `gsmap models add`")
    return SamSegmenter(params, models["sam-encoder"], models["sam-decoder"])
