"""Change a built place: move, remove, add and paint things, and light it as by day or by night.

Objects keep their ids through edits, so what one id means can be followed through all times of a place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import ConfigError
from gsmap_synthetic import textures as tx
from gsmap_synthetic.bake import bake, mean_albedo
from gsmap_synthetic.furniture import PIECES, colour, palette
from gsmap_synthetic.layout import outline
from gsmap_synthetic.place import Place
from gsmap_synthetic.rooms import add_piece
from gsmap_synthetic.small import SMALL
from gsmap_synthetic.surfaces import Surfaces
from gsmap_synthetic.textures import Material

LIGHTS = ("day", "night")
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_NIGHT_TINT = np.array([1.1, 0.9, 0.62])  # Warm lamps, for which a camera's white balance makes up in part.


@dataclass(frozen=True, eq=False)
class Move:
    """An object goes to another pose of its frame in the place."""

    object: int
    T_place_object: np.ndarray


@dataclass(frozen=True)
class Remove:
    """An object is taken away."""

    object: int


@dataclass(frozen=True, eq=False)
class Add:
    """A piece of `PIECES` or `SMALL` is built from ``seed`` at a pose, perhaps in place of an object."""

    piece: str
    room: int
    T_place_object: np.ndarray
    size_m: tuple[float, float]
    seed: int
    replaces: int = -1


@dataclass(frozen=True)
class Paint:
    """An object gets other colours: a wall new paint, a picture another print, all else another colour all over."""

    object: int
    seed: int


Edit = Move | Remove | Add | Paint


def edit_place(place: Place, edits: Sequence[Edit] = (), *, light: str = "day", texel_m: float | None = None) -> Place:
    """The place after ``edits``, one after another, lit anew.

    Args:
        light: "day", or "night" when only lamps shine.
        texel_m: how fine the baked colours are; by default as fine as the place's.

    Raises:
        ConfigError: an edit of what is not there, or an unknown light.
    """
    if light not in LIGHTS:
        raise ConfigError(f"light is one of {', '.join(LIGHTS)}, got {light!r}")
    surfaces = place.surfaces.copy()
    touched = {surfaces.objects[apply(surfaces, edit)].room for edit in edits}
    rooms = tuple(
        replace(room, obstacles_m=_obstacles(surfaces, i)) if i in touched else room
        for i, room in enumerate(place.rooms)
    )
    skin = bake(surfaces if light == "day" else _by_night(surfaces), texel_m=texel_m or place.skin.texel_m)
    return Place(place.seed, rooms, place.doors, skin, surfaces)


def apply(surfaces: Surfaces, edit: Edit) -> int:
    """Make one edit in place; returns the id of its object, for `Add` the new one.

    Raises:
        ConfigError: an edit of what is not there.
    """
    if isinstance(edit, Add):
        piece = {**PIECES, **SMALL}.get(edit.piece)
        if piece is None:
            raise ConfigError(f"there is no piece {edit.piece!r}: pieces are {', '.join([*PIECES, *SMALL])}")
        rng = np.random.default_rng([edit.seed, 11])
        frame = surfaces.in_frame(np.asarray(edit.T_place_object, np.float64), edit.room)
        add_piece(frame, edit.piece, piece, rng, edit.size_m, replaces=edit.replaces)
        return len(surfaces.objects) - 1
    subject = edit.object
    if not 0 <= subject < len(surfaces.objects) or not surfaces.objects[subject].present:
        raise ConfigError(f"cannot edit object {subject}: it is not in the place")
    match edit:
        case Move():
            _move(surfaces, subject, np.asarray(edit.T_place_object, np.float64))
        case Remove():
            gone = set(surfaces.of(subject).tolist())
            lamps = [i for i, owner in enumerate(surfaces.lamp_owners) if owner != subject]
            surfaces.keep((q for q in range(len(surfaces.corners)) if q not in gone), lamps)
            surfaces.objects[subject] = replace(surfaces.objects[subject], present=False)
        case Paint():
            _paint(surfaces, subject, edit.seed)
    return subject


def _move(surfaces: Surfaces, subject: int, T_place_object: np.ndarray) -> None:
    T_after_before = T_place_object @ np.linalg.inv(surfaces.objects[subject].T_place_object)
    rotation, shift = T_after_before[:3, :3], T_after_before[:3, 3]
    for q in surfaces.of(subject):
        surfaces.corners[q] = surfaces.corners[q] @ rotation.T + shift
    for i, owner in enumerate(surfaces.lamp_owners):
        if owner == subject:
            at, light, radius_m = surfaces.lamps[i]
            surfaces.lamps[i] = (rotation @ at + shift, light, radius_m)
    surfaces.objects[subject] = replace(surfaces.objects[subject], T_place_object=T_place_object)


def _paint(surfaces: Surfaces, subject: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 13])
    thing, quads = surfaces.objects[subject], surfaces.of(subject)
    mean = mean_albedo(surfaces, quads)
    if thing.kind == "picture":  # Its first quad is the print, the rest its frame.
        prints = [palette(rng, 5) for _ in range(8)]
        chosen = max(prints, key=lambda colours: _difference(colours.mean(0), mean))
        style = int(rng.integers(4))
        surfaces.materials[quads[0]] = tx.picture(chosen, int(rng.integers(1 << 20)), style)
    elif thing.kind == "wall":
        paint = tx.plaster(_unlike(rng, mean), int(rng.integers(1 << 20)))
        for q in quads:
            surfaces.materials[q] = paint
    else:
        chosen, luminance = _unlike(rng, mean), float(mean @ _LUMINANCE)
        for q in quads:
            surfaces.materials[q] = tx.repainted(surfaces.materials[q], chosen, luminance)
    surfaces.objects[subject] = replace(thing, paint=seed)


def _unlike(rng: np.random.Generator, old: np.ndarray) -> np.ndarray:
    """The one of some random colours that differs most from ``old``."""
    candidates = [colour(rng, saturation=(0.3, 0.8), value=(0.4, 0.9)) for _ in range(6)]
    return max(candidates, key=lambda new: _difference(new, old))


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    """Of two linear-light colours, as a display shows them."""
    return float(np.linalg.norm(np.clip(a, 0, 1) ** (1 / 2.2) - np.clip(b, 0, 1) ** (1 / 2.2)))


def _obstacles(surfaces: Surfaces, room: int) -> np.ndarray:
    tall = (o for o in surfaces.objects if o.present and o.room == room and o.name in PIECES and PIECES[o.name].tall)
    return np.array([outline(o.T_place_object, o.size_m) for o in tall]).reshape(-1, 4)


def _by_night(surfaces: Surfaces) -> Surfaces:
    """The same surfaces with dark windows: only lamps shine, in their warm colour."""
    night = surfaces.copy()
    windows = {o.id for o in surfaces.objects if o.kind == "window"}
    for q, owner in enumerate(night.owners):
        if owner in windows and night.glows[q] > 0:
            night.materials[q], night.glows[q] = _dark(night.materials[q]), 0.0
    kept = [i for i, owner in enumerate(night.lamp_owners) if owner not in windows]
    night.keep(range(len(night.corners)), kept)
    night.lamps[:] = [(at, light * _NIGHT_TINT, radius_m) for at, light, radius_m in night.lamps]
    return night


def _dark(material: Material) -> Material:
    """What a window shows by night."""
    return lambda u, v, size: material(u, v, size) * np.array([0.02, 0.025, 0.04], np.float32)
