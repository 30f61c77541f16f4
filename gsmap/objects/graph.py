"""Export the objects, relations and rooms of a map as a graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

from gsmap.objects.persistence import estimate_persistence
from gsmap.objects.relations import relations
from gsmap.types import MapObject
from gsmap.types.rows.objects import RoomRow


def object_graph(
    objects: Sequence[MapObject],
    dates: Mapping[str, str | None],
    metres: float | Mapping[int, float] = 1.0,
    rooms: Sequence[RoomRow] = (),
) -> Any:
    """Build a `networkx.MultiDiGraph` of objects, relations and rooms, with attributes that GraphML supports.

    Nodes: ``kind`` (object), ``component``, ``x y z`` (map frame), ``size_x size_y size_z``, ``L a b``, ``seen``,
    ``looks``, ``half_life_days`` (absent if unknown), ``there`` (seen in the newest observation), ``name`` and
    ``label`` (absent if none was given). Edges: ``kind`` (on, in, next to). Rooms are nodes, too: ``kind`` (room),
    ``component``, ``x y z`` (middle of the floor), ``area_m2``; an object has an edge ``in room`` to its room, and
    rooms have an edge ``door`` in each direction.

    Args:
        dates: see `estimate_persistence`.
        metres: metres per unit of the map, for each component or for all.
        rooms: rooms of the map.
    """
    import networkx as nx

    graph = nx.MultiDiGraph()
    for obj in objects:
        stays = estimate_persistence(obj, dates)
        facts: dict[str, Any] = {"kind": "object", "component": obj.component}
        facts |= {axis: float(value) for axis, value in zip("xyz", obj.position, strict=True)}
        facts |= {f"size_{axis}": float(v) for axis, v in zip("xyz", obj.box[1] - obj.box[0], strict=True)}
        facts |= {channel: float(value) for channel, value in zip("Lab", obj.colour, strict=True)}
        facts |= {"seen": stays.seen, "looks": stays.looks, "there": obj.there}
        if stays.half_life_days is not None:
            facts["half_life_days"] = stays.half_life_days
        facts |= {word: value for word in ("name", "label") if (value := getattr(obj.words, word))}
        graph.add_node(obj.id, **facts)
    for relation in relations(objects, metres):
        graph.add_edge(relation.source, relation.target, kind=relation.kind)
    for room in rooms:
        at = {axis: float(value) for axis, value in zip("xyz", room.position, strict=True)}
        graph.add_node(room.id, kind="room", component=room.component, area_m2=room.area_m2, **at)
    for room in rooms:
        graph.add_edges_from((obj, room.id, {"kind": "in room"}) for obj in room.objects)
        graph.add_edges_from((room.id, other, {"kind": "door"}) for other in room.doors)
    return graph


def graphml(graph: Any) -> str:
    """Return the graph as GraphML text."""
    import networkx as nx

    text = BytesIO()
    nx.write_graphml(graph, text)
    return text.getvalue().decode()
