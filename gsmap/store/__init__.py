"""Store maps: a relational catalog, and immutable array groups (zarr)."""

from gsmap.store.arrays import digest
from gsmap.store.exports import Export
from gsmap.store.facts import Fact
from gsmap.store.graphs import StoredGraph
from gsmap.store.models import Model
from gsmap.store.registrations import MANUAL, Review, StoredRegistration
from gsmap.store.revisions import Revision
from gsmap.store.scene_content import scene_id
from gsmap.store.store import Store

__all__ = [
    "MANUAL",
    "Export",
    "Model",
    "Review",
    "Revision",
    "Fact",
    "Store",
    "StoredGraph",
    "StoredRegistration",
    "digest",
    "scene_id",
]
