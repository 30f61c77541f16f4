"""Which pairs are looked for, and which of them are tried."""

from __future__ import annotations

from dataclasses import dataclass, fields

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """Which pairs are tried.

    Args:
        top_k: most promising scenes that each scene is paired with.
        enough: a pair is not tried where both of its scenes have this many edges without doubt and one of these leads
            from each to the same third scene: the map is rigid there.
        nodes_per_scene: strongest nodes of a layer that vote and are voted for.
        votes_per_node: most similar nodes that each node votes for.
        min_similarity: nodes whose vectors have a smaller cosine are no match.
        equal_similarity: a match says little where other scenes have nodes whose cosine is at most this much smaller.
        turned_signs: of the axes that name a node's list, so many are looked at on both sides.
        matches: most telling matches of two scenes, of which those that lie alike say how one is laid onto the other.
        checked_scenes: most voted for scenes that are laid onto the one that asks.
        peers: what a scene says is compared with what as many of them say that come to lie nearest to it; with at most
            a third of them all, as if the others said nothing.
        tolerance_m: by which the distance of two nodes, and their difference in height, may differ between two scenes,
            and within which a node lies where the one it matches does; working metres.
        apart_m: nodes that are nearer to each other do not bear each other out; working metres.
        scale_slack: of a distance, what it may differ by where the metre of one of the scenes is guessed.
        num_spatial: nearest placed scenes of its component that each placed scene is paired with.
        reach_sigmas: two placed scenes may touch within this many standard deviations of their distance.
    """

    top_k: int = 12
    enough: int = 4
    nodes_per_scene: int = 400
    votes_per_node: int = 200
    min_similarity: float = 0.6
    equal_similarity: float = 0.02
    turned_signs: int = 2
    matches: int = 24
    checked_scenes: int = 300
    peers: int = 30
    tolerance_m: float = 0.2
    apart_m: float = 0.5
    scale_slack: float = 0.25
    num_spatial: int = 12
    reach_sigmas: float = 3.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) >= 0:
                raise ConfigError(
                    f"retrieve.{field.name} must not be negative, got {getattr(self, field.name)}", code="out_of_range"
                )
        for name in ("enough", "nodes_per_scene", "votes_per_node", "matches", "checked_scenes"):
            if getattr(self, name) < 1:
                raise ConfigError(f"retrieve.{name} must be at least 1, got {getattr(self, name)}", code="out_of_range")
