"""Ask the map's retrieval index: it is brought up to date first, and made anew where it is damaged."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from gsmap import retrieve
from gsmap.errors import CorruptError, GsmapError, NotFoundError
from gsmap.methods import RecipeKey
from gsmap.retrieve import Voters
from gsmap.store import Store
from gsmap.store.indexes import Lookup, StoredSegment
from gsmap.types import SceneGraph
from gsmap.types.progress import StageProgress
from gsmap.types.retrieval import Candidate, Member

_AT_ONCE = 64  # scenes whose nodes lie in memory: about 8 MB
_PATIENCE = 8  # times that others may change the index while it is read, or that a damaged one is made anew
_KEPT = 2  # times as many candidates are kept as are tried, to be shown


def ask(
    store: Store,
    graphs: Mapping[str, RecipeKey],
    asking: Sequence[str],
    params: retrieve.Params,
    progress: StageProgress,
) -> None:
    """Look scenes up in the index, and keep what it says.

    Args:
        graphs: the key of the graph of every scene that counts; they are put into the index where they are not.
        asking: ids of those that ask.
    """
    for left in reversed(range(_PATIENCE)):
        try:
            mine = _bring_up_to_date(store, graphs, set(asking), params, progress)
            for start in range(0, len(asking), _AT_ONCE):
                scenes = asking[start : start + _AT_ONCE]
                voters = [mine[scene] if scene in mine else _voters(store, graphs[scene], params) for scene in scenes]
                found = retrieve.look_up(voters, _segments(store, graphs, params), params)
                store.indexes.note([_lookup(one, said, params) for one, said in zip(voters, found, strict=True)])
            return
        except CorruptError:
            damaged = [segment.id for segment in _segments(store, graphs, params) if _is_damaged(segment)]
            if not (damaged and left):
                raise
            store.indexes.forget(damaged)
        except NotFoundError:  # another process made segments one while they were read
            if not left:
                raise


def ask_once(
    store: Store, graphs: Mapping[str, RecipeKey], graph: SceneGraph, params: retrieve.Params
) -> list[Candidate]:
    """What the index says of a graph that is none of the map's; nothing is kept, the index stays as it is.

    Args:
        graphs: the key of the graph of every scene that counts; those that the index lacks are read.
        graph: made by the recipe of these.
    """
    for left in reversed(range(_PATIENCE)):
        try:
            segments: list[retrieve.Segment] = list(_segments(store, graphs, params))
            present = {member.scene for segment in segments for member in segment.members if member is not None}
            missing = sorted(set(graphs) - present)
            for start in range(0, len(missing), _AT_ONCE):
                new = [_voters(store, graphs[scene], params) for scene in missing[start : start + _AT_ONCE]]
                segments.append(retrieve.new_segment(new))
            asking = retrieve.voters_of(graph, "", params.nodes_per_scene)
            return retrieve.look_up([asking], segments, params)[0]
        except NotFoundError:  # another process made segments one while they were read
            if not left:
                raise
        except CorruptError as error:
            raise CorruptError(f"{error}: gsmap register {store.home} makes the index anew") from error
    raise AssertionError("unreachable")


def keys_of_lookups(graphs: Mapping[str, RecipeKey], params: retrieve.Params) -> dict[str, str]:
    """The key (digest) under which each scene's lookup is kept."""
    recipe = retrieve.recipe_key(params)
    return {scene: recipe.digest_of(key.digest) for scene, key in graphs.items()}


def _bring_up_to_date(
    store: Store,
    graphs: Mapping[str, RecipeKey],
    asking: Collection[str],
    params: retrieve.Params,
    progress: StageProgress,
) -> dict[str, Voters]:
    """Put the scenes into the index that are not in it; returns what was read of some that ask."""
    recipe, read = retrieve.index_recipe(params), dict[str, Voters]()
    while True:
        segments = _segments(store, graphs, params)
        present = {member.scene for segment in segments for member in segment.members if member is not None}
        missing = sorted(set(graphs) - present)
        if not missing:
            return {scene: voters for scene, voters in read.items() if scene in asking}
        if len(missing) > _AT_ONCE:
            progress("register", 0.0, f"{len(missing)} scenes into the index of retrieval")
        new = [read.get(scene) or _voters(store, graphs[scene], params) for scene in missing[:_AT_ONCE]]
        read = {voters.member.scene: voters for voters in new}
        sizes = [sum(member is not None for member in segment.members) for segment in segments]
        old = [segments[k] for k in retrieve.to_merge(sizes, len(new))]
        whole = retrieve.merged([*old, retrieve.new_segment(new)])
        members = [member for member in whole.members if member is not None]
        store.indexes.put(recipe, members, whole.arrays, [segment.id for segment in old])


def _segments(store: Store, graphs: Mapping[str, RecipeKey], params: retrieve.Params) -> list[StoredSegment]:
    """The index; of its scenes those count whose present graph it holds, each once."""
    present, seen = {scene: key.digest for scene, key in graphs.items()}, set[str]()
    found = []
    for segment in store.indexes.segments(retrieve.index_recipe(params)):
        members: list[Member | None] = []
        for member in segment.members:
            counts = None
            if member is not None and member.scene not in seen and present.get(member.scene) == member.graph:
                counts = member
                seen.add(member.scene)
            members.append(counts)
        found.append(replace(segment, members=members))
    return found


def _is_damaged(segment: StoredSegment) -> bool:
    try:
        retrieve.merged([segment])
    except GsmapError:
        return True
    return False


def _voters(store: Store, key: RecipeKey, params: retrieve.Params) -> Voters:
    graph = store.graphs.load(key.inputs[0], key)
    assert graph is not None
    return retrieve.voters_of(graph, key.digest, params.nodes_per_scene)


def _lookup(voters: Voters, said: Sequence[Candidate], params: retrieve.Params) -> Lookup:
    key = retrieve.recipe_key(params).of(voters.member.graph)
    return Lookup(voters.member.scene, key.digest, tuple(said[: _KEPT * params.top_k]))
