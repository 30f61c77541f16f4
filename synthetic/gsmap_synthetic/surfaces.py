"""The one primitive synthetic places are built from: textured quadrilaterals, gathered under nested local frames."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from gsmap_synthetic.textures import Material


@dataclass(frozen=True, eq=False)
class PlaceObject:
    """A thing in a place: what belongs together, may be moved, and is told apart in truth.

    Args:
        id: its index among all objects that ever were in the place; the owner of its quads.
        name: "bookshelf", "wall", "picture", ...
        kind: "furniture", "small", "rug", "picture", "wall" (the paint of one), "window", "lamp", "door" (a leaf, there
            only while it is shut) or "shell" (what never changes).
        room: index of its room; -1 for what lies between rooms.
        T_place_object: (4, 4) pose of its own frame; of furniture x is along its back, y away from it, the origin in
            the middle of its back on the floor.
        size_m: (width, depth) of its footprint, from x = -width / 2 and y = 0; zeros where it has none.
        symmetry: which turns about the vertical through the footprint's middle leave it (nearly) as it is: "none",
            "half" or "any".
        wall: the wall of its room that it hangs on, -1 for none; its ``span_m`` along that wall.
        paint: 0 as it was built, else the seed of what it was painted with.
        present: whether it is there; what was taken away keeps its id.
        replaces: id of what stood in its place before it, -1 for nothing.
    """

    id: int
    name: str
    kind: str
    room: int = -1
    T_place_object: np.ndarray = field(default_factory=lambda: np.eye(4))
    size_m: tuple[float, float] = (0.0, 0.0)
    symmetry: str = "none"
    wall: int = -1
    span_m: tuple[float, float] = (0.0, 0.0)
    paint: int = 0
    present: bool = True
    replaces: int = -1


@dataclass
class Surfaces:
    """Collects quads. `at` gives a view with a moved local frame that adds to the same lists, `object` one for a thing.

    Every quad has corners p00, p10, p11, p01 (u runs along p00-p10, v along p00-p01, the normal is u x v), its size in
    metres, the place of its corner in the material's plane, a material, how brightly it glows by itself, and the index
    of the door whose leaf it belongs to (-1: none), for a leaf is there only while its door is shut. Quads and lamps
    know the object they belong to (`owners`, `lamp_owners`: ids; -1 for none).
    """

    corners: list[np.ndarray] = field(default_factory=list)
    sizes_m: list[tuple[float, float]] = field(default_factory=list)
    origins_m: list[tuple[float, float]] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    glows: list[float] = field(default_factory=list)
    lamps: list[tuple[np.ndarray, np.ndarray, float]] = field(default_factory=list)
    leaves: list[int] = field(default_factory=list)
    owners: list[int] = field(default_factory=list)
    lamp_owners: list[int] = field(default_factory=list)
    objects: list[PlaceObject] = field(default_factory=list)
    T_place_local: np.ndarray = field(default_factory=lambda: np.eye(4))
    leaf: int = -1
    owner: int = -1
    room: int = -1

    def at(self, x: float, y: float, z: float = 0.0, yaw_rad: float = 0.0) -> Surfaces:
        """The same collection seen from a local frame at (x, y, z), turned about the vertical."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        T = np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])
        return replace(self, T_place_local=self.T_place_local @ T)

    def object(self, name: str, kind: str, **facts: Any) -> Surfaces:
        """The same collection for the quads and lamps of a new `PlaceObject`, whose frame is the local one."""
        new = PlaceObject(len(self.objects), name, kind, self.room, self.T_place_local, **facts)
        self.objects.append(new)
        return replace(self, owner=new.id)

    def in_frame(self, T_place_local: np.ndarray, room: int = -1) -> Surfaces:
        """The same collection seen from a frame given in the place's."""
        return replace(self, T_place_local=T_place_local, room=room)

    def copy(self) -> Surfaces:
        """A collection of its own with the same content."""
        lists: dict[str, Any] = {f.name: list(v) for f in fields(self) if isinstance(v := getattr(self, f.name), list)}
        return replace(self, **lists)

    def of(self, owner: int) -> np.ndarray:
        """Indices of the quads of an object."""
        return np.flatnonzero(np.array(self.owners) == owner)

    def keep(self, quads: Iterable[int], lamps: Iterable[int]) -> None:
        """Leave only these quads and lamps, in this order."""
        of_quads: tuple[list[Any], ...] = (self.corners, self.sizes_m, self.origins_m, self.materials, self.glows)
        of_lamps: tuple[list[Any], ...] = (self.lamps, self.lamp_owners)
        for rows, lists in ((list(quads), (*of_quads, self.leaves, self.owners)), (list(lamps), of_lamps)):
            for held in lists:
                held[:] = [held[i] for i in rows]

    def quad(self, corners, material: Material, origin_m=(0.0, 0.0), glow: float = 0.0, size_m=None) -> None:
        """Add one quad of local corners p00, p10, p11, p01."""
        p = np.asarray(corners, np.float64)
        if size_m is None:
            width = 0.5 * (np.linalg.norm(p[1] - p[0]) + np.linalg.norm(p[2] - p[3]))
            size_m = (width, 0.5 * (np.linalg.norm(p[3] - p[0]) + np.linalg.norm(p[2] - p[1])))
        self.corners.append(p @ self.T_place_local[:3, :3].T + self.T_place_local[:3, 3])
        self.sizes_m.append((max(size_m[0], 1e-3), max(size_m[1], 1e-3)))
        self.origins_m.append(origin_m)
        self.materials.append(material)
        self.glows.append(glow)
        self.leaves.append(self.leaf)
        self.owners.append(self.owner)

    def rectangle(self, corner, edge_u, edge_v, material: Material, origin_m=(0.0, 0.0), glow: float = 0.0) -> None:
        """Add a parallelogram by its corner and two edges."""
        p, u, v = (np.asarray(a, np.float64) for a in (corner, edge_u, edge_v))
        self.quad([p, p + u, p + u + v, p + v], material, origin_m, glow)

    def box(self, x, y, z, width, depth, height, material: Material, front=None, top=None, glow: float = 0.0) -> None:
        """Add a box standing on (x, y, z), its front towards +y; the bottom is left out when it stands on z = 0."""
        w, d, h = width / 2, depth / 2, height
        side = (y + d, z + 0.7)  # Faces of one box show different parts of the texture.
        up = [0, 0, h]
        self.rectangle([x + w, y + d, z], [-width, 0, 0], up, front or material, (0, 0), glow)
        self.rectangle([x - w, y - d, z], [width, 0, 0], up, material, (3.1, 0), glow)
        self.rectangle([x + w, y - d, z], [0, depth, 0], up, material, side, glow)
        self.rectangle([x - w, y + d, z], [0, -depth, 0], up, material, (side[0] + 5.3, side[1]), glow)
        self.rectangle([x - w, y - d, z + h], [width, 0, 0], [0, depth, 0], top or material, (1.7, 9.1), glow)
        if z > 0:
            self.rectangle([x - w, y + d, z], [width, 0, 0], [0, -depth, 0], material, (2.9, 4.3), glow)

    def lathe(self, x, y, z, profile, material: Material, sides: int = 10, glow: float = 0.0) -> None:
        """Add a surface of revolution about the vertical through (x, y); profile = [(radius, height), ...] upwards."""
        angles = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
        base = np.array([x, y, z])
        for (r0, h0), (r1, h1) in itertools.pairwise(profile):
            low, high = base + r0 * ring + [0, 0, h0], base + r1 * ring + [0, 0, h1]
            step = 2 * np.pi / sides * max(r0, r1)
            for k in range(sides):
                size = (step, float(np.hypot(r1 - r0, h1 - h0)))
                self.quad([low[k], low[k + 1], high[k + 1], high[k]], material, (k * step, h0), glow, size)

    def lamp(self, x, y, z, colour, radius_m: float = 0.08) -> None:
        """Add a light source (a small ball, linear-light colour in candela-like units)."""
        at = self.T_place_local[:3, :3] @ [x, y, z] + self.T_place_local[:3, 3]
        self.lamps.append((at, np.asarray(colour, np.float64), radius_m))
        self.lamp_owners.append(self.owner)
