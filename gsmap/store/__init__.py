"""The only door to disk: a catalog in SQL and immutable arrays in zarr."""

from gsmap.store.store import Store

__all__ = ["Store"]
