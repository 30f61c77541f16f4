"""A package outside gsmap that adds an embedder, a refiner and a merger to it."""

from dataclasses import dataclass

import numpy as np

from gsmap.types import Gaussians, MergeResult, Sim3


class MeanColour:
    """An embedder: the mean colour of what a mask shows."""

    @dataclass(frozen=True)
    class Params:
        """Nothing to set."""

    VERSION, MODELS = 1, ()

    @classmethod
    def make(cls, context, params):
        return cls()

    def embed(self, view, masks, points):
        means = np.array([view.rgb[mask.pixels].mean(0) + 1 for mask in masks], np.float32).reshape(-1, 3)
        return means / np.linalg.norm(means, axis=1, keepdims=True)


class Nudge:
    """A refiner: a step that brings the means of what lies near each other together."""

    @dataclass(frozen=True)
    class Params:
        """Args:
        reach_m: how far apart points may lie.
        """

        reach_m: float = 0.1

    VERSION, SCALES = 1, False

    @staticmethod
    def refine(target, source, start, params=None, *, with_scale=False):
        moved = start.apply(source.coarse[0])
        apart, row = target.nearest(moved, (params or Nudge.Params()).reach_m)
        near = np.isfinite(apart)
        step = (target.coarse[0][row[near]] - moved[near]).mean(0) if near.any() else np.zeros(3)
        return Sim3(start.rotation, start.translation + step, start.scale) if near.any() else start


class Opaque:
    """A merger: every Gaussian that is opaque enough."""

    @dataclass(frozen=True)
    class Params:
        """Args:
        min_opacity: of what is kept.
        """

        min_opacity: float = 0.5

    VERSION, STEPS, RENDERS = 1, None, False
    reach_m = looking_m = staticmethod(lambda params: 0.0)
    reading_m = staticmethod(lambda params, dated: 0.0)
    min_cameras = staticmethod(lambda params: 0)
    uses_dates = staticmethod(lambda params: False)

    @staticmethod
    def merge(scenes, params, bounds, budget_s, progress):
        every = Gaussians.concatenate([scene.gaussians for scene in scenes])
        origin = np.repeat(np.arange(len(scenes), dtype=np.int32), [len(scene.gaussians) for scene in scenes])
        keep = every.opacities >= params.min_opacity
        return MergeResult(every[keep], origin[keep])
