"""Objects of the map: segments of scenes are associated over time, observed in every scene, and related to each
other."""

from gsmap.objects.changed_segments import find_changed_segment
from gsmap.objects.fuse import PlacedSegments, SegmentId, fuse
from gsmap.objects.graph import graphml, object_graph
from gsmap.objects.make import VERSION, Params, SegmentedScene, make_objects, recipe_key
from gsmap.objects.persistence import Persistence, estimate_persistence
from gsmap.objects.relations import Relation, relations
from gsmap.objects.rooms import find_rooms
from gsmap.objects.visibility import (
    PointObservations,
    RenderedViews,
    classify_observation,
    is_in_view,
    observe_points,
    render_views,
)

__all__ = [
    "VERSION",
    "SegmentedScene",
    "RenderedViews",
    "PointObservations",
    "SegmentId",
    "Params",
    "Persistence",
    "PlacedSegments",
    "Relation",
    "find_changed_segment",
    "find_rooms",
    "fuse",
    "observe_points",
    "graphml",
    "is_in_view",
    "classify_observation",
    "make_objects",
    "object_graph",
    "render_views",
    "estimate_persistence",
    "recipe_key",
    "relations",
]
