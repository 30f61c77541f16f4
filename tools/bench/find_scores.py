"""Average precision of finding things of one look: what `tools.fit.find` and `tools.bench.find` share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.find.similarity import SegmentDescriptor, SimilarityModel, describe_segments, differences
from tools.make.find_places import Sightings

_WHOLE = 0.5  # a thing that shows less of its object stands for none
QUERIES = ("chair", "armchair", "plant", "box", "sofa", "bed", "drawers", "coffee table", "floor lamp", "bookshelf")


@dataclass(frozen=True, eq=False)
class Item:
    """A thing of a capture.

    Args:
        capture, thing: by index.
        kind: equal for things of one look; below -1000 and its own for what is of no object.
        good: it shows at least half of its object.
        embedding: mean of those of the nodes of the layer ``objects`` that lie in it; None where none does.
    """

    capture: int
    thing: int
    kind: int
    name: str
    good: bool
    look: SegmentDescriptor
    embedding: np.ndarray | None


def items_of(found: Sightings) -> list[Item]:
    """The things of all captures of a place."""
    items = []
    for c, graph in enumerate(found.graphs):
        things = graph.segments
        assert things is not None
        if graph.up is None:
            continue
        layer, looks = graph.layers["objects"], describe_segments(things, graph.up)
        for t in range(len(things)):
            owner, low, high = found.owners[c, t], *things.extents[t]
            mine = ((layer.positions >= low) & (layer.positions <= high)).all(1)
            mean = layer.embeddings[mine].mean(0) if mine.any() else None
            kind = found.looks[owner] if owner >= 0 else -1001 - len(items)
            name = found.names[owner] if owner >= 0 else ""
            items.append(Item(c, t, kind, name, owner >= 0 and found.whole[c, t] >= _WHOLE, looks[t], mean))
    return items


def average_precisions(
    items: Sequence[Item], score: Callable[[tuple[Item, Sequence[Item]]], np.ndarray]
) -> Iterator[tuple[str, float]]:
    """Name and average precision of each thing that something else looks like; parts of such are neither right nor
    wrong."""
    for query in items:
        if not query.good or query.name not in QUERIES:
            continue
        others = [item for item in items if item is not query]
        order = np.argsort(-score((query, others)), kind="stable")
        ap = precision(query, [others[i] for i in order], items)
        if ap is not None:
            yield query.name, ap


def precision(query: Item, ranked: Sequence[Item], items: Sequence[Item]) -> float | None:
    """The average precision of a ranking for a thing; None where nothing else looks like it.

    Args:
        ranked: best first; the query itself does not count, what is missing was not found.
        items: all there are.
    """
    wanted = sum(item.kind == query.kind and item.good and item is not query for item in items)
    hits = np.array(
        [item.kind == query.kind for item in ranked if item is not query and (item.kind != query.kind or item.good)],
        bool,
    )
    if not wanted:
        return None
    at = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    return float(at[hits].sum() / wanted)


def by_model(model: SimilarityModel, question: tuple[Item, Sequence[Item]]) -> np.ndarray:
    """The log-odds of each of some items for one."""
    query, others = question
    return model.log_odds(differences(query.look, [other.look for other in others]))


def by_cosine(question: tuple[Item, Sequence[Item]]) -> np.ndarray:
    """The cosine of the mean embeddings of the nodes in two things; -1 where one has none."""
    query, others = question
    out = np.full(len(others), -1.0)
    if query.embedding is not None:
        for k, other in enumerate(others):
            if other.embedding is not None:
                norm = np.linalg.norm(query.embedding) * np.linalg.norm(other.embedding)
                out[k] = float(query.embedding @ other.embedding / norm)
    return out
