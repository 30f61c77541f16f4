"""The recipe: how captures become one maintained map.

Data flows one way: ingest, describe, register, optimize, export. Only this room loads from the store, calls a pure
stage, and saves what it returns; nothing is computed twice, because every result is stored under a digest of what it
was made from.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmap.engine import run_jobs
from gsmap.errors import ConfigError, NotFoundError
from gsmap.map import rows
from gsmap.store import Store
from gsmap.types import Cameras, Edge, Gaussians, PoseGraph, Prior, Registration, Scene, SceneGraph

if TYPE_CHECKING:
    from gsmap.export import ExportResult
    from gsmap.register.candidates import Placed
    from gsmap.store.integrity import Pruned
    from gsmap.view import ViewServer

Progress = Callable[[str, float, str], None]
"""Called with the stage's name, the fraction done in [0, 1], and what is being worked on."""


@dataclass(frozen=True)
class Ingested:
    """One capture taken in: its scene, whether it is new to the map, and what a person should know about it."""

    scene: Scene
    new: bool
    notes: tuple[str, ...] = ()


def create(path: str | os.PathLike[str], progress: Progress | None = None) -> Map:
    """Make an empty map and open it."""
    return Map(Store.create(path), progress)


def open(path: str | os.PathLike[str], progress: Progress | None = None) -> Map:
    """Open a map; read-only where its folder cannot be written."""
    mode = "r" if os.path.isdir(path) and not os.access(path, os.W_OK) else "w"
    return Map(Store.open(path, mode), progress)


def open_or_create(path: str | os.PathLike[str], progress: Progress | None = None) -> Map:
    """Open a map, making it first where there is none."""
    return open(path, progress) if os.path.exists(path) else create(path, progress)


def migrate(path: str | os.PathLike[str]) -> tuple[str | None, str | None]:
    """Bring an older map to this version's schema; returns the schema before and after."""
    return Store.migrate(path)


class Map(AbstractContextManager["Map"]):
    """An open map. Every method is a verb of the command line, and returns types or plain rows."""

    def __init__(self, store: Store, progress: Progress | None = None) -> None:
        self.store = store
        self._progress = progress or (lambda stage, fraction, text: None)

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        self.store.close()

    # --- ingest ------------------------------------------------------------------------------------------------------

    def ingest(
        self,
        *paths: str | os.PathLike[str],
        cameras: str | os.PathLike[str] | None = None,
        name: str | None = None,
        captured_at: str | None = None,
        scale: str = "auto",
    ) -> list[Ingested]:
        """Add the captures found at files and folders; each is read and checked whole before it is written.

        Args:
            cameras, name: of the one capture given.
            captured_at: ISO 8601; UTC where it has no zone.
            scale: ``known`` (metres), ``unknown`` (any unit) or ``auto`` (registration finds out).

        Raises:
            NotFoundError, InputError, ConfigError: see `gsmap.ingest`; captures before the bad one are in the map.
        """
        from gsmap.ingest import find_captures, read_capture

        found = find_captures(paths)
        if len(found) > 1 and (cameras is not None or name is not None):
            raise ConfigError(f"cameras and name are for one capture, {len(found)} were found: ingest them one by one")
        results = []
        for i, files in enumerate(found):
            self._progress("ingest", i / len(found), files.name)
            capture = read_capture(files, cameras=cameras, name=name, captured_at=captured_at, scale_policy=scale)
            scene, new = self.store.scenes.add(
                capture.gaussians,
                capture.cameras,
                name=capture.name,
                scale_policy=capture.scale_policy,
                captured_at=capture.captured_at,
                source=capture.source,
                antialiased=capture.antialiased,
                notes=capture.notes,
            )
            results.append(Ingested(scene, new, capture.notes))
        self._progress("ingest", 1.0, f"{len(results)} captures")
        return results

    # --- describe ----------------------------------------------------------------------------------------------------

    def describe(self, *scenes: str) -> list[SceneGraph]:
        """The scene graph of every scene (or of those named), made where the present method has not made it yet."""
        wanted = [self.store.scenes.get(ref) for ref in scenes] or self.scenes()
        methods = self._describe_missing(wanted)
        return [self._graph(s.id, methods[s.id]) for s in wanted]

    def _describe_missing(self, wanted: list[Scene]) -> dict[str, str]:
        """Make the graphs that are missing, reading none of the others; returns each scene's method."""
        from gsmap.map import models as kept
        from gsmap.map.jobs import describe_scene

        models = kept.specs(self.store)
        methods = {s.id: self._method(s) for s in wanted}
        missing = [s for s in wanted if self.store.graphs.find(s.id, methods[s.id]) is None]
        jobs = [(str(self.store.folder), s.id, models) for s in missing]
        for done, (i, graph) in enumerate(run_jobs(describe_scene, jobs), 1):
            self.store.graphs.save(graph, methods[graph.scene_id])
            self._progress("describe", done / len(missing), f"{missing[i].name}: {graph.num_nodes} nodes")
        return methods

    def _method(self, scene: Scene) -> str:
        """Text that decides a scene's graph beside its content: what is described, how, and under which scale."""
        from gsmap.describe import methods
        from gsmap.map import models as kept

        how = methods(models=kept.specs(self.store))
        return _digest(scene.scale_policy, *(f"{layer} {digest}" for layer, digest in sorted(how.items())))

    def _graph(self, scene_id: str, method: str) -> SceneGraph:
        graph = self.store.graphs.load(scene_id, method)
        assert graph is not None
        return graph

    # --- register ----------------------------------------------------------------------------------------------------

    def register(self, pairs: str = "auto") -> list[Registration]:
        """Register pairs of described scenes that lack an edge: ``auto`` candidates, ``all``, or one pair ``A:B``."""
        from gsmap.map.jobs import register_scenes
        from gsmap.register import METHOD_VERSION, Params

        methods = {s.id: self._method(s) for s in self.scenes()}
        wanted = self._pairs(pairs, methods)
        how = f"{METHOD_VERSION} {Params()!r}"
        keys = [_digest(a, methods[a], b, methods[b], how) for a, b in wanted]
        if pairs in ("auto", "all"):
            lacking = [i for i, key in enumerate(keys) if self.store.registrations.find(key) is None]
            wanted, keys = [wanted[i] for i in lacking], [keys[i] for i in lacking]
        jobs = [(str(self.store.folder), (a, methods[a]), (b, methods[b]), Params()) for a, b in wanted]
        names = {s.id: s.name for s in self.scenes()}
        found: dict[int, Registration] = {}
        for i, edge in run_jobs(register_scenes, jobs):
            self.store.registrations.save(edge, keys[i])
            found[i] = edge
            text = f"{names[edge.target]}-{names[edge.source]}: {edge.status}"
            self._progress("register", len(found) / len(wanted), text)
        return [found[i] for i in sorted(found)]

    def _pairs(self, pairs: str, methods: dict[str, str]) -> list[tuple[str, str]]:
        """The scene pairs that ``pairs`` asks for, each as (target, source), in a fixed order."""
        from gsmap.register.candidates import candidate_pairs

        described = [scene for scene, method in methods.items() if self.store.graphs.find(scene, method)]
        if pairs == "all":
            return [(a, b) for i, a in enumerate(described) for b in described[i + 1 :]]
        if pairs == "auto":
            graphs = [self._graph(scene, methods[scene]) for scene in described]
            return candidate_pairs(graphs, placed=self._placed())
        a, b = self._pair(pairs)
        for scene in (a, b):
            if scene.id not in described:
                raise NotFoundError(f"scene {scene.name} has no graph yet: run gsmap describe first")
        return [(a.id, b.id)]

    def _placed(self) -> dict[str, Placed]:
        """Where scenes lie, for finding neighbours."""
        from gsmap.register.candidates import Placed

        bounds = {s.id: s.bounds for s in self.scenes()}
        graph = self.pose_graph()
        placed = {}
        for scene, pose in (graph.poses if graph else {}).items():
            if scene in bounds:
                S = pose.S_map_scene
                radius = S.scale * float(np.linalg.norm(np.diff(bounds[scene], axis=0))) / 2
                sigma = (
                    0.0 if pose.covariance is None else S.scale * float(np.sqrt(np.diag(pose.covariance)[3:6].max()))
                )
                placed[scene] = Placed(pose.component, S.apply(bounds[scene].mean(0)), radius, sigma)
        return placed

    def _pair(self, pair: str) -> tuple[Scene, Scene]:
        """The scenes of ``A:B``; a name may itself hold a colon."""
        for at in (i for i, character in enumerate(pair) if character == ":"):
            try:
                return self.store.scenes.get(pair[:at]), self.store.scenes.get(pair[at + 1 :])
            except NotFoundError:
                continue
        raise NotFoundError(f"no two scenes are called {pair!r}: write A:B with names that gsmap list MAP scenes shows")

    def confirm(self, pair: str, note: str = "") -> None:
        """Vouch for the edge of a pair ``A:B``: it is used whatever the votes say."""
        a, b = self._pair(pair)
        self.store.registrations.judge(a.id, b.id, "confirm", note)

    def reject(self, pair: str, note: str = "") -> None:
        """Rule out the edge of a pair ``A:B``."""
        a, b = self._pair(pair)
        self.store.registrations.judge(a.id, b.id, "reject", note)

    # --- optimize ----------------------------------------------------------------------------------------------------

    def optimize(self) -> PoseGraph:
        """Solve for all scene poses and keep the answer as a new revision."""
        from gsmap.optimize import gravity_align, optimize

        (scenes, edges, priors), digest = self._pose_inputs()
        self._progress("optimize", 0.0, "poses")
        answer = optimize(scenes, edges, priors, self.pose_graph())
        ups = {graph.scene: np.array(graph.up) for graph in self.store.graphs.list() if graph.up is not None}
        answer = gravity_align(answer, ups, fixed={prior.scene for prior in priors})
        answer = replace(answer, parameters={**answer.parameters, "inputs": digest})
        number = self.store.revisions.save(answer)
        self._progress("optimize", 1.0, f"revision {number}")
        return answer

    def _pose_inputs(self) -> tuple[tuple[list[str], list[Edge], list[Prior]], str]:
        """What decides the poses (scenes, edges, priors), and its digest."""
        current = self.store.registrations.current()
        usable = [
            r
            for r in current
            if r.registration.S_target_source is not None
            and (r.verdict == "confirm" or (r.registration.status == "accepted" and r.verdict != "reject"))
        ]
        edges = [
            Edge(
                r.registration.target,
                r.registration.source,
                r.registration.S_target_source,
                r.registration.information,
                confirmed=r.verdict == "confirm",
            )
            for r in usable
        ]
        scenes, priors = [s.id for s in self.scenes()], self.store.priors.list()
        said = [f"{r.number} {r.verdict}" for r in usable]
        told = [(p.scene, p.S_map_scene.matrix().tolist(), list(p.sigmas), p.up, p.up_sigma_rad) for p in priors]
        return (scenes, edges, priors), _digest(*scenes, *said, repr(told))

    def update(self, *paths: str | os.PathLike[str]) -> list[Ingested]:
        """Ingest the files, then describe, register and optimize whatever is missing."""
        ingested = self.ingest(*paths) if paths else []
        self._describe_missing(self.scenes())
        while True:
            self.register()
            placed = self.pose_graph()
            if placed is not None and placed.parameters.get("inputs") == self._pose_inputs()[1]:
                return ingested
            self.optimize()  # scenes that now turn out to be neighbours are registered in the next round

    def set_prior(self, prior: Prior) -> None:
        """Tell where a scene lies (GPS, survey, an anchor), in place of what was told before; see `Prior`.

        Raises:
            InputError: what `optimize` could not use; nothing is noted.
        """
        from gsmap.optimize import check_priors

        check_priors([prior.scene], [prior])
        self.store.priors.set(prior)

    def remove_prior(self, scene: str) -> None:
        """Take back what was told of where a scene lies."""
        self.store.priors.remove(scene)

    # --- export ------------------------------------------------------------------------------------------------------

    def export(
        self,
        out: str | os.PathLike[str],
        *,
        format: str = "ply",
        tile_size_m: float = 10.0,
        bbox: Sequence[float] | None = None,
        merge: str = "tto",
        revision: int | None = None,
        component: int | None = None,
        steps: int | None = None,
        budget_s: float | None = None,
        provenance: bool = False,
    ) -> ExportResult:
        """Write merged tiles to a folder; only those that changed since it was last exported to are made.

        Args:
            format: suffix of the tiles' files, or ``3dtiles``.
            tile_size_m: edge of a tile; 0 is one file per component.
            bbox: ``x0 y0 z0 x1 y1 z1`` only this box of the map.
            merge: ``tto``, ``voxel``, ``union`` or ``distance``.
            revision: poses of this revision, the newest by default.
            component: only this island.
            steps: optimisation steps per tile; chosen from its size by default.
            budget_s: ceiling in wall seconds per tile; a tile that it cuts short is marked ``truncated``.
            provenance: add the property ``scene`` to ``.ply`` files.

        Raises:
            ConfigError, InputError, StoreError: see `gsmap.export`; no half-written tile is left.
        """
        from gsmap.map.exporting import Request, export

        request = Request(format, tile_size_m, bbox, merge, revision, component, steps, budget_s, provenance)
        return export(self.store, Path(out), request, lambda f, text: self._progress("export", f, text))

    # --- look --------------------------------------------------------------------------------------------------------

    def scenes(self) -> list[Scene]:
        """The living scenes in the order they came."""
        return self.store.scenes.list()

    def pose_graph(self, revision: int | None = None) -> PoseGraph | None:
        """The poses of a revision, of the newest one by default; None before the first optimize."""
        return self.store.revisions.get(revision)

    def read(self, ref: str, *, frame: str = "scene") -> tuple[Gaussians, Cameras]:
        """Gaussians and cameras of one scene, in its own frame or in the ``map`` frame of its island.

        Raises:
            NotFoundError: no such scene, or no pose for it yet.
            ConfigError: another frame.
        """
        from gsmap.geometry.transforms import transform_cameras, transform_gaussians

        scene = self.store.scenes.get(ref)
        gaussians, cameras = self.store.scenes.gaussians(scene.id), self.store.scenes.cameras(scene.id)
        if frame == "scene":
            return gaussians, cameras
        if frame != "map":
            raise ConfigError(f"a scene is read in frame 'scene' or 'map', got {frame!r}")
        graph = self.pose_graph()
        if graph is None or scene.id not in graph.poses:
            raise NotFoundError(f"scene {scene.name} has no place in the map yet: run gsmap update first")
        S_map_scene = graph.poses[scene.id].S_map_scene
        return transform_gaussians(gaussians, S_map_scene), transform_cameras(cameras, S_map_scene)

    def scene_rows(self) -> list[dict[str, Any]]:
        """``gsmap list MAP scenes``."""
        return rows.scene_rows(self.store)

    def edge_rows(self) -> list[dict[str, Any]]:
        """``gsmap list MAP edges``."""
        return rows.edge_rows(self.store)

    def revision_rows(self) -> list[dict[str, Any]]:
        """``gsmap list MAP revisions``."""
        return rows.revision_rows(self.store)

    def tile_rows(self) -> list[dict[str, Any]]:
        """``gsmap list MAP tiles``."""
        return rows.tile_rows(self.store)

    def model_rows(self) -> list[dict[str, Any]]:
        """``gsmap models list MAP``."""
        return rows.model_rows(self.store)

    def show_scene(self, ref: str) -> dict[str, Any]:
        """``gsmap show MAP SCENE``: facts, nodes and edges of one scene."""
        scene = self.store.scenes.get(ref)
        return rows.scene_facts(self.store, scene, self.store.graphs.load(scene.id, self._method(scene)))

    def show_pair(self, pair: str) -> dict[str, Any]:
        """``gsmap show MAP A:B``: the pair's edge, its evidence, and its history."""
        a, b = self._pair(pair)
        return rows.pair_facts(self.store, a, b)

    def view(self, *, port: int = 0) -> ViewServer:
        """``gsmap view MAP``: a page of splats, graphs, cameras and edges, served on this machine only until closed."""
        from gsmap.map.viewing import view_of
        from gsmap.view import ViewServer

        return ViewServer(view_of(self.store), port=port)

    def draw_graph(self, ref: str, path: str | os.PathLike[str]) -> None:
        """``gsmap show MAP SCENE --picture``: the scene's graph over a render, for a person to judge."""
        from PIL import Image

        from gsmap.describe.picture import draw_graph

        scene = self.store.scenes.get(ref)
        graph = self.store.graphs.load(scene.id, self._method(scene))
        if graph is None:
            raise NotFoundError(f"scene {scene.name} has no graph yet: run gsmap describe first")
        Image.fromarray(draw_graph(*self.read(scene.id), graph)).save(path)

    def diff(self, before: int, after: int) -> list[dict[str, Any]]:
        """``gsmap diff MAP R1 R2``: how far each scene moved between two revisions, measured at its middle."""
        from gsmap.optimize import diff

        old, new = self.pose_graph(before), self.pose_graph(after)
        assert old is not None
        assert new is not None
        known = {s.id: s for s in [*self.store.scenes.list(), *self.store.scenes.list(removed=True)]}
        changes = diff(old, new, {s.id: s.bounds.mean(0) for s in known.values()})
        return [
            {
                "scene": known[c.scene].name,
                "change": c.kind,
                "rotation_deg": c.rotation_deg,
                "translation_m": c.translation_m,
                "scale_ratio": c.scale_ratio,
                "component": list(c.components),
                "status": list(c.statuses),
            }
            for c in changes.values()
        ]

    def evaluate(self, truth: str | os.PathLike[str], images: str | os.PathLike[str] | None = None) -> dict[str, Any]:
        """``gsmap evaluate MAP``: poses against ground truth, renders against the captures' own images."""
        from gsmap.map import evaluating

        report = evaluating.poses(self.store, truth)
        if images is not None:
            report["images"] = evaluating.images(self.store, images, lambda f, t: self._progress("evaluate", f, t))
        return report

    # --- upkeep ------------------------------------------------------------------------------------------------------

    def remove(self, ref: str) -> Scene:
        """Take a scene out; older revisions keep it."""
        return self.store.scenes.remove(ref)

    def check(self) -> list[str]:
        """Read every byte of the map and compare it with what was written; one line per problem."""
        return list(self.store.check(lambda f, text: self._progress("check", f, text)).problems)

    def prune(self, keep_revisions: int | None = None) -> Pruned:
        """Delete leftovers of interrupted work and what none of the newest ``keep_revisions`` (None: all) names."""
        return self.store.prune(keep_revisions=keep_revisions)

    def add_model(self, kind: str, path: str | os.PathLike[str], *, preset: str = "clip", copy: bool = True) -> None:
        """Register an ONNX model: checked, then copied (or referenced) and used by every later describe."""
        from gsmap.map import models as kept

        kept.add(self.store, kind, path, preset, copy)


def _digest(*texts: str) -> str:
    """A short digest of texts, for keys of stored results."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:32]
