"""Objects of the map: segments of scenes are associated over time, observed in every scene, and related to each
other."""

from gsmap.objects.changed_segments import find_changed_segment
from gsmap.objects.component_scenes import ComponentScenes, MatchedSegments, SegmentedScene, SegmentRef
from gsmap.objects.fuse import PlacedSegments, SegmentId, fuse
from gsmap.objects.graph import graphml, object_graph
from gsmap.objects.make import VERSION, Params, make_objects, recipe_key, update_objects
from gsmap.objects.persistence import Persistence, estimate_persistence
from gsmap.objects.relations import Relation, relations
from gsmap.objects.room_tiles import is_small, update_rooms
from gsmap.objects.rooms import SurfacePoints, find_rooms, sample_surface, surface_rows
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
    "ComponentScenes",
    "MatchedSegments",
    "Params",
    "Persistence",
    "PlacedSegments",
    "PointObservations",
    "Relation",
    "RenderedViews",
    "SegmentId",
    "SegmentRef",
    "SegmentedScene",
    "SurfacePoints",
    "classify_observation",
    "estimate_persistence",
    "find_changed_segment",
    "find_rooms",
    "fuse",
    "graphml",
    "is_in_view",
    "is_small",
    "make_objects",
    "object_graph",
    "observe_points",
    "recipe_key",
    "relations",
    "render_views",
    "sample_surface",
    "surface_rows",
    "update_objects",
    "update_rooms",
]
