"""The map: load from the store, call a pure stage, save. Start at `recipe`."""

from gsmap.map.recipe import Ingested, Map, create, migrate, open, open_or_create

__all__ = ["Ingested", "Map", "create", "migrate", "open", "open_or_create"]
