"""The only door to disk: a catalog in SQL and immutable arrays in zarr."""

from gsmap.store.arrays import digest
from gsmap.store.exports import Export
from gsmap.store.facts import SceneFact
from gsmap.store.graphs import StoredGraph
from gsmap.store.integrity import Check, Pruned
from gsmap.store.models import Model
from gsmap.store.registrations import MANUAL, Review, StoredRegistration
from gsmap.store.revisions import Revision
from gsmap.store.scene_content import scene_id
from gsmap.store.store import Store

__all__ = [
    "MANUAL",
    "Check",
    "Export",
    "Model",
    "Pruned",
    "Review",
    "Revision",
    "SceneFact",
    "Store",
    "StoredGraph",
    "StoredRegistration",
    "digest",
    "scene_id",
]
