"""What a map on a server would have a person trust."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class TrustReport(Row):
    """Where a map would have gsmap connect to, and whether this user trusts that.

    Args:
        map: its folder.
        server: machine and port, or the folder of a socket.
        database: on that server.
        user: whose password would be sent there; empty where the driver chooses.
        trusted: whether the map may be opened so from now on.
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
