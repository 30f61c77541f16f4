"""Settings of retrieval: the pairs of scenes that are registered."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range


@dataclass(frozen=True)
class Params:
    """Settings of retrieval.

    Args:
        top_k: Largest number of candidates, at least 0 and the best first, that each scene is paired with; a larger
            value finds more edges and is slower.
        max_edges_per_scene: Number of undisputed edges, at least 1, that suffices for a scene: a pair is skipped if
            both scenes have this number and an edge or a common neighbour connects them already; a larger value
            registers more pairs and stabilizes the map.
        nodes_per_scene: Largest number of nodes per scene and layer, at least 1 and the strongest first, that an index
            stores; a larger value finds smaller overlaps, and takes more memory and time.
        num_neighbours: Largest number of scenes, at least 0 and the nearest in the component first, that each scene
            with a pose is paired with; a larger value finds more edges and is slower.
    """

    top_k: int = 12
    max_edges_per_scene: int = 4
    nodes_per_scene: int = 400
    num_neighbours: int = 12

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", *vars(self))
        require_range(self, "[1, inf]", "max_edges_per_scene", "nodes_per_scene")
