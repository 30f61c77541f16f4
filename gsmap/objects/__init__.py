"""Things of captures become objects of the map: fused, looked for in every capture, related, and counted."""

from gsmap.objects.changed import changed_thing
from gsmap.objects.fuse import Node, Placed, fuse
from gsmap.objects.graph import graphml, object_graph
from gsmap.objects.looks import Eyes, Glance, glance, judge, open_eyes
from gsmap.objects.make import Capture, Params, make_objects
from gsmap.objects.permanence import Permanence, permanence
from gsmap.objects.relations import Relation, relations

__all__ = [
    "Capture",
    "Eyes",
    "Glance",
    "Node",
    "Params",
    "Permanence",
    "Placed",
    "Relation",
    "changed_thing",
    "fuse",
    "glance",
    "graphml",
    "judge",
    "make_objects",
    "object_graph",
    "open_eyes",
    "permanence",
    "relations",
]
