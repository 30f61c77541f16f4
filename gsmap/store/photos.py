"""Photos that a map keeps (`LocalizedPhoto`), each with a small JPEG.

Rows are never overwritten: a removed photo keeps its row with the time of removal. A photo's pose is relative to the
scene that supports it, whose newest pose transforms it to the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, insert, select, update

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.store import facts
from gsmap.store.array_groups import manifest, publish, unless_pruned
from gsmap.store.arrays import Arrays, digest
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import malformed_as_corrupt
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.scene_refs import living_ids, resolve
from gsmap.store.schema import photo_sightings
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation

KIND = "photos"
MAX_BYTES = 1 << 19  # of a photo's JPEG: enough to refine merged tiles


@dataclass(frozen=True, eq=False)
class StoredPhoto:
    """A photo kept in the map.

    Args:
        number: of its row.
        sighting: its pose and observations.
        created_at: when it was added.
        picture: digest of its small JPEG.
    """

    number: int
    sighting: LocalizedPhoto
    created_at: str
    picture: str = ""


class Photos:
    """The photos kept in a map."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def add(self, sighting: LocalizedPhoto, jpeg: bytes) -> bool:
        """Add a photo; if the map has the same photo already, change nothing and return False.

        Raises:
            InputError: not a JPEG, a JPEG larger than `MAX_BYTES`, or an invalid date.
            NotFoundError: no such scene.
        """
        if not jpeg.startswith(b"\xff\xd8\xff") or len(jpeg) > MAX_BYTES:
            raise InputError(f"a kept photo must be a JPEG of at most {MAX_BYTES} bytes", code="photo_not_jpeg")
        when = None if sighting.captured_at is None else facts.validated_date(sighting.captured_at)
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
        with translate_errors(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            resolve(connection, sighting.scene)
            same = photo_sightings.c.digest == sighting.digest
            if connection.execute(select(photo_sightings.c.number).where(same, _is_current())).first() is not None:
                return False
            known = manifest(connection, group_id)
            if not known or self._arrays.problems(KIND, group_id, known):
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
            connection.execute(insert(photo_sightings), row | {"created_at": now()})
        return True

    def list(self) -> list[StoredPhoto]:
        """Return the current photos of living scenes: dated photos, oldest first, then undated photos as they were
        added.

        Raises:
            CorruptError: the catalog holds an invalid photo.
        """
        with self._catalog.read() as connection:
            living = living_ids(connection)
            rows = connection.execute(select(photo_sightings).where(_is_current()).order_by(photo_sightings.c.number))
            kept = [_stored(row) for row in rows if row.scene in living]
        return sorted(kept, key=lambda one: (one.sighting.captured_at is None, one.sighting.captured_at or ""))

    def jpeg(self, number: int) -> bytes:
        """Return the small JPEG of a photo.

        Raises:
            NotFoundError: no such photo.
            CorruptError: bytes on disk are missing or differ, or are not a JPEG.
        """
        with self._catalog.read() as connection:
            mine = photo_sightings.c.number == number
            row = connection.execute(select(photo_sightings).where(mine)).first()
            if row is None:
                raise NotFoundError(
                    f"the map has no photo {number}: gsmap list MAP photos shows the photos", code="photo_not_found"
                )
            files = manifest(connection, row.group_id)
        with unless_pruned(self._catalog, row.group_id, f"photo {row.name} was removed"):
            held = self._arrays.read(KIND, row.group_id, files, shapes={"jpeg": (None,)})["jpeg"]
        content = held.tobytes() if held.dtype == np.uint8 and len(held) <= MAX_BYTES else b""
        if not content.startswith(b"\xff\xd8\xff"):
            raise CorruptError(
                f"the stored preview of photo {row.name} is not a JPEG: restore the map from a backup",
                code="photo_damaged",
            )
        return content

    def find(self, reference: str) -> StoredPhoto:
        """Return the photo with a name, number (``p3``) or digest prefix.

        Raises:
            NotFoundError: no photo matches, or several do.
        """
        kept = self.list()
        found = [one for one in kept if reference in (one.sighting.name, f"p{one.number}")]
        if not found and len(reference) >= _MIN_DIGEST_LENGTH:
            found = [one for one in kept if one.sighting.digest.startswith(reference)]
        if len(found) != 1:
            why = "has several photos with this name" if found else "has no photo with this name"
            raise NotFoundError(
                f"{reference}: the map {why}; gsmap list MAP photos shows the photos with their numbers, such as p3",
                code="photo_not_found",
            )
        return found[0]

    def remove(self, number: int) -> None:
        """Remove a photo; its row keeps the time of removal, and `prune` reclaims its JPEG."""
        mine = photo_sightings.c.number == number
        with self._catalog.write() as connection:
            connection.execute(update(photo_sightings).where(mine, _is_current()).values(removed_at=now()))


_MIN_DIGEST_LENGTH = 6  # of a digest prefix


def claimed_groups(connection: Connection, lost: set[str] | None = None) -> set[str]:
    """Return the array groups of current photos, except photos of ``lost`` scenes."""
    rows = connection.execute(select(photo_sightings.c.group_id, photo_sightings.c.scene).where(_is_current()))
    return {row.group_id for row in rows if row.group_id is not None and row.scene not in (lost or ())}


def inherit(connection: Connection, old: str, new: str) -> None:
    """Move the photos of a scene to another scene in the same frame."""
    mine = photo_sightings.c.scene == old
    connection.execute(update(photo_sightings).where(mine, _is_current()).values(scene=new))


def _is_current() -> Any:
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
    with malformed_as_corrupt(f"a photo, in photo_sightings row {row.number},"):
        value = row.value
        when = None if row.captured_at is None else facts.validated_date(row.captured_at)
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
        return StoredPhoto(row.number, sighting, row.created_at, row.group_id or "")
