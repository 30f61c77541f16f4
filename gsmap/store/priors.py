"""Pose priors: a scene has at most one current prior; earlier priors are kept as history."""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, insert, select, update

from gsmap.errors import InputError, NotFoundError
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, to_array, to_pose
from gsmap.store.scene_refs import living_ids, resolve
from gsmap.store.schema import priors
from gsmap.types import Prior


class Priors:
    """The pose priors of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def set(self, prior: Prior) -> None:
        """Set the pose prior of a scene in place of the previous prior."""
        sigmas = np.asarray(prior.sigmas, np.float64)
        if sigmas.shape != (7,) or not (sigmas > 0).all():
            raise InputError(
                f"a prior needs 7 positive sigmas (inf where unknown), got {sigmas.tolist()}",
                code="invalid_sigma",
            )
        with self._catalog.write() as connection:
            scene = resolve(connection, prior.scene)
            self.retire(connection, scene)
            row = {
                "scene": scene,
                "S_map_scene": from_pose(prior.S_map_scene),
                "sigmas": from_array(sigmas),
                "up": from_array(prior.up),
                "up_sigma_rad": float(prior.up_sigma_rad),
            }
            connection.execute(insert(priors), row | {"created_at": now()})

    def list(self) -> list[Prior]:
        """Return the current priors of living scenes, oldest first."""
        return [prior for _, prior in self.numbered()]

    def numbered(self) -> tuple[tuple[int, Prior], ...]:
        """Return the current priors of living scenes with their row numbers, oldest first."""
        query = select(priors).where(priors.c.removed_at.is_(None)).order_by(priors.c.number)
        with self._catalog.read() as connection:
            living = living_ids(connection)
            rows = [row for row in connection.execute(query) if row.scene in living]
        return tuple((row.number, _prior(row)) for row in rows)

    def of(self, scene: str, at: str | None = None) -> Prior | None:
        """Return the current prior of a scene (id), or the prior at a time; None without a prior."""
        query = select(priors).where(priors.c.scene == scene).order_by(priors.c.number)
        if at is None:
            query = query.where(priors.c.removed_at.is_(None))
        else:
            query = query.where(priors.c.created_at <= at, priors.c.removed_at.is_(None) | (priors.c.removed_at > at))
        with self._catalog.read() as connection:
            rows = connection.execute(query).all()
        return _prior(rows[-1]) if rows else None

    def earlier(self, ref: str, number: int) -> Prior:
        """Return an earlier prior of a scene by its number.

        Raises:
            NotFoundError: the scene has no prior with this number.
        """
        with self._catalog.read() as connection:
            scene = resolve(connection, ref)
            query = select(priors).where(priors.c.scene == scene, priors.c.number == number)
            row = connection.execute(query).one_or_none()
        if row is None:
            raise NotFoundError(f"scene {ref!r} has no prior with number {number}", code="prior_not_found")
        return _prior(row)

    def remove(self, ref: str) -> None:
        """Remove the prior of a scene.

        Raises:
            NotFoundError: it has none.
        """
        with self._catalog.write() as connection:
            if not self.retire(connection, resolve(connection, ref)):
                raise NotFoundError(f"scene {ref!r} has no prior", code="prior_not_found")

    def retire(self, connection: Connection, scene: str) -> int:
        """Mark the current prior of a scene as removed; return the number of priors that were current."""
        current = (priors.c.scene == scene) & priors.c.removed_at.is_(None)
        return int(connection.execute(update(priors).where(current).values(removed_at=now())).rowcount)


def _prior(row: Row[Any]) -> Prior:
    return Prior(row.scene, to_pose(row.S_map_scene), to_array(row.sigmas), to_array(row.up), row.up_sigma_rad)
