"""Which proposed pairs are tried: down each scene's list, until the map is rigid there."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from gsmap.retrieve.params import Params

Pair = tuple[str, str]


def directed(a: str, b: str) -> Pair:
    """A pair as (lower, higher) by id: the same whichever scene asked."""
    return (a, b) if a < b else (b, a)


class Rounds:
    """Pairs to try, round by round: after each, what held says which are still wanted.

    A pair is redundant where both of its scenes have `Params.max_edges_per_scene` undisputed edges and are connected
    already, by an edge or over a third scene. So a scene in a component of its own is tried with all its candidates,
    and a candidate that the graph reaches by a long path only is tried, too, which closes a loop.

    Args:
        lists: pairs that a scene is proposed to be tried with, best first; one list for each scene that asks.
        tried: pairs that were.
        held: edges that stand and are not in doubt.
    """

    def __init__(
        self, lists: Iterable[Sequence[Pair]], tried: Collection[Pair], held: Iterable[Pair], params: Params
    ) -> None:
        self.tried = {directed(*pair) for pair in tried}
        self._lists = [[directed(*pair) for pair in pairs] for pairs in lists]
        self._at = [0] * len(self._lists)
        self._params = params
        self._tied: dict[str, set[str]] = {}
        for a, b in held:
            self.hold(a, b)

    def hold(self, a: str, b: str) -> None:
        """An edge of a pair stands, and is not in doubt."""
        self._tied.setdefault(a, set()).add(b)
        self._tied.setdefault(b, set()).add(a)

    def is_rigid(self, a: str, b: str) -> bool:
        """Whether an edge between two scenes would add little that the map lacks."""
        near_a, near_b = self._tied.get(a, set()), self._tied.get(b, set())
        enough = min(len(near_a), len(near_b)) >= self._params.max_edges_per_scene
        return enough and (b in near_a or not near_a.isdisjoint(near_b))

    def next(self) -> list[Pair]:
        """Pairs to try now, (lower, higher) by id, those of the highest ranks first; none when all is done."""
        ranked: dict[Pair, int] = {}
        for k, pairs in enumerate(self._lists):
            count = 0
            while self._at[k] < len(pairs) and count < self._params.max_edges_per_scene:
                rank, pair = self._at[k], pairs[self._at[k]]
                self._at[k] += 1
                if pair in ranked or (pair not in self.tried and not self.is_rigid(*pair)):
                    ranked[pair] = min(rank, ranked.get(pair, rank))
                    count += 1
        self.tried |= set(ranked)
        return sorted(ranked, key=lambda pair: (ranked[pair], pair))
