"""Register: which pairs are tried, and the edges of those that the present recipe has not registered yet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from gsmap.engine import run_jobs
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.map.jobs import register_scenes
from gsmap.map.settings import Settings
from gsmap.map.sharing import SharedJobs, noting
from gsmap.map.stages.describe import graph_keys, without_graph
from gsmap.methods import RecipeKey
from gsmap.register import recipe_key
from gsmap.retrieve import Placed, candidate_pairs
from gsmap.store import MANUAL, Store
from gsmap.store.registrations import StoredRegistration
from gsmap.types import PoseGraph, Registration, Scene, SceneGraph, Sim3
from gsmap.types.progress import StageProgress

Pair = tuple[str, str]
Pairs = str | Path | Sequence[Pair]
"""``auto``, ``all``, ``A:B``, a file of pairs, or the pairs themselves."""


def register(store: Store, pairs: Pairs, settings: Settings, progress: StageProgress) -> list[Registration]:
    """Register the pairs asked for; those of ``auto`` and ``all`` only where this recipe has not done so yet.

    A result that this recipe made before, under settings that were changed meanwhile, becomes the pair's current one
    again without being computed. The target of a pair is the scene of lower id, however the pair was named: an edge is
    the same whichever scene came first.
    """
    scenes = store.scenes.list()
    graphs = graph_keys(store, scenes, settings)
    recipe = recipe_key(settings.register)
    wanted = _wanted(store, pairs, graphs, settings)
    if pairs in ("auto", "all"):
        wanted = _lacking(store, wanted, graphs, recipe)
    edges = {_key(recipe, graphs, a, b).digest: (a, b) for a, b in wanted}
    jobs = {
        key: (store.location, (a, graphs[a].digest), (b, graphs[b].digest), settings.register)
        for key, (a, b) in edges.items()
    }
    newest = store.registrations.newest()  # what is named is registered again: only what comes later counts
    after = 0 if pairs in ("auto", "all") else newest
    done, named = partial(store.registrations.kept, after=after), pairs not in ("auto", "all")
    shared = SharedJobs(store, "register", "edge", jobs, edges, done, progress, again=named)
    results = shared.results(lambda arguments: run_jobs(register_scenes, arguments, settings.engine, quick=True))
    names = {scene.id: scene.name for scene in scenes}
    kept = noting(lambda: f"{shared.num_kept()} of {len(jobs)} pairs are registered and kept")
    with kept, closing(results):
        for key, edge in results:
            store.registrations.save(edge, _key(recipe, graphs, *edges[key]))
            shared.saved(key, f"{names[edge.target]}-{names[edge.source]}: {edge.status}")
    found = [store.registrations.find(key) for key in edges]
    return [stored.registration for stored in found if stored is not None]


def _key(recipe: RecipeKey, graphs: Mapping[str, RecipeKey], target: str, source: str) -> RecipeKey:
    """What names the registration of a pair; the other direction is another registration."""
    return recipe.of(graphs[target].digest, graphs[source].digest)


def _lacking(store: Store, pairs: Sequence[Pair], graphs: Mapping[str, RecipeKey], recipe: RecipeKey) -> list[Pair]:
    """Those of the pairs that this recipe has not registered, in either direction: older maps hold both."""
    current = {frozenset((r.registration.target, r.registration.source)): r for r in store.registrations.current()}
    lacking = []
    for pair in pairs:
        stands = current.get(frozenset(pair))
        keys = _key(recipe, graphs, *pair), _key(recipe, graphs, *reversed(pair))
        if stands is not None and stands.key in {key.digest for key in keys}:
            continue
        known = store.registrations.find(keys[0]) or store.registrations.find(keys[1])
        if known is None:
            lacking.append(pair)
        elif stands is not None and not stands.manual:
            store.registrations.adopt(known.number)
    return lacking


def stale(current: Iterable[StoredRegistration], graphs: Mapping[str, RecipeKey], settings: Settings) -> list[Pair]:
    """(target, source) of the edges that other settings or another version made; a person's own word is never stale.

    Args:
        current: the current edges.
        graphs: the key of each living scene's graph.
    """
    recipe = recipe_key(settings.register)
    computed = [stored for stored in current if not stored.manual and stored.review != "confirm"]
    ends = [(stored.registration.target, stored.registration.source, stored.key) for stored in computed]
    return [(a, b) for a, b, key in ends if {a, b} <= set(graphs) and key != _key(recipe, graphs, a, b).digest]


def add_edge(store: Store, a: Scene, b: Scene, S_target_source: Sim3, sigmas: np.ndarray, note: str) -> None:
    """Keep a person's own measurement of where ``b`` lies in ``a`` as the pair's current edge.

    Args:
        sigmas: (7,) standard deviations [rot_rad (3), trans (3), log_scale] on the source side, in the source's unit.

    Raises:
        InputError: sigmas that are not 7 positive finite numbers.
    """
    sigmas = np.asarray(sigmas, dtype=np.float64)
    if sigmas.shape != (7,) or not np.isfinite(sigmas).all() or not (sigmas > 0).all():
        raise InputError(f"a measured edge needs 7 positive standard deviations, got {sigmas.tolist()}")
    edge = Registration(
        target=a.id,
        source=b.id,
        status="accepted",
        S_target_source=S_target_source,
        information=np.diag(sigmas**-2.0),
        proposer=MANUAL,
        notes=(note,) if note else (),
    )
    store.registrations.save(edge)


def pair_of(store: Store, pair: str) -> tuple[Scene, Scene]:
    """The scenes of ``A:B``; a name may itself hold a colon.

    Raises:
        NotFoundError: no two scenes are called so.
        ConfigError: a scene with itself.
    """
    for at in (i for i, character in enumerate(pair) if character == ":"):
        try:
            return _two(store.scenes.get(pair[:at]), store.scenes.get(pair[at + 1 :]))
        except NotFoundError:
            continue
    raise NotFoundError(f"no two scenes are called {pair!r}: write A:B with names that gsmap list MAP scenes shows")


def _two(a: Scene, b: Scene) -> tuple[Scene, Scene]:
    if a.id == b.id:
        raise ConfigError(f"{a.name} with itself is no pair: name two scenes")
    return a, b


def read_pairs(store: Store, path: Path) -> list[tuple[Scene, Scene]]:
    """Pairs of a text file, one a line: ``A B`` or ``A:B``; ``#`` begins a remark. A name with spaces needs the colon.

    Raises:
        NotFoundError: no such file, or a line that names a scene which is not there.
        InputError: a line that is no pair.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise NotFoundError(f"no file of pairs at {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read pairs from {path}: {error}") from error
    pairs = []
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            pairs.append(_pair_on(store, text))
        except NotFoundError as error:
            if len(text.split()) != 2 and ":" not in text:
                raise InputError(
                    f"{path}, line {number}: a pair is written A B or A:B, got {line.strip()!r}"
                ) from error
            raise NotFoundError(f"{path}, line {number}: {error}") from error
    return pairs


def _pair_on(store: Store, text: str) -> tuple[Scene, Scene]:
    """The scenes of ``A B`` or ``A:B``; a space or colon may also belong to a name."""
    words = text.split()
    if len(words) == 2:
        with suppress(NotFoundError):
            return store.scenes.get(words[0]), store.scenes.get(words[1])
    return pair_of(store, text)


def _directed(a: str, b: str) -> Pair:
    """A pair of scene ids as (target, source): by content, so that no order of ingestion gives another edge."""
    return (a, b) if a < b else (b, a)


def _wanted(store: Store, pairs: Pairs, graphs: Mapping[str, RecipeKey], settings: Settings) -> list[Pair]:
    """The scene pairs that are asked for, each as (target, source), in a fixed order, each once."""
    lacking = set(without_graph(store, graphs))
    described = [scene for scene in graphs if scene not in lacking]
    if pairs == "all":
        return list(combinations(sorted(described), 2))
    if pairs == "auto":
        loaded = [_graph(store, graphs[scene]) for scene in described]
        candidates = candidate_pairs(loaded, placed=placed_scenes(store), params=settings.retrieve)
        again = {_directed(*pair) for pair in stale(store.registrations.current(), graphs, settings)} - set(candidates)
        return candidates + sorted(pair for pair in again if not set(pair) & lacking)
    if isinstance(pairs, Path):
        named = read_pairs(store, pairs)
    elif isinstance(pairs, str):
        named = [pair_of(store, pairs)]
    else:
        named = [(store.scenes.get(a), store.scenes.get(b)) for a, b in pairs]
    chosen: list[Pair] = []
    for a, b in named:
        for scene in _two(a, b):
            if scene.id not in graphs:
                raise NotFoundError(f"scene {scene.name} was removed: ingest it again first")
            if scene.id in lacking:
                raise NotFoundError(f"scene {scene.name} has no graph: run gsmap describe MAP {scene.name!r} first")
        chosen.append(_directed(a.id, b.id))
    return list(dict.fromkeys(chosen))


def placed_scenes(store: Store) -> dict[str, Placed]:
    """Where scenes lie by the newest poses, for finding neighbours."""
    bounds = {scene.id: scene.bounds for scene in store.scenes.list()}
    graph: PoseGraph | None = store.revisions.get()
    placed = {}
    for scene, pose in (graph.poses if graph else {}).items():
        if scene in bounds:
            S = pose.S_map_scene
            radius = S.scale * float(np.linalg.norm(np.diff(bounds[scene], axis=0))) / 2
            sigma = 0.0 if pose.covariance is None else S.scale * float(np.sqrt(np.diag(pose.covariance)[3:6].max()))
            placed[scene] = Placed(pose.component, S.apply(bounds[scene].mean(0)), radius, sigma)
    return placed


def _graph(store: Store, key: RecipeKey) -> SceneGraph:
    graph = store.graphs.load(key.inputs[0], key)
    assert graph is not None
    return graph
