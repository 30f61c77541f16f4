"""Scripted change: edits of every kind, or of a share of the furniture, chosen at random and such that all fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gsmap._native import QuadRays
from gsmap.errors import ConfigError
from gsmap_synthetic.bake import rays
from gsmap_synthetic.edits import Add, Edit, Move, Paint, Remove, apply
from gsmap_synthetic.furniture import PIECES
from gsmap_synthetic.layout import door_clearance, door_spans, find_spot, footprint, outline, overlap, walls
from gsmap_synthetic.place import Place
from gsmap_synthetic.small import SMALL
from gsmap_synthetic.surfaces import PlaceObject, Surfaces

KINDS = ("replaced", "removed", "moved", "added", "small", "recoloured", "repainted", "swapped")
DEFAULT = dict.fromkeys(KINDS, 1) | {"moved": 2}
_BUILT_IN = ("kitchen row", "bathtub", "basin")  # They stay where they are.
_CARRIES = ("drawers", "coffee table", "sideboard", "desk", "dining table", "floor")
_WELCOME = ("armchair", "drawers", "sideboard", "bookshelf", "plant", "wardrobe", "coffee table", "desk", "floor lamp")
_TRIES = 200


def random_edits(
    place: Place,
    rng: np.random.Generator,
    *,
    rooms: Sequence[int],
    counts: dict[str, int] | None = None,
    share: float | None = None,
) -> list[Edit]:
    """Edits of things in ``rooms``, each thing at most once and none of what carries small things.

    Args:
        counts: how many of each of `KINDS`; by default `DEFAULT`.
        share: instead of counts, the share of the rooms' furniture that changes: moved, removed, replaced and
            recoloured in turn; for every second piece that goes one comes.

    Raises:
        ConfigError: the rooms have no place for so much change.
    """
    if share is not None:
        counts = _counts_of_share(place, rooms, share)
    counts = DEFAULT if counts is None else counts
    if unknown := set(counts) - set(KINDS):
        raise ConfigError(f"unknown kinds of change {sorted(unknown)}: there are {', '.join(KINDS)}")
    script = _Script(place, rng, rooms)
    makers: dict[str, Callable[[int], list[Edit] | None]] = {
        "replaced": script.replaced,
        "removed": script.removed,
        "moved": script.moved,
        "added": script.added,
        "small": script.small,
        "recoloured": script.recoloured,
        "repainted": lambda turn: script.painted("wall"),
        "swapped": lambda turn: script.painted("picture"),
    }
    for kind in KINDS:
        for turn in range(counts.get(kind, 0)):
            edits = None
            for attempt in range(40):
                script.crowded = attempt >= 30
                if edits := makers[kind](turn):
                    break
            if not edits:
                raise ConfigError(f"found nothing to be {kind} in rooms {list(rooms)} of place {place.seed}")
            script.make(edits)
    return script.edits


def _counts_of_share(place: Place, rooms: Sequence[int], share: float) -> dict[str, int]:
    furniture = sum(o.present and o.kind == "furniture" and o.room in rooms for o in place.objects)
    changed = round(share * furniture)
    counts = {k: len(range(i, changed, 4)) for i, k in enumerate(("moved", "removed", "replaced", "recoloured"))}
    return counts | {"added": (counts["removed"] + 1) // 2}


class _Script:
    """The edits so far and the place as they leave it."""

    def __init__(self, place: Place, rng: np.random.Generator, rooms: Sequence[int]) -> None:
        self.place, self.rng, self.rooms = place, rng, list(rooms)
        self.surfaces: Surfaces = place.surfaces.copy()
        self.edits: list[Edit] = []
        self.touched: set[int] = set()
        self.crowded = False  # then the places of what went are used, too
        self.left: list[tuple[int, np.ndarray]] = []  # rooms and rectangles where something stood

    def make(self, edits: Sequence[Edit]) -> None:
        for edit in edits:
            if isinstance(edit, Move | Remove):
                gone = self.surfaces.objects[edit.object]
                self.left.append((gone.room, self._in_room(outline(gone.T_place_object, gone.size_m), gone.room)))
            self.touched.add(apply(self.surfaces, edit))
            self.edits.append(edit)

    def removed(self, turn: int) -> list[Edit] | None:
        thing = self._pick("furniture", self._is_loose)
        return [Remove(thing.id)] if thing else None

    def replaced(self, turn: int) -> list[Edit] | None:
        """Another piece of its kind stands in the same place; drawers first, for they are the hardest to tell."""
        thing = self._pick("furniture", lambda o: turn > 0 or o.name == "drawers") or self._pick("furniture")
        if thing is None:
            return None
        piece = PIECES[thing.name]
        size_m = (self.rng.uniform(*piece.width_m), self.rng.uniform(*piece.depth_m))
        rect = self._in_room(outline(thing.T_place_object, size_m), thing.room)
        if not self._fits(rect, thing.room, thing.name, but=thing.id):
            size_m = thing.size_m
        add = Add(thing.name, thing.room, thing.T_place_object, size_m, self._seed(), replaces=thing.id)
        return [Remove(thing.id), add]

    def moved(self, turn: int) -> list[Edit] | None:
        """By turns to another place in the room, and pushed along and turned a little where it stands."""
        hard = ("plant", "floor lamp")
        thing = self._pick("furniture", lambda o: self._is_loose(o) and (turn % 3 == 2 or o.name not in hard))
        if thing is None:
            return None
        pose = self._elsewhere(thing) if turn % 2 == 0 else self._pushed(thing)
        return None if pose is None else [Move(thing.id, pose)]

    def added(self, turn: int) -> list[Edit] | None:
        name, room = str(self.rng.choice(_WELCOME)), int(self.rng.choice(self.rooms))
        piece = PIECES[name]
        size_m = (float(self.rng.uniform(*piece.width_m)), float(self.rng.uniform(*piece.depth_m)))
        pose = self._free_pose(name, size_m, room)
        return None if pose is None else [Add(name, room, pose, size_m, self._seed())]

    def small(self, turn: int) -> list[Edit] | None:
        """A vase, a box or books on a free top, or on the floor."""
        name, room = str(self.rng.choice(list(SMALL))), int(self.rng.choice(self.rooms))
        size_m = (float(self.rng.uniform(*SMALL[name].width_m)), float(self.rng.uniform(*SMALL[name].depth_m)))
        pose = self._free_top(room, size_m)
        return None if pose is None else [Add(name, room, pose, size_m, self._seed())]

    def recoloured(self, turn: int) -> list[Edit] | None:
        thing = self._pick("furniture", lambda o: o.name not in ("plant", "floor lamp"))
        return [Paint(thing.id, self._seed())] if thing else None

    def painted(self, kind: str) -> list[Edit] | None:
        thing = self._pick(kind)
        return [Paint(thing.id, self._seed())] if thing else None

    def _seed(self) -> int:
        return int(self.rng.integers(1, 1 << 20))

    def _pick(self, kind: str, wanted: Callable[[PlaceObject], bool] = lambda o: True) -> PlaceObject | None:
        things = [o for o in self._present(kind) if o.id not in self.touched and wanted(o)]
        return things[int(self.rng.integers(len(things)))] if things else None

    def _present(self, *kinds: str) -> list[PlaceObject]:
        return [o for o in self.surfaces.objects if o.present and o.kind in kinds and o.room in self.rooms]

    def _is_loose(self, thing: PlaceObject) -> bool:
        """Not built in, and nothing stands on it."""
        rect = outline(thing.T_place_object, thing.size_m)
        carried = (o.T_place_object[:2, 3] for o in self._present("small"))
        return thing.name not in _BUILT_IN and not any(
            (rect[:2] < xy).all() and (xy < rect[2:]).all() for xy in carried
        )

    def _in_room(self, rect: np.ndarray, room: int) -> np.ndarray:
        return rect - np.tile(self.place.rooms[room].rect_m[:2], 2)

    def _used(self, room: int, name: str, but: int = -1) -> list[np.ndarray]:
        """What a piece keeps clear of: doorways, other things on the floor, and what it would hide on the walls."""
        plan, piece = self.place.rooms[room], PIECES[name]
        used = door_clearance(plan, door_spans(plan, room, list(self.place.doors)))
        for thing in self._present("furniture", "small"):
            if thing.room == room and thing.id != but and thing.T_place_object[2, 3] < 0.1:
                used.append(self._in_room(outline(thing.T_place_object, thing.size_m), room))
        for thing in self._present("window", "picture"):
            if thing.room == room and (piece.tall or (piece.covers_wall and thing.kind == "picture")):
                x, y, yaw, _ = walls(plan.size_m)[thing.wall]
                low, high = thing.span_m
                used.append(footprint(x, y, yaw, (low + high) / 2, high - low, 0.1))
        return used

    def _fits(self, rect: np.ndarray, room: int, name: str, but: int = -1) -> bool:
        inside = (rect[:2] > 0.005).all() and (rect[2:] < self.place.rooms[room].size_m - 0.005).all()
        return bool(inside) and not any(overlap(rect, other) for other in self._used(room, name, but))

    def _free_pose(self, name: str, size_m: tuple[float, float], room: int, but: int = -1) -> np.ndarray | None:
        plan = self.place.rooms[room]
        used = self._used(room, name, but)
        if not self.crowded:  # What comes where something went would rather be called replaced.
            used += [rect for where, rect in self.left if where == room]
        spot = find_spot(self.rng, plan, PIECES[name], size_m, used, [[], [], [], []])
        return None if spot is None else spot.frame(Surfaces().at(*plan.rect_m[:2])).T_place_local

    def _elsewhere(self, thing: PlaceObject) -> np.ndarray | None:
        pose = self._free_pose(thing.name, thing.size_m, thing.room, thing.id)
        far = pose is not None and np.linalg.norm((pose - thing.T_place_object)[:2, 3]) > 0.6
        return pose if far else None

    def _pushed(self, thing: PlaceObject) -> np.ndarray | None:
        for _ in range(_TRIES):
            dx, dy = self.rng.uniform(0.25, 0.9) * self.rng.choice([-1, 1]), self.rng.uniform(0.0, 0.35)
            yaw = np.radians(self.rng.uniform(5, 30)) * self.rng.choice([-1, 1])
            pose = Surfaces().in_frame(thing.T_place_object).at(dx, dy, 0, yaw).T_place_local
            if self._fits(self._in_room(outline(pose, thing.size_m), thing.room), thing.room, thing.name, thing.id):
                return pose
        return None

    def _free_top(self, room: int, size_m: tuple[float, float]) -> np.ndarray | None:
        """A pose on a level, free surface of one thing, found by looking down from chest height."""
        scene, owners = QuadRays(np.stack(self.surfaces.corners)), np.array(self.surfaces.owners)
        plan = self.place.rooms[room]
        tops = [o for o in self._present("furniture") if o.room == room and o.name in _CARRIES]
        tops = [o for o in tops if o.id not in self.touched]
        for _ in range(_TRIES):
            yaw = self.rng.uniform(0, 2 * np.pi)
            if tops and self.rng.random() < 0.8:
                top = tops[int(self.rng.integers(len(tops)))]
                rect = outline(top.T_place_object, top.size_m)
            else:
                rect = plan.rect_m + np.array([0.3, 0.3, -0.3, -0.3])
            x, y = self.rng.uniform(rect[:2], rect[2:])
            pose = Surfaces().at(x, y, 0, yaw).T_place_local
            if any(overlap(self._in_room(outline(pose, size_m), room), r) for r in self._doorways(room)):
                continue
            u, v = np.meshgrid(np.linspace(-0.55, 0.55, 5) * size_m[0], np.linspace(-0.05, 1.05, 5) * size_m[1])
            points = np.stack([u, v, 0 * u, 0 * u + 1], axis=-1).reshape(-1, 4) @ pose.T
            eyes = points[:, :3] + [0, 0, 1.35]
            distance, triangle, _, _ = scene.cast(*rays(eyes, np.tile([0, 0, -1.0], (len(eyes), 1))))
            height = 1.35 - distance
            if not np.isfinite(height).all():
                continue
            owner = owners[triangle // 2]
            on = self.surfaces.objects[owner[0]]
            if (
                np.ptp(height) < 1e-3
                and (owner == owner[0]).all()
                and on.name in _CARRIES
                and on.id not in self.touched
            ):
                return Surfaces().at(x, y, float(height[0]), yaw).T_place_local
        return None

    def _doorways(self, room: int) -> list[np.ndarray]:
        plan = self.place.rooms[room]
        return door_clearance(plan, door_spans(plan, room, list(self.place.doors)))
