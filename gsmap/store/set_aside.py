"""Jobs that are left out until a person asks for them, since they ended the processes they ran in; and captures that
could not be read, which are tried again whenever their files or folders are named.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import delete, insert, select

from gsmap.store.catalog import Catalog, now
from gsmap.store.schema import set_aside

CAPTURE = "capture"


@dataclass(frozen=True)
class StoredSetAside:
    """A job that was set aside.

    Args:
        what: ``graph KEY``, ``edge KEY``, ``comparison KEY`` or ``tile KEY``: what it would have made; ``capture
            DIGEST``, of its path.
        about: ids of the scenes it reads, with spaces between them; of a tile the folder that was exported to; of a
            capture its path.
        reason: what became of the processes, or why the capture cannot be read.
        created_at: when it was set aside.
    """

    what: str
    about: str
    reason: str
    created_at: str


class SetAsides:
    """The jobs and captures of a map that were set aside.

    Attributes:
        met: those that this open map set aside or left out.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self.met: dict[str, StoredSetAside] = {}

    def list(self) -> list[StoredSetAside]:
        """All, oldest first."""
        with self._catalog.read() as connection:
            rows = connection.execute(select(set_aside).order_by(set_aside.c.created_at, set_aside.c.what))
            return [StoredSetAside(**row) for row in rows.mappings()]

    def add(self, what: str, about: str, reason: str) -> None:
        """Set a job or a capture aside; an older one of its kind about the same was of another recipe, and goes."""
        row = {"what": what, "about": about, "reason": reason, "created_at": now()}
        kind = what.partition(" ")[0]
        with self._catalog.write() as connection:
            same = (set_aside.c.about == about) & set_aside.c.what.startswith(f"{kind} ")
            connection.execute(delete(set_aside).where(same if kind != "tile" else set_aside.c.what == what))
            connection.execute(insert(set_aside), row)
        self.met[what] = StoredSetAside(**row)

    def forget(self, whats: Collection[str]) -> None:
        """Take jobs back: they are to be tried again, are done, or are wanted no more."""
        with self._catalog.write() as connection:
            connection.execute(delete(set_aside).where(set_aside.c.what.in_(sorted(whats))))
        for what in whats:
            self.met.pop(what, None)
