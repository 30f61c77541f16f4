"""Trust in a map's database server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class TrustReport(Row):
    """The database server of a map, and whether this user trusts it.

    Args:
        map: folder of the map.
        server: host and port, or the folder of a socket.
        database: database on that server.
        user: user whose password would be sent; empty for the driver's default.
        trusted: true if the map may be opened.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "server": "server",
        "database": "database",
        "user": "user",
        "trusted": "trusted",
    }

    map: str
    server: str
    database: str
    user: str
    trusted: bool
