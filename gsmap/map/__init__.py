"""The interface to maps: read from the store, call a pure stage, save the result. `Map` is a facade over `stages`."""

from gsmap.map.catalog_trust import catalog_of, trust
from gsmap.map.map import Map, accept_catalog, create, migrate, open, open_or_create, restore, snapshots

__all__ = [
    "Map",
    "accept_catalog",
    "catalog_of",
    "create",
    "migrate",
    "open",
    "open_or_create",
    "restore",
    "snapshots",
    "trust",
]
