"""Maps of many scenes without the work of making them, for what counts the cost of a map's books.

A street on which each capture overlaps the two before it. Every row is what gsmap writes, under the keys that it would
give them; the scenes share the arrays of the first one, and results are those of a `Pattern`, moved to where the street
has the scenes. Describing and registering are stood in for (`Filled.standing_in`), reading and writing are not.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from sqlalchemy import insert, select

import gsmap.describe
import gsmap.map
import gsmap.optimize
import gsmap.register
import gsmap.retrieve
from gsmap.geometry.directions import rotation_to_z
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import exp
from gsmap.map import Map
from gsmap.map.page.source import MapPageSource
from gsmap.map.scene_lookup import keys_of_lookups
from gsmap.map.stages import describe, register
from gsmap.methods import RecipeKey
from gsmap.register import recipe_key
from gsmap.retrieve import SceneNodes, index_recipe, new_segment, select_nodes
from gsmap.retrieve.codes import with_signs
from gsmap.store import recipes
from gsmap.store.catalog import now
from gsmap.store.chunk_boxes import get_boxes, put_boxes
from gsmap.store.graphs import Graphs
from gsmap.store.indexes import Lookup
from gsmap.store.schema import files, registrations, results, scene_facts, scenes
from gsmap.types import Cameras, Gaussians, NodeLayer, Registration, SceneGraph, Segments, Sim3
from gsmap.types.retrieval import Candidate
from gsmap.types.segments import merged, to_merge
from tools.bench.spent import spent, statements

NEAR, TRIED = 2, 10  # captures before it that a capture overlaps, and is tried with
_REGISTER = register.register
_SIGMAS = np.array([2e-4] * 3 + [1e-3] * 3 + [1e-3])


@dataclass(frozen=True, eq=False)
class Pattern:
    """What the scenes of a filled map are copies of.

    Args:
        gaussians, cameras, graph: of the capture.
        accepted, refused: registrations of a pair that overlaps and of one that does not.
        describe_s, register_s: CPU seconds that one of each took; 0 where they were made up.
        file_rows_bytes: of the rows that a scene's own files would have.
    """

    gaussians: Gaussians
    cameras: Cameras
    graph: SceneGraph
    accepted: Registration
    refused: Registration
    describe_s: float = 0.0
    register_s: float = 0.0
    file_rows_bytes: float = 0.0


def tiny_pattern() -> Pattern:
    """Made up: a few Gaussians, a graph of a few nodes."""
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        rng.uniform(-4, 4, (64, 3)), rng.normal(size=(64, 4)), rng.normal(size=(64, 3)) - 4, np.ones(64),
        np.zeros((64, 1, 3)),
    )  # fmt: skip
    pose = np.tile(np.eye(4), (2, 1, 1))
    cameras = Cameras(pose, np.tile([50.0, 50, 32, 24], (2, 1)), np.tile([64, 48], (2, 1)), ("a", "b"))
    nodes = NodeLayer(
        positions=rng.normal(size=(5, 3)),
        features=np.ones((5, 2)),
        descriptor_id="made",
        extents=np.sort(rng.normal(size=(5, 2, 3)), axis=1),
        weights=np.ones(5),
        types=np.zeros(5, dtype=np.int64),
        embeddings=rng.normal(size=(5, 8)),
        num_views=np.ones(5, dtype=np.int64),
    )
    graph = SceneGraph("", {"landmarks": nodes}, np.array([0, 0, 1.0]), 1.0, segments=_tiny_segments(rng))
    edge = Registration(
        "a", "b", "accepted", "", Sim3.identity(), np.diag(_SIGMAS**-2.0), 100, 200, 0.5, "graph:landmarks"
    )
    return Pattern(gaussians, cameras, graph, edge, Registration("a", "b", "no_match", "no pose was found"))


def _tiny_segments(rng: np.random.Generator) -> Segments:
    """Two segments of 32 Gaussians and 240 samples each."""
    samples = np.concatenate([rng.uniform(0, 0.8, (240, 3)) + at for at in ([1.0, 1, 0], [-2.0, 1, 0])])
    boxes = np.array([[part.min(0), part.max(0)] for part in np.split(samples, 2)])
    members, colours = np.resize([0, 1], 64), np.full((480, 3), 50.0)
    return Segments(members, boxes.mean(1), boxes, colours[:2], samples, colours, np.full(2, 240))


def pattern(folder: Path) -> Pattern:
    """Two small captures of made rooms, really ingested, described and registered; kept in a folder, beside it the CPU
    seconds that each took."""
    from gsmap_synthetic import make_captures

    took = folder.with_suffix(".json")
    with gsmap.map.open_or_create(folder) as m:
        if not took.exists():
            routes, size = [[0], [0]], (160, 120)
            for capture in make_captures(
                0, 2, steps=0, num_frames=20, num_gaussians=15_000, size_px=size, routes=routes
            ):
                m.ingest(capture.gaussians, cameras=capture.cameras, name=capture.name)
            one, two = m.scenes()
            spent = {}
            for stage, work in (
                ("describe", lambda: m.describe(one.name)),
                ("register", lambda: m.register(f"{one.name}:{two.name}")),
            ):
                start = time.process_time()
                work()
                spent[stage] = time.process_time() - start
                m.describe()
            took.write_text(json.dumps(spent))
        spent = json.loads(took.read_text())
        one = m.scenes()[0]
        edge = m.store.registrations.current()[0].registration
        gaussians, cameras = m.read(one.name)
        graph = m.store.graphs.load(one.id)
        with m.store.catalog.read() as connection:
            rows = connection.execute(select(files)).all()
        size = sum(len(row.path) + 2 * (len(row.group_id) + 8) + len(row.sha256) for row in rows) / 2
    if edge.status != "accepted":
        raise SystemExit(f"the two made captures were not registered ({edge.reason}): the bench needs an edge")
    refused = replace(edge, status="no_match", reason="no pose was found", S_target_source=None, information=None)
    return Pattern(gaussians, cameras, graph, edge, refused, spent["describe"], spent["register"], size)


@dataclass(eq=False)
class Filled:
    """A map filled with rows.

    Args:
        map: open.
        made: what its scenes are copies of.
        order: ids of its scenes along the street.
        num_tried: so many of them were tried with those before them.
    """

    map: Map
    made: Pattern
    order: list[str] = field(default_factory=list)
    num_tried: int = 0

    @property
    def num_scenes(self) -> int:
        return len(self.order)

    def truth(self, place: int) -> Sim3:
        """``S_world_scene`` of a capture along the street, each in a level frame of its own."""
        turn, x, y = np.random.default_rng(place).normal(size=3)
        up = np.array([0.0, 0, 1]) if self.made.graph.up is None else self.made.graph.up
        own = Sim3(exp_so3([0, 0, turn]) @ rotation_to_z(up), [x, y, 0])
        return Sim3(exp_so3([0, 0, 0.05 * place]), [4.0 * place, 2 * np.sin(place / 5), 0]) @ own

    def edge(self, a: int, b: int) -> Registration:
        """The registration of two captures by their places."""
        (target, i), (source, j) = sorted([(self.order[a], a), (self.order[b], b)])
        if abs(i - j) > NEAR:
            return replace(self.made.refused, target=target, source=source)
        rng = np.random.default_rng([min(i, j), max(i, j)])
        step = rng.normal(size=(1, 7)) * _SIGMAS
        step[0, 6] = 0
        S = self.truth(i).inverse() @ self.truth(j) @ exp(step).item(0)
        information = np.diag(_SIGMAS**-2.0)
        # Of its own: where all pairs are as doubtful, one that noise has thrown out puts all the others in doubt.
        evidence = dict(self.made.accepted.evidence)
        evidence["look_alike"] = evidence.get("look_alike", 0.001) * float(np.exp(rng.normal(0, 0.5)))
        return replace(
            self.made.accepted,
            target=target,
            source=source,
            S_target_source=S,
            information=information,
            evidence=evidence,
        )

    def add(self) -> str:
        """Ingest one capture more; its id."""
        means = self.made.gaussians.means + np.float32(0.001 * (1 + len(self.order)))
        name = f"street-{len(self.order):05d}"
        scene, _ = self.map.store.scenes.add(replace(self.made.gaussians, means=means), self.made.cameras, name=name)
        self.order.append(scene.id)
        return scene.id

    def some_pair(self) -> str:
        names = self.map.store.scenes.names()
        return f"{names[self.order[-2]]}:{names[self.order[-1]]}"

    def catalog_bytes(self) -> int:
        """Of the catalog with its log folded in."""
        store = self.map.store
        with store.catalog.lock():
            store.catalog._fold(at_bytes=1)
        return (store.folder / "map.sqlite").stat().st_size

    @contextmanager
    def anew(self) -> Iterator[None]:
        """The map opened once more, without what it remembers of what it has read."""
        before = self.map
        with gsmap.map.open(before.store.folder) as self.map:
            yield
        self.map = before

    @contextmanager
    def standing_in(self, lookup: bool = False) -> Iterator[None]:
        """Describing and registering give what the street has.

        Args:
            lookup: which pairs are tried is asked of the map; else it is the captures before.
        """
        unprepared = mock.patch.object(register, "prepare_missing")
        with unprepared, mock.patch.object(describe, "run_jobs", self._describe):
            if lookup:  # within another one that looks nothing up, too
                asks = mock.patch.object(register, "register", _REGISTER)
                with asks, mock.patch.object(register, "run_jobs", self._register):
                    yield
            else:
                with mock.patch.object(register, "register", self._register_new):
                    yield

    @contextmanager
    def counting(self) -> Iterator[Counter[str]]:
        """SQL statements, and graphs that are loaded, while this is open."""
        with statements(self.map.store.catalog.engine) as counts, spent([("graphs", Graphs, "load")]) as loaded:
            try:
                yield counts
            finally:
                counts["graphs"] = loaded.times["graphs"]

    def _describe(self, job: Any, arguments: Any, *_: Any, **__: Any) -> Iterator[tuple[int, tuple[SceneGraph, None]]]:
        for i, (_, scene, *_rest) in enumerate(arguments):
            yield i, (replace(self.made.graph, scene_id=scene), None)

    def _register(self, job: Any, arguments: Any, *_: Any, **__: Any) -> Iterator[tuple[int, Registration]]:
        place = {scene: k for k, scene in enumerate(self.order)}
        for i, (_, target, source, *_rest) in enumerate(arguments):
            yield i, self.edge(place[target[0]], place[source[0]])

    def _register_new(self, store: Any, pairs: Any, settings: Any, *_: Any) -> list[Registration]:
        """Captures that were never tried, with those before them."""
        assert pairs == "auto"
        new = [k for k in range(self.num_tried, len(self.order)) if k]
        self.num_tried = len(self.order)
        keys = self.keys([self.order[i] for k in new for i in range(max(0, k - TRIED), k + 1)])
        recipe, made = recipe_key(settings.register), []
        for k in new:
            for before in range(max(0, k - TRIED), k):
                edge = self.edge(before, k)
                made.append((edge, recipe.of(keys[edge.target].digest, keys[edge.source].digest)))
        store.registrations.save_all(made)
        return [edge for edge, _ in made]

    def keys(self, ids: Sequence[str]) -> dict[str, RecipeKey]:
        """What names the graphs of scenes."""
        store = self.map.store
        some = set(ids)
        wanted = [scene for scene in store.scenes.summaries() if scene.id in some]
        return describe.graph_keys(store, wanted, self.map.settings)


@contextmanager
def filled(path: Path, num: int, made: Pattern, *, asked: bool = False) -> Iterator[Filled]:
    """A new map of so many scenes, solved.

    Args:
        asked: its scenes lie in the index and have asked it, each with nodes of its own (`_fill_index`).
    """
    with gsmap.map.create(path) as m:
        one = Filled(m, made)
        with one.standing_in():
            one.add()
            m.describe()
            _add_rows(one, num - 1)
            one.num_tried = num
            if asked:
                _fill_index(one)
            m.optimize()
            yield one


@contextmanager
def kept(path: Path, num: int, made: Pattern, scratch: Path, *, asked: bool = False) -> Iterator[Filled]:
    """A copy of such a map, which is filled only where there is none at a path that today's recipes would leave so."""
    keys = (
        gsmap.describe.recipe_key(),
        gsmap.register.recipe_key(),
        gsmap.retrieve.recipe_key(gsmap.retrieve.Params()),
        gsmap.optimize.recipe_key(gsmap.optimize.Params()),
    )
    made_by = "".join(key.recipe for key in keys)
    path = path.with_name(f"{path.name}-{hashlib.sha256(made_by.encode()).hexdigest()[:12]}")
    if not path.exists():
        partial = path.with_suffix(".partial")
        shutil.rmtree(partial, ignore_errors=True)
        with filled(partial, num, made, asked=asked) as one:
            order = one.order
        (partial / "order.json").write_text(json.dumps(order))
        partial.rename(path)
    shutil.copytree(path, scratch)
    order = json.loads((scratch / "order.json").read_text())
    (scratch / "order.json").unlink()
    with gsmap.map.open(scratch) as m:
        one = Filled(m, made, order, len(order))
        with one.standing_in():
            yield one


def verbs(one: Filled, scratch: Path) -> dict[str, Callable[[], object]]:
    """Return calls that do what each verb does on a filled map that has objects, in an order in which all can run.

    A verb that writes changes one scene, edge or object. Verbs whose work is that of their input alone (`convert`,
    `clean`, `demo`) and verbs that read every array (`check`, `backup`) by purpose are not among them.

    Args:
        scratch: an empty folder.
    """
    m = one.map
    names = m.store.scenes.names()
    middle, second = (names[one.order[k]] for k in (one.num_scenes // 2, -2))
    pair = one.some_pair()
    left, right = pair.split(":")

    def add_and_update() -> None:
        one.add()
        m.update()

    def remove_and_restore() -> None:
        m.remove(second)
        m.restore_scene(second)

    def evaluate() -> None:
        truth = scratch / "truth"
        truth.mkdir()
        for k, scene in enumerate(one.order[: len(names)]):
            pose = {"T_scene_world": one.truth(k).inverse().matrix().tolist()}
            (truth / f"{names[scene]}.json").write_text(json.dumps(pose))
        m.evaluate(truth)

    return {
        "update, nothing new": m.update,
        "update, one scene more": add_and_update,
        "graph, one scene more": m.objects,
        "graph": m.objects,
        "history": lambda: m.history("o1"),
        "edit OBJECT": lambda: m.edit_object("o1", name="sofa"),
        "find --like OBJECT": lambda: m.find(like="o1"),
        "status": m.status,
        "list scenes": m.scene_rows,
        "list edges": m.edge_rows,
        "list revisions": m.revision_rows,
        "list tiles": m.tile_rows,
        "list photos": m.photo_rows,
        "show SCENE": lambda: m.show_scene(middle),
        "show A:B": lambda: m.show_pair(pair),
        "show OBJECT": lambda: m.history("o2"),
        "why A:B": lambda: m.why(pair),
        "poses": m.pose_rows,
        "measure": lambda: m.measure(f"{left}:0,0,0", f"{right}:0,0,0"),
        "settings": m.setting_rows,
        "changes, nothing dated": m.changes,
        "edit SCENE": lambda: m.edit(middle, note="wet"),
        "confirm": lambda: m.confirm(pair),
        "reject": lambda: m.reject(pair, withdraw=True),
        "optimize, nothing new": m.optimize,
        "diff": lambda: m.diff(*[row.number for row in m.revision_rows()][-2:]),
        "thin --dry-run": lambda: m.thin(keep_days=30, dry_run=True),
        "report": lambda: m.report(scratch / "report.html", pictures=False),
        "evaluate": evaluate,
        "view, content": lambda: MapPageSource(m.store, m.settings).content(),
        "branch": lambda: m.branch("other"),
        "tag": lambda: m.tag("now"),
        "prune --dry-run": lambda: m.prune(dry_run=True),
        "remove, restore-scene": remove_and_restore,
        "clone": lambda: m.clone(scratch / "clone.gsmap"),
    }


def _fill_index(one: Filled) -> None:
    """Put all scenes into the index, each with nodes as far from each other's as those of one scene and type are, and
    note that each has asked it and found those before it, all of which were tried."""
    store, params = one.map.store, one.map.settings.retrieve
    keys, rng = one.keys(one.order), np.random.default_rng(1)
    voters = select_nodes(one.made.graph, "", params.nodes_per_scene)
    lists = np.unique(voters.index_nodes.keys >> 8, return_inverse=True)[1]  # without signs: of one descriptor and type
    for start in range(0, len(one.order), 512):
        some = one.order[start : start + 512]
        segment = new_segment([_alike(voters, lists, scene, keys[scene].digest, rng) for scene in some])
        recipe = index_recipe(params)
        old = store.indexes.segments(recipe)
        old = [old[k] for k in to_merge([len(s.members) for s in old], len(some))]
        whole = merged([*old, segment])
        members = [member for member in whole.members if member is not None]
        store.indexes.save_segment(recipe, members, whole.arrays, [s.id for s in old])
    named = keys_of_lookups(keys, params)
    said = []
    for k, scene in enumerate(one.order):
        before = one.order[max(0, k - TRIED) : k][::-1]
        candidates = tuple(Candidate(other, float(TRIED - i), 1.0) for i, other in enumerate(before))
        said.append(Lookup(scene, named[scene], candidates, 0))
    for start in range(0, len(said), 1000):
        store.indexes.save_lookups(said[start : start + 1000])


def _alike(voters: SceneNodes, lists: np.ndarray, scene: str, graph: str, rng: np.random.Generator) -> SceneNodes:
    """Another scene's nodes: each of these, moved by half the way between two others of its type."""
    kept = voters.index_nodes
    order = np.lexsort((rng.random(len(lists)), lists))  # within each list a random one
    step = np.zeros(kept.codes.shape)
    same = lists[order] == np.roll(lists[order], 1)
    step[order] = np.where(same[:, None], kept.codes[order].astype(int) - kept.codes[np.roll(order, 1)], 0) / 2
    codes = np.clip(np.rint(kept.codes + step), -127, 127).astype(np.int8)
    keys = with_signs(kept.keys, codes)
    member = replace(voters.member, scene=scene, graph=graph)
    positions = (kept.positions + rng.normal(size=kept.positions.shape) * 0.3).astype(np.float16)
    return replace(voters, member=member, index_nodes=replace(kept, keys=keys, codes=codes, positions=positions))


def _add_rows(one: Filled, count: int) -> None:
    """Scenes, graphs and registrations, as many rows at once."""
    store = one.map.store
    with store.catalog.write() as connection:
        first = connection.execute(select(scenes)).one()
        boxes = get_boxes(connection, first.number)
        graph = connection.execute(select(results).where(results.c.kind == "graphs")).one()
        for k in range(1, count + 1):
            mine = hashlib.sha256(f"street {k}".encode()).hexdigest()[:32]
            row = dict(first._mapping) | {"id": mine, "number": first.number + k, "name": f"street-{k:05d}"}
            connection.execute(insert(scenes), row)
            put_boxes(connection, first.number + k, boxes)
            one.order.append(mine)
        said = [
            {"scene": s, "kind": "name", "value": f"street-{k:05d}", "author": "", "created_at": now()}
            for k, s in enumerate(one.order[1:], 1)
        ]
        if said:
            connection.execute(insert(scene_facts), said)
        keys = one.keys(one.order)
        content = {name: value for name, value in graph._mapping.items() if name != "number"}
        about = [content | {"key": keys[s].digest, "scene": s} for s in one.order[1:]]
        if about:
            connection.execute(insert(results), about)
        recipe = recipe_key(one.map.settings.register)
        digest = recipes.save_recipe(connection, recipe)
        rows = []
        for k in range(1, count + 1):
            for before in range(max(0, k - TRIED), k):
                e = one.edge(before, k)
                parts = vars(e) | {"exact": int(e.exact), "notes": list(e.notes), "recipe": digest}
                parts |= {"key": recipe.of(keys[e.target].digest, keys[e.source].digest).digest}
                rows.append(parts | {"pair": f"{e.target}:{e.source}", "adopts": None, "created_at": now()})
        for start in range(0, len(rows), 1000):
            connection.execute(insert(registrations), rows[start : start + 1000])
