"""The contract of embedders, which compute a feature vector for each mask of a view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from gsmap.types.model import ModelSpec
from gsmap.types.views import Mask, SceneContext, View


class Embedder(Protocol):
    """An embedder for one scene; the cosine of two embeddings measures similarity. It is called from
    several threads, for different views, if it and the segmenter say ``is_thread_safe = True``.

    They depend on the method, its parameters and its model alone beside what is seen, so that those of all scenes
    compare.
    """

    def embed(self, view: View, masks: Sequence[Mask], points: Sequence[np.ndarray]) -> np.ndarray:
        """Compute the features of all masks of a view.

        Args:
            view: the render that the masks are parts of.
            masks: R of them, perhaps none.
            points: R arrays (n, 3) float64 of the surface points that each mask shows, scene frame and unit.

        Returns:
            (R, F) float32 unit vectors.

        Raises:
            InputError: a model does not run on such pictures.
        """
        ...


class PictureEmbedder(Embedder, Protocol):
    """An embedder that can also embed an image of one object."""

    def embed_picture(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Embed an image that shows one object and little else.

        Args:
            rgb: (H, W, 3) uint8.

        Returns:
            (F,) float32 features, comparable with those of masks; and (F,) bool, which of them a picture can tell:
            the others do not count.
        """
        ...


class EmbedderMethod(Protocol):
    """The interface of an embedder module or object.

    Attributes:
        Params: frozen dataclass of its settings, each explained under ``Args:``.
        VERSION: raised whenever its features change for the same masks.
        MODELS: kinds of the ONNX models that it needs, such as ``("clip",)``; empty where it needs none. ``auto`` takes
            the first embedder, in alphabetical order, that needs models and has them all.
        probe: only where ``MODELS`` names any.
        embed_text: only where there is a text tower to its vectors: ``embed_text(text, models)`` gives (F,) float32.
    """

    Params: type[Any]
    VERSION: int
    MODELS: tuple[str, ...]

    def make(self, context: SceneContext, params: Any) -> Embedder:
        """Create an embedder for one scene, before its first view.

        Args:
            context: the scene's surface (scene frame and unit), what is up, the metre, and the models, of which those
                of ``MODELS`` are there.
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
