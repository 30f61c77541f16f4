"""Register stage: choose pairs, and register the pairs without a result of the current recipe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from gsmap.engine import run_jobs
from gsmap.errors import InputError, NotFoundError
from gsmap.map.jobs import register_scenes
from gsmap.map.reports import checked_pair, pair_of
from gsmap.map.scene_lookup import keys_of_lookups, look_up_scenes
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import SharedJobs, note_interruption
from gsmap.map.stages.describe import graph_keys, without_graph
from gsmap.map.stages.prepare import prepare_missing
from gsmap.methods import RecipeKey
from gsmap.register import recipe_key
from gsmap.retrieve import PairSchedule, ScenePosition, directed, neighbours
from gsmap.store import MANUAL, Store
from gsmap.store.registrations import EdgeSummary
from gsmap.store.scenes import SceneSummary
from gsmap.types import Registration, Scene, Sim3
from gsmap.types.progress import StageProgress
from gsmap.types.sim3 import check_sim3

Pair = tuple[str, str]
Pairs = str | Path | Sequence[Pair]
"""``auto``, ``all``, ``A:B``, a file of pairs, or the pairs themselves."""


def register(
    store: Store, pairs: Pairs, settings: Settings, progress: StageProgress, known: RegisteredPairs | None = None
) -> list[Registration]:
    """Register pairs; ``auto`` and ``all`` skip pairs that the current recipe has registered already.

    A result that this recipe made before, under settings that were changed meanwhile, becomes the pair's current one
    again without being computed. The target of a pair is the scene of lower id, however the pair was named: an edge is
    the same whichever scene came first.

    Args:
        known: state from an earlier call in the same update; only later changes are read.
    """
    scenes = store.scenes.summaries()
    work = _RegistrationContext(store, scenes, graph_keys(store, scenes, settings), settings, progress)
    known = RegisteredPairs() if known is None else known
    if pairs == "auto":
        return _register_candidates(work, known)
    if pairs == "all":
        everything = list(combinations(sorted(work.described), 2))
        known.update(work)
        return work.register([pair for pair in everything if not known.has(*pair)], after=0)
    # What is named is registered again: only what comes later counts.
    return work.register(_named(store, pairs, work), after=store.registrations.newest_number(), again=True)


class _RegistrationContext:
    """The scenes, graph keys and settings of a registration run.

    Args:
        graphs: graph key of each living scene.
    """

    def __init__(
        self,
        store: Store,
        scenes: Sequence[SceneSummary],
        graphs: Mapping[str, RecipeKey],
        settings: Settings,
        progress: StageProgress,
    ) -> None:
        self.store, self.scenes, self.graphs, self.settings, self.progress = store, scenes, graphs, settings, progress
        self.recipe = recipe_key(settings.register)
        self.lacking = set(without_graph(store, graphs))
        self.described = {scene: key for scene, key in graphs.items() if scene not in self.lacking}

    def key(self, target: str, source: str) -> RecipeKey:
        """Return the key of a pair's registration; the reverse direction has another key."""
        return self.recipe.of(self.graphs[target].digest, self.graphs[source].digest)

    def register(self, pairs: Sequence[Pair], after: int, *, again: bool = False) -> list[Registration]:
        """Register pairs, sharing the work with other processes.

        Args:
            after: ignore registrations up to this number.
            again: retry quarantined pairs.
        """
        store, settings = self.store, self.settings
        ends = sorted({scene for pair in pairs for scene in pair})
        prepare_missing(store, [(scene, self.graphs[scene].digest) for scene in ends], settings)
        edges = {self.key(a, b).digest: (a, b) for a, b in pairs}
        jobs = {
            key: (store.location, (a, self.graphs[a].digest), (b, self.graphs[b].digest), settings.register)
            for key, (a, b) in edges.items()
        }
        done = partial(store.registrations.stored_keys, after=after)
        shared = SharedJobs(store, "register", "edge", jobs, edges, done, self.progress, again=again)
        made = shared.batches(lambda arguments: run_jobs(register_scenes, arguments, settings.engine, quick=True))
        names = {scene.id: scene.name for scene in self.scenes}
        kept = note_interruption(lambda: f"{shared.num_kept()} of {len(jobs)} pairs are registered and kept")
        with kept, closing(made):
            for batch in made:
                store.registrations.save_all([(edge, self.key(*edges[key])) for key, edge in batch])
                for key, edge in batch:
                    shared.saved(key, f"{names[edge.target]}-{names[edge.source]}: {edge.status}")
        return store.registrations.newest_with_keys(edges)


class RegisteredPairs:
    """The pairs registered by the current recipe, in either direction (old maps may have both).

    What it made before, under settings that were changed meanwhile, is made current again. Looked at once more, only
    those pairs are judged of which something else stands by now.

    Args:
        held: pairs with a usable edge that is not doubtful, by `EdgeSummary.pair`.
        stale: pairs of described scenes registered by other settings or versions.
    """

    def __init__(self) -> None:
        self.held: dict[str, Pair] = {}
        self.stale: list[Pair] = []
        self._by: tuple[str, float, dict[str, str]] = ("", 0.0, {})
        self._forget()

    def update(self, work: _RegistrationContext) -> None:
        """Read the current registrations."""
        self._read(work)
        adopted = [self._adopt(work, pair, keys) for pair, keys in self._replaced.values()]
        if any(adopted):
            self._read(work)
        self.stale = sorted(
            pair
            for pair, keys in self._replaced.values()
            if all(scene in work.described for scene in pair) and keys.isdisjoint(_keys(work, pair))
        )

    def has(self, a: str, b: str) -> bool:
        """Return true if a pair is registered."""
        return ":".join(directed(a, b)) in self._registered

    def _forget(self) -> None:
        self.held.clear()
        self._judged: dict[str, EdgeSummary] = {}
        self._registered: set[str] = set()
        self._replaced: dict[str, tuple[Pair, frozenset[str]]] = {}

    def _read(self, work: _RegistrationContext) -> None:
        """Read all current registrations and classify those that changed."""
        by = (
            work.recipe.recipe,
            work.settings.optimize.max_look_alike,
            {scene: key.digest for scene, key in work.graphs.items()},
        )
        tried = work.store.registrations.all_summaries()
        if by != self._by:
            self._forget()
            self._by = by
        self._judge_all(work, tried)
        if len(self._judged) != len(tried):  # some have gone
            self._forget()
            self._judge_all(work, tried)

    def _judge_all(self, work: _RegistrationContext, tried: Sequence[EdgeSummary]) -> None:
        judged, digest_of, (_, max_look_alike, graphs) = self._judged, work.recipe.digest_of, self._by
        for one in tried:
            pair = one.pair
            if judged.get(pair) is one:
                continue
            if pair in judged:
                self._registered.discard(pair)
                self._replaced.pop(pair, None)
                self.held.pop(pair, None)
            judged[pair] = one
            a, _, b = pair.partition(":")
            first, second = graphs.get(a), graphs.get(b)
            if first is None or second is None:
                continue
            mine = [digest_of(first, second)]
            if one.key not in mine:
                mine.append(digest_of(second, first))
            current = one.key in mine
            if current or not one.keys.isdisjoint(mine):
                self._registered.add(pair)
            if not current and not one.is_specified:
                self._replaced[pair] = (a, b), one.keys
            elif one.usable and (one.is_specified or not one.look_alike > max_look_alike):
                self.held[pair] = (a, b)

    def _adopt(self, work: _RegistrationContext, pair: Pair, keys: frozenset[str]) -> bool:
        mine = [key for key in _keys(work, pair) if key in keys]
        known = [work.store.registrations.newest_with_key(key) for key in mine]
        if known:
            work.store.registrations.adopt(max(stored.number for stored in known if stored is not None))
        return bool(known)


def _keys(work: _RegistrationContext, pair: Pair) -> tuple[str, str]:
    """Return the keys of a pair's registration in both directions."""
    a, b = pair
    return work.key(a, b).digest, work.key(b, a).digest


def _register_candidates(work: _RegistrationContext, known: RegisteredPairs) -> list[Registration]:
    """Register candidates of retrieval round by round, and stale pairs.

    Only scenes that have not been looked up by this recipe are, and nothing is read of the others.
    """
    store, params = work.store, work.settings.retrieve
    known.update(work)
    asked, keys = store.indexes.lookup_states(), keys_of_lookups(work.described, params)
    new = sorted(scene for scene in work.described if asked.get(scene, ("", None))[0] != keys[scene])
    if new:
        look_up_scenes(store, work.described, new, params, work.settings.index_recipes(), work.progress)
    ties = Counter(scene for pair in known.held.values() for scene in pair)
    # Scenes with untried candidates, and scenes that have lost edges since.
    short = {
        s
        for s, (_, left) in asked.items()
        if s in keys and (left is None or (left and ties[s] < params.max_edges_per_scene))
    }
    lookups = store.indexes.lookups(short.union(new))
    lists = {
        one.scene: [directed(one.scene, c.scene) for c in one.candidates[: params.top_k] if c.scene in work.described]
        for one in lookups
    }
    beside: dict[str, list[Pair]] = {}
    for pair in neighbours({s: at for s, at in placed_scenes(store).items() if s in work.described}, params):
        beside.setdefault(pair[0], []).append(pair)
    bar = work.settings.optimize.max_look_alike
    # Next to all neighbours have been tried; a list with one that has not keeps them all, and so its order.
    proposed = [*lists.values(), *(pairs for pairs in beside.values() if not all(known.has(*pair) for pair in pairs))]
    tried = {pair for pairs in proposed for pair in pairs if known.has(*pair)}
    rounds = PairSchedule(proposed, tried.union(known.stale), known.held.values(), params)
    pairs, made = known.stale + rounds.next(), list[Registration]()
    while pairs:
        found = work.register(pairs, after=0)
        made += found
        for edge in found:
            if edge.status == "accepted" and not edge.evidence.get("look_alike", np.nan) > bar:
                rounds.add_edge(edge.target, edge.source)
        pairs = rounds.next()
    if lists:
        store.indexes.set_num_left({scene: len(set(mine) - rounds.tried) for scene, mine in lists.items()})
    return made


def num_stale(pairs: Iterable[tuple[str, str]], graphs: Mapping[str, RecipeKey], settings: Settings) -> int:
    """Count the edges that other settings or versions computed; manually measured edges are never stale.

    Args:
        pairs: pairs with the key of their current registration, see
            `gsmap.store.registrations.Registrations.current_keys`.
        graphs: graph key of each living scene.
    """
    digest_of = recipe_key(settings.register).digest_of
    digests = {scene: key.digest for scene, key in graphs.items()}
    count = 0
    for pair, key in pairs:
        a, _, b = pair.partition(":")
        first, second = digests.get(a), digests.get(b)
        if key and first is not None and second is not None:
            count += key != digest_of(first, second) and key != digest_of(second, first)
    return count


def add_edge(store: Store, a: Scene, b: Scene, S_target_source: Sim3, sigmas: np.ndarray, note: str) -> None:
    """Store a measured pose of ``b`` in ``a`` as the pair's current edge.

    Args:
        sigmas: (7,) standard deviations [rot_rad (3), trans (3), log_scale] on the source side, in the source's unit.

    Raises:
        InputError: a pose that is not a `Sim3`, or sigmas that are not 7 positive finite numbers.
    """
    check_sim3(S_target_source, "S_target_source")
    sigmas = np.asarray(sigmas, dtype=np.float64)
    if sigmas.shape != (7,) or not np.isfinite(sigmas).all() or not (sigmas > 0).all():
        raise InputError(
            f"a measured edge needs 7 positive standard deviations, got {sigmas.tolist()}", code="invalid_sigma"
        )
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


def read_pairs(store: Store, path: Path) -> list[tuple[Scene, Scene]]:
    """Read pairs from a text file, one per line: ``A B`` or ``A:B``; ``#`` starts a comment.

    Raises:
        NotFoundError: no such file, or a line that names a scene which is not there.
        InputError: a line that is no pair.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise NotFoundError(f"there is no file of pairs at {path}", code="file_not_found") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read pairs from {path}: {error}", code="invalid_pairs_file") from error
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
                    f"{path}, line {number}: a pair must be written as A B or A:B, got {line.strip()!r}",
                    code="invalid_pairs_file",
                ) from error
            raise NotFoundError(f"{path}, line {number}: {error}", code=error.code) from error
    return pairs


def _pair_on(store: Store, text: str) -> tuple[Scene, Scene]:
    """Return the scenes of ``A B`` or ``A:B``; names may contain a space or colon."""
    words = text.split()
    if len(words) == 2:
        with suppress(NotFoundError):
            return store.scenes.get(words[0]), store.scenes.get(words[1])
    return pair_of(store, text)


def _named(store: Store, pairs: str | Path | Sequence[Pair], work: _RegistrationContext) -> list[Pair]:
    """Return the given pairs as (target, source), sorted within each pair, without repetition."""
    if isinstance(pairs, Path):
        named = read_pairs(store, pairs)
    elif isinstance(pairs, str):
        named = [pair_of(store, pairs)]
    else:
        named = [(store.scenes.get(a), store.scenes.get(b)) for a, b in pairs]
    chosen: list[Pair] = []
    for a, b in named:
        for scene in checked_pair(a, b):
            if scene.id not in work.graphs:
                raise NotFoundError(f"scene {scene.name} was removed: ingest it again first", code="scene_removed")
            if scene.id in work.lacking:
                raise NotFoundError(
                    f"scene {scene.name} has no graph: run gsmap describe MAP {scene.name!r} first", code="no_graph"
                )
        chosen.append(directed(a.id, b.id))
    return list(dict.fromkeys(chosen))


def placed_scenes(store: Store) -> dict[str, ScenePosition]:
    """Return the centre and radius of each placed scene, by which neighbours are found."""
    bounds, poses = store.scenes.bounds(), store.revisions.poses()
    scenes = [scene for scene in poses if scene in bounds]
    if not scenes:
        return {}
    boxes = np.array([bounds[scene] for scene in scenes])
    found = [poses[scene] for scene in scenes]
    rotations = np.array([pose.S_map_scene.rotation for pose in found])
    scales = np.array([pose.S_map_scene.scale for pose in found])
    centres = np.einsum("nij,nj->ni", rotations, boxes.mean(1)) * scales[:, None]
    centres += [pose.S_map_scene.translation for pose in found]
    radii = scales * np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1) / 2
    known = [pose.covariance is not None for pose in found]
    sigmas = np.zeros(len(found))
    if any(known):
        variances = np.array([pose.covariance for pose in found if pose.covariance is not None])
        sigmas[known] = scales[known] * np.sqrt(np.diagonal(variances, axis1=1, axis2=2)[:, 3:6].max(1))
    parts = zip(scenes, found, centres, radii.tolist(), sigmas.tolist(), strict=True)
    return {scene: ScenePosition(pose.component, centre, radius, sigma) for scene, pose, centre, radius, sigma in parts}
