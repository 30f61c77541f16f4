"""The map: load from the store, call a pure stage, save. `Map` is the doors, `stages` the work behind them."""

from gsmap.map.map import Map, accept_catalog, create, migrate, open, open_or_create, restore, snapshots
from gsmap.map.trusting import catalog_of, trust

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
