"""Photographs that a map keeps as evidence (`LocalizedPhoto`), each with a small JPEG to show it.

A row is never overwritten: one that is taken back stays, and says when. A photo's pose is relative to the scene that
supports it, whose newest pose takes it to the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, insert, select, update

from gsmap.errors import CorruptError, GsmapError, InputError, NotFoundError
from gsmap.store import facts
from gsmap.store.arrays import Arrays, digest
from gsmap.store.catalog import Catalog, now
from gsmap.store.explained import NOT_KEPT, explained
from gsmap.store.groups import manifest, publish, unless_pruned
from gsmap.store.scene_refs import living_ids, resolve
from gsmap.store.schema import photo_sightings
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation

KIND = "photos"
MAX_BYTES = 1 << 19  # of a photo's JPEG: the merged map is to look like it, and no sharper


@dataclass(frozen=True, eq=False)
class StoredPhoto:
    """A photo that is kept.

    Args:
        number: of its row.
        sighting: what it says.
        created_at: when it was added.
        picture: digest of what is kept of its picture.
    """

    number: int
    sighting: LocalizedPhoto
    created_at: str
    picture: str = ""


class Photos:
    """The photographs that a map keeps."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def add(self, sighting: LocalizedPhoto, jpeg: bytes) -> bool:
        """Keep a photo; False, and nothing is changed, where the same one is kept already.

        Raises:
            InputError: the JPEG is none, or larger than `MAX_BYTES`; or the date is none.
            NotFoundError: no such scene.
        """
        if not jpeg.startswith(b"\xff\xd8\xff") or len(jpeg) > MAX_BYTES:
            raise InputError(f"a photo is kept as a JPEG of at most {MAX_BYTES} bytes", code="photo_not_jpeg")
        when = None if sighting.captured_at is None else facts.checked_date(sighting.captured_at)
        pixels = np.frombuffer(jpeg, np.uint8)
        group_id = digest(pixels, text=KIND)
        row = {
            "digest": sighting.digest,
            "name": sighting.name,
            "captured_at": when,
            "scene": sighting.scene,
            "value": _value(sighting),
            "group_id": group_id,
        }
        staging = self._arrays.stage({"jpeg": pixels}, KIND, group_id)
        with explained(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            resolve(connection, sighting.scene)
            same = photo_sightings.c.digest == sighting.digest
            if connection.execute(select(photo_sightings.c.number).where(same, _standing())).first() is not None:
                return False
            known = manifest(connection, group_id)
            if not known or self._arrays.problems(KIND, group_id, known):
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
            connection.execute(insert(photo_sightings), row | {"created_at": now()})
        return True

    def list(self) -> list[StoredPhoto]:
        """All that are kept, of living scenes, oldest first; those without a date last, as they came.

        Raises:
            CorruptError: what the catalog holds makes no sense.
        """
        with self._catalog.read() as connection:
            alive = living_ids(connection)
            rows = connection.execute(select(photo_sightings).where(_standing()).order_by(photo_sightings.c.number))
            kept = [_stored(row) for row in rows if row.scene in alive]
        return sorted(kept, key=lambda one: (one.sighting.captured_at is None, one.sighting.captured_at or ""))

    def jpeg(self, number: int) -> bytes:
        """The small picture of a photo.

        Raises:
            NotFoundError: no such photo.
            CorruptError: bytes on disk are missing or differ, or are no JPEG.
        """
        with self._catalog.read() as connection:
            mine = photo_sightings.c.number == number
            row = connection.execute(select(photo_sightings).where(mine)).first()
            if row is None:
                raise NotFoundError(
                    f"the map keeps no photo {number}: gsmap list MAP photos shows them", code="photo_not_found"
                )
            files = manifest(connection, row.group_id)
        with unless_pruned(self._catalog, row.group_id, f"photo {row.name} was taken back"):
            held = self._arrays.read(KIND, row.group_id, files, shapes={"jpeg": (None,)})["jpeg"]
        content = held.tobytes() if held.dtype == np.uint8 and len(held) <= MAX_BYTES else b""
        if not content.startswith(b"\xff\xd8\xff"):
            raise CorruptError(
                f"what the map keeps of photo {row.name} is no JPEG: restore it from a backup", code="photo_damaged"
            )
        return content

    def find(self, which: str) -> StoredPhoto:
        """The photo of a name, of a number (``p3``), or whose digest begins so.

        Raises:
            NotFoundError: none, or several.
        """
        kept = self.list()
        found = [one for one in kept if which in (one.sighting.name, f"p{one.number}")]
        if not found and len(which) >= _SHORTEST:
            found = [one for one in kept if one.sighting.digest.startswith(which)]
        if len(found) != 1:
            why = "keeps several photos of that name" if found else "keeps no photo"
            raise NotFoundError(
                f"{which}: the map {why}; gsmap list MAP photos shows them with numbers such as p3",
                code="photo_not_found",
            )
        return found[0]

    def remove(self, number: int) -> None:
        """Take a photo back; its row stays and says when, and prune reclaims its picture."""
        mine = photo_sightings.c.number == number
        with self._catalog.write() as connection:
            connection.execute(update(photo_sightings).where(mine, _standing()).values(removed_at=now()))


_SHORTEST = 6  # of a digest that is not whole


def claimed_groups(connection: Connection, lost: set[str] | None = None) -> set[str]:
    """The groups of photos that are kept, but those of scenes that are lost."""
    rows = connection.execute(select(photo_sightings.c.group_id, photo_sightings.c.scene).where(_standing()))
    return {row.group_id for row in rows if row.group_id is not None and row.scene not in (lost or ())}


def inherit(connection: Connection, old: str, new: str) -> None:
    """Let a scene have the photos of another, in whose frame it is."""
    mine = photo_sightings.c.scene == old
    connection.execute(update(photo_sightings).where(mine, _standing()).values(scene=new))


def _standing() -> Any:
    return photo_sightings.c.removed_at.is_(None)


def _value(sighting: LocalizedPhoto) -> dict[str, Any]:
    return {
        "T_scene_camera": sighting.T_scene_camera.tolist(),
        "covariance": sighting.covariance.tolist(),
        "intrinsics_px": sighting.intrinsics_px.tolist(),
        "size_px": [int(n) for n in sighting.size_px],
        "probability": float(sighting.probability),
        "things": [
            {"position": one.position.tolist(), "state": one.state, "share": float(one.share)}
            for one in sighting.things
        ],
    }


def _stored(row: Row[Any]) -> StoredPhoto:
    try:
        value = row.value
        when = None if row.captured_at is None else facts.checked_date(row.captured_at)
        things = tuple(
            PhotoObjectObservation(np.array(one["position"], np.float64), one["state"], float(one["share"]))
            for one in value["things"]
        )
        width, height = value["size_px"]
        sighting = LocalizedPhoto(
            row.digest,
            row.name,
            when,
            row.scene,
            np.array(value["T_scene_camera"], np.float64),
            np.array(value["covariance"], np.float64),
            np.array(value["intrinsics_px"], np.float64),
            (width, height),
            float(value["probability"]),
            things,
        )
    except (GsmapError, TypeError, ValueError, KeyError, AttributeError) as error:
        raise CorruptError(
            f"the catalog holds a photo, in photo_sightings row {row.number}, that makes no sense ({error}): gsmap did "
            "not write that; restore the catalog from a backup",
            code="catalog_invalid",
        ) from error
    return StoredPhoto(row.number, sighting, row.created_at, row.group_id or "")
