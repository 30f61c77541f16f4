"""The contract of an extractor: from a picture to local features that are found again in other pictures of a place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from gsmap.types.localization import Keypoints
from gsmap.types.model import ModelSpec


class Extractor(Protocol):
    """An extractor ready for pictures."""

    def extract(self, rgb: np.ndarray) -> Keypoints:
        """Features of a picture.

        Args:
            rgb: (H, W, 3) uint8: a photograph, or a render of a scene.

        Returns:
            Perhaps none. What matters most comes first, where the method can tell. The descriptors of one method, with
            its parameters and models, compare by their dot product, whatever picture they are of. The same picture
            gives the same features.

        Raises:
            InputError: a model does not run on such pictures.
        """
        ...


class ExtractorMethod(Protocol):
    """What a module (or object) offers to be an extractor.

    Attributes:
        Params: frozen dataclass of its settings, each explained under ``Args:``.
        VERSION: raised whenever its features change for the same picture.
        MODELS: kinds of the ONNX models that it needs, such as ``("extractor",)``; empty where it needs none.
        probe: only where ``MODELS`` names any.
    """

    Params: type[Any]
    VERSION: int
    MODELS: tuple[str, ...]

    def make(self, models: Mapping[str, ModelSpec], params: Any) -> Extractor:
        """An extractor.

        Args:
            models: checked ONNX models by kind, those of ``MODELS`` among them.
            params: of this method's ``Params``.

        Raises:
            InputError, NotFoundError: a model's file is gone or is not the one that was checked.
        """
        ...

    def probe(self, spec: ModelSpec) -> None:
        """Refuse a model of one of the kinds in ``MODELS`` that cannot do its work; called when it is added to a map.

        Raises:
            InputError: its inputs and outputs do not fit, or it does not run.
        """
        ...
