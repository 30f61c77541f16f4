"""Captures of one wall at several dates, between which things before it come, go and are painted."""

import numpy as np
from synthetic_walls import cameras_facing, texture, wall

from gsmap.merge import PosedScene
from gsmap.types import Gaussians

BOX = {"low": -0.2, "high": 0.2, "z": -0.5, "half_height": 0.15}


def box(seed, colour=lambda x, y: 1 - texture(x, y)):
    """A small panel half a metre before the wall."""
    return wall(seed, BOX["low"], BOX["high"], z=BOX["z"], colour=colour, half_height=BOX["half_height"])


def plain(x, y):
    """A wall without texture, in a pale colour that changes slowly."""
    return np.stack([0.6 + 0.05 * np.sin(x), 0.55 + 0.05 * np.cos(y), 0.5 + 0 * x], axis=-1)


def patched(x, y):
    """The same with a patch painted blue."""
    blue = ((np.abs(x) < 0.3) & (np.abs(y) < 0.25))[:, None]
    return np.where(blue, [0.2, 0.3, 0.7], plain(x, y))


def dated(name, year, *parts, cameras=None):
    """A capture of a year, of what stands there."""
    cameras = cameras_facing(np.linspace(-0.6, 0.6, 7)) if cameras is None else cameras
    return PosedScene(Gaussians.concatenate(list(parts)), cameras, name, f"{year}-01-01T00:00:00+00:00")
