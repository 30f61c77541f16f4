"""The contract of segmenters, which find masks of objects in renders of a scene."""

from __future__ import annotations

from typing import Any, Protocol

from gsmap.types.model import ModelSpec
from gsmap.types.views import Mask, SceneContext, View


class Segmenter(Protocol):
    """A segmenter for one scene; called from several threads if it and the embedder say ``is_thread_safe = True``."""

    def segment(self, view: View) -> list[Mask]:
        """Return the masks of a view, in any order; masks may overlap.

        Args:
            view: a render: colour (H, W, 3) uint8, depth (H, W) in scene units.

        Returns:
            Masks whose ``pixels`` are (H, W) bool and whose ``confidence`` is in [0, 1].

        Raises:
            InputError: a model does not run on such a picture.
        """
        ...


class SegmenterMethod(Protocol):
    """The interface of a segmenter module or object.

    Attributes:
        Params: frozen dataclass of its settings, each explained under ``Args:``.
        VERSION: raised whenever its masks change for the same view.
        MODELS: kinds of the ONNX models that it needs, such as ``("sam-encoder", "sam-decoder")``; empty where it needs
            none. ``auto`` takes the first segmenter, in alphabetical order, that needs models and has them all.
        probe: only where ``MODELS`` names any.
    """

    Params: type[Any]
    VERSION: int
    MODELS: tuple[str, ...]

    def make(self, context: SceneContext, params: Any) -> Segmenter:
        """Create a segmenter for one scene, before its first view.

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
