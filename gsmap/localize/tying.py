"""How photographs of one place help each other (`gsmap.localize.together`)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Params:
    """How photographs help each other.

    Args:
        neighbours: photos that each one is matched with, those that look most alike.
        min_tie: features of a photo that must agree with a pose by another one's, for the two to be tied.
        anchor: a photo that is this probable may help others; it is sure only once others bear it out.
        tie: how probable it is that two photos that are tied lie to each other as they are said to.
        shared: what a photo shows for or against a room that looks alike counts so much for the others, for they show
            much the same; beyond ...
        usual: ... what photos of a place that is in the map show for it, nearly all of them (log-odds): one that shows
            less speaks against the others.
        most: one photo speaks for or against the others by so much at most.
    """

    neighbours: int = 6
    min_tie: int = 20
    anchor: float = 0.3
    tie: float = 0.97
    shared: float = 0.75
    usual: float = 1.75
    most: float = 4.0
