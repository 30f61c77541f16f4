"""Rooms, decorated and furnished from a seed: shell, windows, furniture, pictures, doors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gsmap_synthetic import textures as tx
from gsmap_synthetic.furniture import PIECES, ROOMS, Piece, colour, palette, timber
from gsmap_synthetic.layout import door_clearance, door_spans, find_spot, free_spot, walls
from gsmap_synthetic.plan import WALL_M, Door, Room
from gsmap_synthetic.surfaces import Surfaces

CEILING_M = 2.55
_DOOR_HEIGHT_M = 2.05


def build_room(surfaces: Surfaces, room: Room, index: int, doors: list[Door]) -> Room:
    """Add a room to ``surfaces``; returns it with its obstacles."""
    rng = np.random.default_rng([room.seed, 2])
    s = replace(surfaces.at(room.rect_m[0], room.rect_m[1]), room=index)
    spans = door_spans(room, index, doors)
    _build_shell(s, rng, room, spans)
    taken = [list(span) for span in spans]
    outside = [all(not span for span in spans) or _is_outer(room, wall, index, doors) for wall in range(4)]
    _place_windows(s, rng, room, taken, outside)
    if room.layout_seed is None:
        obstacles = _place_furniture(s, rng, room, spans, taken)
        _place_pictures(s, rng, room, taken)
    else:  # The pictures hang where they do in every room so decorated, whatever comes to stand before them.
        beside = [list(spans) for spans in taken]
        _place_pictures(s, rng, room, taken)
        obstacles = _place_furniture(s, np.random.default_rng([room.layout_seed, 4]), room, spans, beside)
    return replace(room, obstacles_m=obstacles)


def _is_outer(room: Room, wall: int, index: int, doors: list[Door]) -> bool:
    """Whether a wall may have a window: it has no doorway (a window onto a neighbour's wall does no harm)."""
    return not door_spans(room, index, doors)[wall]


def _build_shell(s: Surfaces, rng: np.random.Generator, room: Room, spans) -> None:
    """Floor, ceiling with a lamp, walls with their doorways, and trim."""
    w, d = room.size_m
    seed = int(rng.integers(1 << 20))
    pale, deep = colour(rng, saturation=(0.08, 0.55), value=(0.6, 0.95)), colour(rng, value=(0.3, 0.7))
    floors = [
        tx.planks(timber(rng), seed, rng.uniform(0.1, 0.2), bool(rng.integers(2))),
        tx.tiles(
            colour(rng, saturation=(0.05, 0.4), value=(0.4, 0.9)),
            colour(rng, value=(0.2, 0.6)),
            seed,
            rng.uniform(0.2, 0.45),
            int(rng.integers(3)),
        ),
        tx.fabric(
            colour(rng, value=(0.3, 0.6)),
            colour(rng, value=(0.2, 0.5)),
            seed,
            int(rng.integers(4)),
            rng.uniform(0.3, 0.6),
        ),
    ]
    liked = {"bathroom": 1, "kitchen": int(rng.integers(2)), "bedroom": int(rng.choice([0, 2]))}
    s.object("floor", "shell").rectangle([0, 0, 0], [w, 0, 0], [0, d, 0], floors[liked.get(room.kind, 0)])
    shell = s.object("trim", "shell")
    ceiling = s.object("ceiling", "shell")
    ceiling.rectangle([0, d, CEILING_M], [w, 0, 0], [0, -d, 0], tx.plaster(np.full(3, 0.8), seed + 1))
    papers = [
        tx.plaster(pale, seed + 2),
        tx.wallpaper(pale, 0.6 * pale + 0.4 * deep, seed + 2, int(rng.integers(4)), rng.uniform(0.1, 0.3)),
    ]
    upper = [papers[int(rng.random() < 0.4)]] * 4
    if rng.random() < 0.6:  # One wall in another colour.
        upper[int(rng.integers(4))] = tx.plaster(deep, seed + 3)
    panel_m = rng.uniform(0.8, 1.15) if rng.random() < 0.5 or room.kind == "bathroom" else 0.0
    lower = tx.wood(timber(rng), seed + 4, True)
    if room.kind in ("bathroom", "kitchen"):
        lower = tx.tiles(
            colour(rng, saturation=(0.1, 0.5), value=(0.5, 0.9)), deep, seed + 4, 0.15, int(rng.integers(3))
        )
    trim = tx.wood(timber(rng), seed + 5)
    for wall, (x, y, yaw, length) in enumerate(walls(room.size_m)):
        f = shell.at(x, y, 0, yaw)
        paper = s.at(x, y, 0, yaw).object("wall", "wall", wall=wall, span_m=(-length / 2, length / 2))
        cuts = sorted(spans[wall])
        edges = [-length / 2, *(e for cut in cuts for e in cut), length / 2]
        for x0, x1 in zip(edges[::2], edges[1::2], strict=True):
            if panel_m:
                f.rectangle([x1, 0, 0], [x0 - x1, 0, 0], [0, 0, panel_m], lower, (-x1, 7.0 * wall))
                f.box((x0 + x1) / 2, 0.012, panel_m, x1 - x0, 0.024, 0.05, trim)
            high = [0, 0, CEILING_M - panel_m]
            paper.rectangle([x1, 0, panel_m], [x0 - x1, 0, 0], high, upper[wall], (-x1, 7.0 * wall))
            f.box((x0 + x1) / 2, 0.008, 0, x1 - x0, 0.016, 0.09, trim)
        for x0, x1 in cuts:
            high = [0, 0, CEILING_M - _DOOR_HEIGHT_M]
            paper.rectangle([x1, 0, _DOOR_HEIGHT_M], [x0 - x1, 0, 0], high, upper[wall], (-x1, 3.0))
            f.box((x0 + x1) / 2, 0.015, _DOOR_HEIGHT_M, x1 - x0 + 0.16, 0.03, 0.08, trim)
            for edge in (x0 - 0.04, x1 + 0.04):
                f.box(edge, 0.015, 0, 0.08, 0.03, _DOOR_HEIGHT_M, trim)
    if rng.random() < 0.35:
        beam = tx.wood(timber(rng) * 0.6, seed + 6)
        for x in np.arange(0.5 + rng.uniform(0, 0.4), w - 0.3, rng.uniform(0.8, 1.2)):
            ceiling.box(x, d / 2, CEILING_M - 0.12, 0.12, d, 0.12, beam)
    _pendant(s.at(w / 2 + rng.uniform(-0.3, 0.3), d / 2 + rng.uniform(-0.3, 0.3)), rng)


def _pendant(s: Surfaces, rng: np.random.Generator) -> None:
    s = s.object("pendant", "lamp")
    drop, radius, warm = (
        rng.uniform(0.3, 0.45),
        rng.uniform(0.16, 0.28),
        colour(rng, (0.07, 0.14), (0.08, 0.3), (0.95, 1.0)),
    )
    s.lathe(0, 0, CEILING_M - drop, [(0.006, 0), (0.006, drop)], tx.plain(np.full(3, 0.05)), 5)
    tint = colour(rng, value=(0.5, 0.95))
    profile = [(radius, 0), (radius * rng.uniform(0.3, 0.9), 0.2)]
    s.lathe(
        0,
        0,
        CEILING_M - drop - 0.1,
        profile,
        tx.fabric(tint, warm, int(rng.integers(99)), int(rng.integers(4)), 0.07),
        14,
        glow=0.5,
    )
    s.lamp(0, 0, CEILING_M - drop - 0.14, warm * 3.6, 0.14)


def build_door(surfaces: Surfaces, door: Door, index: int, seed: int) -> None:
    """The inside of a doorway's frame, its threshold, and the leaf that is there while the door is shut."""
    rng = np.random.default_rng([seed, 3])
    lining = tx.wood(timber(rng), seed)
    at = surfaces.at(door.xy[0], door.xy[1], 0, 0.0 if door.along_x else np.pi / 2)
    s = at.object("door frame", "shell")
    w, t, h = door.width_m / 2, WALL_M / 2, _DOOR_HEIGHT_M
    s.rectangle([-w, -t, 0], [2 * w, 0, 0], [0, 2 * t, 0], lining)
    s.rectangle([-w, t, h], [2 * w, 0, 0], [0, -2 * t, 0], lining)
    s.rectangle([-w, t, 0], [0, -2 * t, 0], [0, 0, h], lining)
    s.rectangle([w, -t, 0], [0, 2 * t, 0], [0, 0, h], lining)
    s = replace(at.object("door", "door"), leaf=index)
    tone = timber(rng)
    s.box(0, 0, 0.005, 2 * w, 0.04, h - 0.005, tx.wood(tone, seed + 1, True))
    for z, height in ((0.15, 0.7), (1.05, 0.85)):
        for x in (-w / 2, w / 2):
            s.box(x, 0, z, 0.6 * w, 0.055, height, tx.wood(tone * 0.7, seed + 2, True))
    s.lathe(0.82 * w, 0, 1.0, [(0, 0), (0.05, 0.03), (0.05, 0.06), (0, 0.09)], tx.plain(np.full(3, 0.6)), 8)


def _place_windows(s: Surfaces, rng, room: Room, taken, outside) -> None:
    frame = tx.plain(np.full(3, 0.75), 5)
    chosen = [k for k in rng.permutation(4) if outside[k]][: 1 + int(rng.random() < 0.3)]
    for wall in chosen:
        x, y, yaw, length = walls(room.size_m)[wall]
        width, z, height = rng.uniform(0.9, 1.5), rng.uniform(0.9, 1.05), rng.uniform(1.0, 1.2)
        at = free_spot(rng, taken[wall], length, width + 0.5)
        if at is None:
            continue
        span = (at - width / 2 - 0.3, at + width / 2 + 0.3)
        f = s.at(x, y, 0, yaw).at(at, 0, z).object("window", "window", wall=int(wall), span_m=span)
        f.rectangle(
            [width / 2, 0.012, 0], [-width, 0, 0], [0, 0, height], tx.outdoors(int(rng.integers(1 << 20))), glow=1.0
        )
        for k in range(3):
            f.box((k - 1) * width / 2, 0.02, 0, 0.05, 0.04, height, frame)
        for zz in (-0.05, height):
            f.box(0, 0.03, zz, width + 0.1, 0.06, 0.05, frame)
        cloth = tx.fabric(colour(rng), colour(rng), int(rng.integers(1 << 20)), int(rng.integers(4)))
        for side in (-1, 1):
            f.box(side * (width / 2 + 0.14), 0.06, -0.75, 0.22, 0.06, height + 0.95, cloth)
        f.lamp(0, 0.45, height / 2, np.array([1.0, 1.08, 1.25]) * 1.6, 0.3)
        taken[wall].append(span)


def _place_furniture(s: Surfaces, rng, room: Room, spans, taken) -> np.ndarray:
    """Put the pieces the kind of room asks for where they fit; returns footprints of tall ones, place frame."""
    w, d = room.size_m
    used = door_clearance(room, spans)
    obstacles = []
    names = ROOMS.get(room.kind, ["drawers", "plant", "bookshelf", "floor lamp", "armchair"])

    def look(k: int) -> np.random.Generator:
        """What decides the look of the k-th piece."""
        return rng if room.layout_seed is None else np.random.default_rng([room.seed, 5, k])

    for k, name in enumerate(names):
        piece, built = PIECES[name], look(k)
        width, depth = built.uniform(*piece.width_m), built.uniform(*piece.depth_m)
        spot = find_spot(rng, room, piece, (width, depth), used, taken)
        if spot is None:
            continue
        add_piece(spot.frame(s), name, piece, built, (width, depth))
        used.append(spot.rect_m)
        if piece.covers_wall:
            taken[spot.wall].append((spot.dx - width / 2, spot.dx + width / 2))
        if piece.tall:
            obstacles.append(spot.rect_m + np.tile(room.rect_m[:2], 2))
    rw, rd = rng.uniform(0.4, 0.6) * w, rng.uniform(0.4, 0.6) * d
    cx, cy = rng.uniform(0.42, 0.58) * w, rng.uniform(0.42, 0.58) * d
    s, woven = s.object("rug", "rug"), look(len(names))
    top = tx.rug(palette(woven), int(woven.integers(1 << 20)))
    s.box(cx, cy, 0.001, rw, rd, 0.012, tx.plain(np.full(3, 0.3)), top=top)
    return np.array(obstacles).reshape(-1, 4)


def add_piece(s: Surfaces, name: str, piece: Piece, rng, size_m: tuple[float, float], **facts: Any) -> None:
    """Build a piece of furniture, or a small thing, in the local frame of ``s``."""
    kind = "small" if piece.small else "furniture"
    piece.build(s.object(name, kind, size_m=size_m, symmetry=piece.symmetry, **facts), rng, *size_m)


def _place_pictures(s: Surfaces, rng, room: Room, taken) -> None:
    for wall, (x, y, yaw, length) in enumerate(walls(room.size_m)):
        for _ in range(int(rng.integers(2, 5))):
            width, height = rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.7)
            at = free_spot(rng, taken[wall], length, width)
            if at is None:
                continue
            span = (at - width / 2, at + width / 2)
            f = s.at(x, y, 0, yaw).at(at, 0.015, rng.uniform(1.35, 1.6) - height / 2)
            f = f.object("picture", "picture", wall=wall, span_m=span)
            print_ = tx.picture(palette(rng, int(rng.integers(4, 7))), int(rng.integers(1 << 20)), int(rng.integers(4)))
            f.box(0, 0, 0, width, 0.03, height, tx.wood(timber(rng) * 0.5, int(rng.integers(99))), front=print_)
            taken[wall].append((at - width / 2, at + width / 2))
