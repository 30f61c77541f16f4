"""Schedule the registration of candidate pairs in rounds, and skip redundant pairs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from gsmap.retrieve.params import Params

Pair = tuple[str, str]


def directed(a: str, b: str) -> Pair:
    """Return a pair as (lower id, higher id)."""
    return (a, b) if a < b else (b, a)


class PairSchedule:
    """Rounds of pairs to register; the accepted edges of a round determine which pairs the next rounds need.

    A pair is redundant if both of its scenes have `Params.max_edges_per_scene` undisputed edges and an edge or a common
    neighbour connects them already. So a scene without edges is tried with all its candidates. A candidate to which the
    graph has only a long path is tried as well, which closes a loop.

    Args:
        lists: candidate pairs of each query scene, best first.
        tried: pairs that were registered before.
        edges: undisputed edges that exist already.
    """

    def __init__(
        self, lists: Iterable[Sequence[Pair]], tried: Collection[Pair], edges: Iterable[Pair], params: Params
    ) -> None:
        self.tried = {directed(*pair) for pair in tried}
        self._lists = [[directed(*pair) for pair in pairs] for pairs in lists]
        self._at = [0] * len(self._lists)
        self._params = params
        self._neighbours: dict[str, set[str]] = {}
        for a, b in edges:
            self.add_edge(a, b)

    def add_edge(self, a: str, b: str) -> None:
        """Add an undisputed edge."""
        self._neighbours.setdefault(a, set()).add(b)
        self._neighbours.setdefault(b, set()).add(a)

    def is_redundant(self, a: str, b: str) -> bool:
        """Return whether an edge between two scenes is redundant."""
        near_a, near_b = self._neighbours.get(a, set()), self._neighbours.get(b, set())
        well_connected = min(len(near_a), len(near_b)) >= self._params.max_edges_per_scene
        return well_connected and (b in near_a or not near_a.isdisjoint(near_b))

    def next(self) -> list[Pair]:
        """Return the pairs (lower id, higher id) of the next round, highest ranks first; empty at the end."""
        ranked: dict[Pair, int] = {}
        for k, pairs in enumerate(self._lists):
            count = 0
            while self._at[k] < len(pairs) and count < self._params.max_edges_per_scene:
                rank, pair = self._at[k], pairs[self._at[k]]
                self._at[k] += 1
                if pair in ranked or (pair not in self.tried and not self.is_redundant(*pair)):
                    ranked[pair] = min(rank, ranked.get(pair, rank))
                    count += 1
        self.tried |= set(ranked)
        return sorted(ranked, key=lambda pair: (ranked[pair], pair))
