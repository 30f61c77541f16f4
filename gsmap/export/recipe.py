"""Recipes of tiles, and the reasons for making an existing tile again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsmap import formats
from gsmap.errors import ConfigError
from gsmap.export.plan import Params, PlannedTile
from gsmap.formats.axes import PLY, change_axes
from gsmap.geometry.boxes import box_corners
from gsmap.methods import RecipeKey
from gsmap.types import Gaussians, Tile

VERSION = 1
"""Raised whenever the same merged Gaussians are written differently; all tiles are then made again."""

_TILES_3D, _STREAMED_SOG = "3dtiles", "streamed-sog"
_TREES = {_TILES_3D: "glb", _STREAMED_SOG: "sog"}
"""Formats that are a tree of levels over tiles, with the suffix of the tiles."""

UP_AXES = ("y", "z")
_MAP_AXES = "RFU"  # right, front, up: z is up where gravity is known
_MAP_UP_FORMATS = ("ply", *_TREES)


def default_up(format: str) -> str:
    """Return the vertical axis of a format's files.

    Viewers take a trained splat's frame, whose y is down, for upright, and every format has its own axes for it. Files
    for viewers are therefore turned to it. ``.ply`` is read by other programs, which expect the coordinates of poses
    and control points; 3D Tiles have z up by their standard, and the tree of a streamed SOG lies in the map's frame.
    """
    return "z" if format in _MAP_UP_FORMATS else "y"


def upright(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians of the map's axes with the map's up where viewers of trained splats expect it: (x, -z, y)."""
    return change_axes(gaussians, PLY, _MAP_AXES)


def upright_back(gaussians: Gaussians) -> Gaussians:
    """Invert `upright`."""
    return change_axes(gaussians, _MAP_AXES, PLY)


@dataclass(frozen=True, eq=False)
class TileRecipe:
    """The recipe that all tiles of one export share; with a `PlannedTile`, it determines the content of that tile.

    Args:
        merge: recipe of the merger and its settings (`gsmap.merge.recipe_key`).
        format: suffix of the tiles' files without the dot, or a tree of coarser levels over them: ``3dtiles`` (of
            ``.glb``) or ``streamed-sog`` (of ``.sog``).
        provenance: whether the file stores the scene of each Gaussian (``.ply`` only).
        budget_s: limit on the seconds of merging one tile, None for none.
        uncompressed: whether the content of ``3dtiles`` is float32 rather than SPZ.
        dates: capture date of each scene, by scene id, if the merger uses dates; None if it does not.
        without: digest of the Gaussians of each scene that are left out, by scene id, if any.
        unchanged: digest of the places near a tile where changes were rejected, by its component and name, if any.
        warps: digest of the warp of each scene that is merged in another shape, by scene id, if any.
        photos: digest of the photos that a tile is fitted to, by its component and name, if any.
        up: vertical axis of the files: ``z``, that of the map, or ``y``, as viewers of the format expect it
            (`upright`); None takes the format's default (`default_up`).

    Raises:
        ConfigError: unknown format, or one that excludes provenance, uncompressed or the vertical axis.
    """

    merge: RecipeKey
    format: str = "ply"
    provenance: bool = False
    budget_s: float | None = None
    uncompressed: bool = False
    dates: Mapping[str, str | None] | None = None
    without: Mapping[str, str] = field(default_factory=dict)
    unchanged: Mapping[tuple[int, str], str] = field(default_factory=dict)
    photos: Mapping[tuple[int, str], str] = field(default_factory=dict)
    warps: Mapping[str, str] = field(default_factory=dict)
    up: str | None = "z"

    def __post_init__(self) -> None:
        if self.format not in _TREES and not formats.can_write(f".{self.format}"):
            suffixes = [name[1:] for name in formats.known("write") if name.startswith(".")]
            known = ", ".join([*suffixes, *_TREES])
            raise ConfigError(f"cannot write {self.format!r}: choose one of {known}", code="unsupported_output")
        if self.provenance and self.format != "ply":
            raise ConfigError(
                f"only .ply can store provenance, not {self.format}",
                code="unsupported_output",
            )

        if self.up is None:
            object.__setattr__(self, "up", default_up(self.format))
        if self.up not in UP_AXES:
            raise ConfigError(f"the vertical axis is y or z, got {self.up!r}", code="invalid_choice")
        if self.up == "y" and self.is_tree:
            raise ConfigError(
                f"{self.format} has z up, in the map's frame: leave --up y out",
                code="unsupported_output",
            )
        if self.uncompressed and self.format != _TILES_3D:
            raise ConfigError(
                f"uncompressed applies only to {_TILES_3D}, not to {self.format}",
                code="unsupported_output",
            )

    @property
    def is_tileset(self) -> bool:
        """True if the format is 3D Tiles, a tree whose leaves are the tiles."""
        return self.format == _TILES_3D

    @property
    def is_tree(self) -> bool:
        """True if the format is a tree of coarser levels above the tiles."""
        return self.format in _TREES

    @property
    def suffix(self) -> str:
        """Suffix of the tiles' files, without the dot."""
        return _TREES.get(self.format, self.format)

    def with_dates(self, dates: Mapping[str, str | None]) -> TileRecipe:
        """Return the recipe with the dates of scenes, for a merger that uses dates."""
        return replace(self, dates=dates)

    def key(self, planned: PlannedTile) -> str:
        """Return the digest of all inputs of a tile except the poses; scenes enter by id, a digest of their content."""
        written = [
            f"export {VERSION}",
            f"format {self.format}{' spz' * (self.is_tileset and not self.uncompressed)}",
            f"provenance {self.provenance}",
        ]
        if self.up != "z":  # absent for files in the map's axes, whose keys predate it
            written.append(f"up {self.up}")
        return self.merge.of(*written, *self._merge_inputs(planned)).digest

    def merge_key(self, planned: PlannedTile) -> str:
        """Return the digest of all inputs of the tile's merged Gaussians, poses included, whatever file they go to."""
        poses = [f"pose {scene} {pose.matrix().tobytes().hex()}" for scene, pose in sorted(planned.poses.items())]
        return self.merge.of("merged", *self._merge_inputs(planned), *poses).digest

    def _merge_inputs(self, planned: PlannedTile) -> list[str]:
        scenes = sorted(planned.poses)
        inputs = [
            f"budget_s {self.budget_s}",
            f"component {planned.component}",
            f"extent {planned.extent}",
            *(f"scene {scene}" for scene in scenes),
        ]
        if planned.metres_per_unit != 1.0:  # absent for a map in metres, whose keys predate it
            inputs.append(f"metres_per_unit {planned.metres_per_unit!r}")
        if self.dates is not None:
            inputs += [f"captured_at {scene} {self.dates.get(scene)}" for scene in scenes]
        inputs += [f"without {scene} {self.without[scene]}" for scene in scenes if self.without.get(scene)]
        inputs += [f"warp {scene} {self.warps[scene]}" for scene in scenes if scene in self.warps]
        if unchanged := self.unchanged.get((planned.component, planned.name)):
            inputs.append(f"unchanged {unchanged}")
        if photos := self.photos.get((planned.component, planned.name)):
            inputs.append(f"photos {photos}")
        return inputs


def dirty_reason(
    planned: PlannedTile, tile: Tile | None, recipe: TileRecipe, max_shift_m: float = Params.max_shift_m
) -> str:
    """Return the reason why an existing tile must be made again, as text; empty if the tile can be reused.

    Poses are compared with those that the tile was made with, not with the last revision, so that slow drift counts.
    """
    if tile is None:
        return "new"
    if tile.key != recipe.key(planned):
        return _first_change(planned, tile, recipe)
    corners = box_corners(planned.bounds)
    for scene, pose in planned.poses.items():
        # Displacement of the scene at the tile's corners.
        then = tile.poses[scene] @ pose.inverse()
        moved = np.linalg.norm(then.apply(corners) - corners, axis=1).max() * planned.metres_per_unit
        if moved > max_shift_m:
            return f"scene {scene[:12]} moved by {moved:.3g} m"
    return ""


def _first_change(planned: PlannedTile, tile: Tile, recipe: TileRecipe) -> str:
    """Return the first difference between the recipe of an existing tile and that of this export, as text."""
    before, now = tile.recipe, recipe.merge.to_json()
    if before.get("method") != now["method"]:
        return f"another merge method: {before.get('method')}, now {now['method']}"
    for part in ("version", "settings", "backend"):
        if before.get(part) != now[part]:
            return f"another {part} of the merge method: {_difference(before.get(part), now[part])}"
    if set(tile.poses) != set(planned.poses):
        return "other scenes"
    return (
        "a scene's date or warp, the format, axis, budget, extent, metric scale or provenance, the reference photos, "
        "or the rejected changes are others"
    )


def _difference(before: Any, now: Any) -> str:
    """Return the name of the first leaf in which two settings differ, with both values."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            if before.get(name) != now.get(name):
                return f"{name} {_difference(before.get(name), now.get(name))}"
    return f"{before}, now {now}"
