"""The contract of extractors, which compute the local features of an image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from gsmap.types.localization import Keypoints
from gsmap.types.model import ModelSpec


class Extractor(Protocol):
    """A local feature extractor."""

    def extract(self, rgb: np.ndarray) -> Keypoints:
        """Extract the features of an image.

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
    """The interface of an extractor module or object.

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
        """Create an extractor.

        Args:
            models: checked ONNX models by kind, those of ``MODELS`` among them.
            params: of this method's ``Params``.

        Raises:
            InputError, NotFoundError: a model's file is gone or is not the one that was checked.
        """
        ...

    def probe(self, spec: ModelSpec) -> None:
        """Raise an error for an unsuitable model of a kind in ``MODELS``; called when a model is added to a map.

        Raises:
            InputError: its inputs and outputs do not fit, or it does not run.
        """
        ...
