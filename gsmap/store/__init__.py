"""The only door to disk: a catalog in SQL and immutable arrays in zarr."""

from gsmap.store.arrays import digest
from gsmap.store.exports import Export
from gsmap.store.graphs import StoredGraph, graph_key
from gsmap.store.integrity import Check, Pruned
from gsmap.store.models import Model
from gsmap.store.registrations import StoredRegistration, Verdict
from gsmap.store.revisions import Revision
from gsmap.store.scenes import scene_id
from gsmap.store.store import Store

__all__ = [
    "Check",
    "Export",
    "Model",
    "Pruned",
    "Revision",
    "Store",
    "StoredGraph",
    "StoredRegistration",
    "Verdict",
    "digest",
    "graph_key",
    "scene_id",
]
