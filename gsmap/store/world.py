"""World observations: control points, their photos, position fixes, scale bars, and the world frame.

Observations are stored as made, each in its own coordinate reference system, and never overwritten: a new one retires
the earlier one of the same name. ``scene`` of a row is the scene whose frame it refers to; a scale bar may refer to a
second one, ``other``. Photos of a control point include their camera, so that solving needs nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, insert, select, update

from gsmap.errors import NotFoundError
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import malformed_as_corrupt
from gsmap.store.scene_refs import living_ids
from gsmap.store.schema import observations
from gsmap.types.plain import plain
from gsmap.types.world import ControlPoint, ImagePoint, PositionFix, ScaleBar, Survey, WorldFrame

Observation = WorldFrame | ControlPoint | ImagePoint | PositionFix | ScaleBar
_TYPES: Mapping[str, type[Observation]] = {
    "frame": WorldFrame,
    "point": ControlPoint,
    "image": ImagePoint,
    "fix": PositionFix,
    "bar": ScaleBar,
}
_ARRAYS = {"position", "pixel", "T_scene_camera", "intrinsics_px", "camera_covariance", "point", "points"}
_TEXTS = {"name", "crs", "image", "scene"}
_TUPLES = {"sigma_m", "common_sigma_m", "scenes", "point_sigmas"}


class WorldObservations:
    """The world observations of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def add(self, items: Iterable[Observation]) -> int:
        """Add observations, each in place of the current observation of its name; return the number of changes."""
        count = 0
        with self._catalog.write() as connection:
            current = {_key(row): row for row in connection.execute(_current_rows())}
            for item in items:
                made = _row(item)
                before = current.get(_key_of(made))
                if before is not None and before.value == made["value"]:
                    continue
                if before is not None:
                    mine = observations.c.number == before.number
                    connection.execute(update(observations).where(mine).values(removed_at=now()))
                connection.execute(insert(observations), made | {"created_at": now()})
                count += 1
        return count

    def survey(self, coming: Iterable[Observation] = ()) -> Survey:
        """Return all current observations of living scenes, by name.

        Args:
            coming: further observations of living scenes, treated as if added.
        """
        with self._catalog.read() as connection:
            living = living_ids(connection)
            rows = [row for row in connection.execute(_current_rows()) if _has_living_scenes(row, living)]
        items: dict[tuple[str, str, str, str], Any] = {_key(row): _item(row) for row in rows}
        items |= {_key_of(_row(item)): item for item in coming}
        by_kind: dict[str, list[Any]] = {kind: [] for kind in _TYPES}
        for key in sorted(items):
            by_kind[key[0]].append(items[key])
        return Survey(
            by_kind["frame"][0] if by_kind["frame"] else None,
            tuple(by_kind["point"]),
            tuple(by_kind["image"]),
            tuple(by_kind["fix"]),
            tuple(by_kind["bar"]),
        )

    def remove(self, names: Sequence[str] = (), *, kinds: Sequence[str] = (), scene: str | None = None) -> int:
        """Remove observations; return their number.

        Args:
            names: of points (with their photos), photos, fixes or bars; default: all.
            kinds: only these kinds; default: all but the frame, or including the frame if nothing else is chosen.
            scene: only those of this scene (id).

        Raises:
            NotFoundError: a name is unknown.
        """
        chosen = tuple(kinds) or (tuple(_TYPES) if not names and scene is None else ("point", "image", "fix", "bar"))
        wanted, found = set(names), set()
        with self._catalog.write() as connection:
            gone = []
            for row in connection.execute(_current_rows()).all():
                row_names = {row.name, row.value.get("point")} if row.kind == "image" else {row.name}
                if row.kind not in chosen or (scene is not None and row.scene != scene):
                    continue
                if not wanted or row_names & wanted:
                    gone.append(row.number)
                    found |= row_names & wanted
            missing = sorted(wanted - found)
            if missing:
                raise NotFoundError(
                    f"this map has no observation {missing[0]!r}: gsmap georeference MAP shows the observations",
                    code="observation_not_found",
                )
            for number in gone:
                mine = observations.c.number == number
                connection.execute(update(observations).where(mine).values(removed_at=now()))
        return len(gone)


def inherit(connection: Connection, old: str, new: str) -> None:
    """Copy the observations of a scene to another scene in the same frame."""
    for row in connection.execute(_current_rows()).all():
        if old not in (row.scene, row.other):
            continue
        values = _renamed(dict(row._mapping), old, new)
        connection.execute(insert(observations), {k: v for k, v in values.items() if k != "number"})


def _renamed(row: dict[str, Any], old: str, new: str) -> dict[str, Any]:
    value = dict(row["value"])
    if value.get("scene") == old:
        value["scene"] = new
    if "scenes" in value:
        value["scenes"] = [new if scene == old else scene for scene in value["scenes"]]
    ends = {name: new if row[name] == old else row[name] for name in ("scene", "other")}
    return row | ends | {"value": value}


def _current_rows() -> Any:
    return select(observations).where(observations.c.removed_at.is_(None)).order_by(observations.c.number)


def _has_living_scenes(row: Row[Any], living: set[str]) -> bool:
    return all(scene is None or scene in living for scene in (row.scene, row.other))


def _key(row: Row[Any]) -> tuple[str, str, str, str]:
    return row.kind, row.name, row.scene or "", row.other or ""


def _key_of(row: Mapping[str, Any]) -> tuple[str, str, str, str]:
    return row["kind"], row["name"], row["scene"] or "", row["other"] or ""


def _row(item: Observation) -> dict[str, Any]:
    kind = next(kind for kind, type_ in _TYPES.items() if type(item) is type_)
    scene, other = getattr(item, "scene", None), None
    name = {"frame": "frame"}.get(kind) or str(getattr(item, "name", ""))
    if isinstance(item, ImagePoint):
        name = f"{item.point} in {item.image}"
    if isinstance(item, ScaleBar):
        scene, other = item.scenes
    value = plain(item)
    return {"kind": kind, "name": name, "scene": scene, "other": other, "value": value, "removed_at": None}


def _item(row: Row[Any]) -> Any:
    with malformed_as_corrupt(f"an observation ({row.kind} {row.name!r})"):
        values: dict[str, Any] = {
            name: _tuple(value)
            if name in _TUPLES and isinstance(value, list)
            else np.array(value)
            if _is_array(name, value)
            else value
            for name, value in row.value.items()
        }
        texts = [value for name, value in values.items() if name in _TEXTS]
        if not all(isinstance(text, str) for text in [*texts, *values.get("scenes", ())]):
            raise ValueError("names that are not strings")
        made = _TYPES[row.kind](**values)
        if _row(made)["scene"] != row.scene or _row(made)["other"] != row.other or _row(made)["name"] != row.name:
            raise ValueError("the name or scene differs from that of its row")
        return made


def _is_array(name: str, value: Any) -> bool:
    return name in _ARRAYS and isinstance(value, list)


def _tuple(value: list[Any]) -> tuple[Any, ...]:
    if len(value) != 2:
        raise ValueError("not a pair")
    return tuple(value)
