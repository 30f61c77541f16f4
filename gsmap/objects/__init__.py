"""Things of captures become objects of the map: fused, looked for in every capture, related, and counted."""

from gsmap.objects.changed import changed_thing
from gsmap.objects.fuse import Node, Placed, fuse
from gsmap.objects.graph import graphml, object_graph
from gsmap.objects.looks import Eyes, Glance, glance, in_view, judge, open_eyes
from gsmap.objects.make import VERSION, Capture, Params, make_objects, recipe_key
from gsmap.objects.permanence import Permanence, permanence
from gsmap.objects.relations import Relation, relations
from gsmap.objects.rooms import find_rooms

__all__ = [
    "VERSION",
    "Capture",
    "Eyes",
    "Glance",
    "Node",
    "Params",
    "Permanence",
    "Placed",
    "Relation",
    "changed_thing",
    "find_rooms",
    "fuse",
    "glance",
    "graphml",
    "in_view",
    "judge",
    "make_objects",
    "object_graph",
    "open_eyes",
    "permanence",
    "recipe_key",
    "relations",
]
