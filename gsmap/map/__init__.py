"""The map: load from the store, call a pure stage, save. `Map` is the doors, `stages` the work behind them."""

from gsmap.map.map import Map, create, migrate, open, open_or_create, restore, snapshots

__all__ = ["Map", "create", "migrate", "open", "open_or_create", "restore", "snapshots"]
