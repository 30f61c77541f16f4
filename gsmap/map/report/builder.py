"""Collect the data of a map's report; `gsmap.report` draws it.

Catalog rows are those of one moment. Of arrays a bounded number is read (`gsmap.report.Params`); what is damaged is
left out and named, so that the page an operator opens each morning comes out whatever the night did.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from gsmap.durable import is_stream, write_text_output
from gsmap.errors import ConfigError, CorruptError, NotFoundError
from gsmap.geometry.directions import median_direction
from gsmap.geometry.rotations import angle_between
from gsmap.geometry.uncertainty import middle_covariance_m2
from gsmap.map import reports
from gsmap.map.changes.compare import plan_comparisons
from gsmap.map.changes.rows import changes_report, filter_by_date
from gsmap.map.date_filter import is_after, parse_moment
from gsmap.map.metric_scales import map_metres
from gsmap.map.objects.map_objects import load_objects, objects_report
from gsmap.map.pictures.comparison_pictures import PairRenderer, note_target, picture_of_pair
from gsmap.map.pictures.floor_plans import MAX_GAUSSIANS, MAX_SCENES, SceneArrays, box_of, plan_of_component, read_scene
from gsmap.map.report.edge_entries import edge_entries
from gsmap.map.reports.common import up_directions
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.status import status
from gsmap.report import (
    SECTIONS,
    Additions,
    ChangePicture,
    EdgeEntry,
    Island,
    PairPicture,
    Params,
    PlanEdge,
    PoseDifferences,
    Report,
    SceneEntry,
    StorageEntry,
    owner_of,
    page,
)
from gsmap.report.words import verdict
from gsmap.store import Store
from gsmap.store.quarantine import CAPTURE
from gsmap.store.registrations import StoredRegistration
from gsmap.store.sizes import scene_sizes, sizes
from gsmap.types import PoseGraph, Scene, ScenePose
from gsmap.types.metric_scale import MetricScale
from gsmap.types.progress import StageProgress
from gsmap.types.rows.changes import ChangesReport
from gsmap.types.rows.maps import MapStatus
from gsmap.types.rows.objects import ObjectsReport
from gsmap.types.rows.pairs import EdgeRow
from gsmap.types.rows.reports import WrittenReport
from gsmap.types.rows.revisions import RevisionRow
from gsmap.version import __version__

_SUFFIXES = (".html", ".htm")
_PLAN_PX = 1200  # longer side of the picture under a floor plan
_PICTURE_GAUSSIANS = 3_000_000  # of a pair of scenes that is drawn
_PICTURE_PX = 320  # longer side of one view in a picture of a pair or a change
_REVISIONS = 30  # in the history, the newest
_COMPARED_REVISIONS = 8  # of these, each compared with the one before it
_KINDS = {
    "scenes": "captures",
    "graphs": "scene graphs",
    "changes": "changes",
    "indexes": "retrieval index",
    "models": "networks",
    "catalog": "catalog",
}


def write_report(
    store: Store, settings: Settings, path: Path, since: str | None, pictures: bool, progress: StageProgress
) -> WrittenReport:
    """Write a map's report to a file; after an error, no partial file remains.

    Args:
        since: report only what is new since this date, ISO 8601; None for everything.
        pictures: draw doubtful pairs and changes.

    Raises:
        ConfigError: a file that is no ``.html``, or is there and is no report; or no date.
        NotFoundError: no such folder.
    """
    check_target(path)
    report = _ReportBuilder(store, settings, since, progress).report(pictures)
    text = page(report)
    if not is_stream(path) and (refused := note_target(store, path, {"report": True})) is not None:
        report = replace(report, notes=(*report.notes, f"{refused}: a purge of a scene will not find this page"))
        text = page(report)
    write_text_output(path, text, store.id)
    standing, sentences = verdict(report)
    return WrittenReport(
        path=str(path),
        num_bytes=len(text.encode()),
        standing=standing,
        verdict=" ".join(sentences),
        sections=tuple(name for name in SECTIONS if f'<section id="{name}">' in text),
        num_pictures=len(report.pair_pictures) + len(report.change_pictures),
        notes=report.notes,
    )


def check_target(path: Path) -> None:
    """Raise an error for a path to which no report may be written; see `write_report` for the errors."""
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(
            f"a report is an HTML page: name a file that ends with .html instead of {path.name or path}",
            code="wrong_suffix",
        )
    if path.is_dir():
        raise ConfigError(
            f"{path} is a folder: name a file in it, such as {path / 'report.html'}", code="target_is_a_folder"
        )
    if not path.parent.is_dir():
        raise NotFoundError(f"cannot write {path}: {path.parent} does not exist", code="folder_not_found")
    if path.exists() and not is_stream(path) and owner_of(path) is None:
        raise ConfigError(
            f"{path} exists and was not written by gsmap report: choose another name, or delete it",
            code="foreign_export",
        )


def _load_objects(store: Store, settings: Settings) -> ObjectsReport | None:
    """Return the stored objects; None if they are out of date."""
    try:
        return objects_report(load_objects(store, settings))
    except NotFoundError:
        return None


@dataclass(frozen=True, eq=False)
class _CatalogState:
    """The catalog of a map as of one transaction."""

    status: MapStatus
    scenes: list[Scene]
    graph: PoseGraph | None
    metres: dict[int, MetricScale]
    ups: dict[str, np.ndarray]
    edges: list[EdgeEntry]
    changes: ChangesReport | None
    report: Report


@dataclass
class _ReportBuilder:
    """Builds one report."""

    store: Store
    settings: Settings
    since: str | None
    progress: StageProgress
    notes: list[str] = field(default_factory=list)

    def report(self, pictures: bool) -> Report:
        self.progress("report", 0.0, "reading the catalog")
        state = _state(self.store, self.settings, self.since)
        with self.store.located():
            reads = self._arrays(state)
        edges = _edges(state, reads)
        islands = self._islands(state, reads, edges)
        made = replace(
            state.report,
            scenes=tuple(self._scene_entries(state, reads)),
            edges=tuple(edges),
            islands=tuple(islands),
        )
        if pictures:
            made = replace(made, pair_pictures=self._pairs(made), change_pictures=self._changes(state))
        self.progress("report", 1.0, "")
        return replace(made, notes=tuple(self.notes))

    @property
    def params(self) -> Params:
        return self.settings.report

    # --- arrays ------------------------------------------------------------------------------------------------------

    def _arrays(self, state: _CatalogState) -> dict[str, SceneArrays]:
        """Read the points and centre of every placed scene, within the limits of a report."""
        poses = state.graph.poses if state.graph else {}
        placed = [scene for scene in state.scenes if scene.id in poses]
        placed.sort(key=lambda scene: poses[scene.id].component)
        budget = MAX_GAUSSIANS
        whole: set[int] = set()
        drawn = sorted({poses[scene.id].component for scene in placed})[: self.params.islands]
        for component in drawn:
            need = sum(scene.num_gaussians for scene in placed if poses[scene.id].component == component)
            if need <= budget:
                whole.add(component)
                budget -= need
        found = {}
        for i, scene in enumerate(placed):
            self.progress("report", 0.6 * i / len(placed), scene.name)
            component = poses[scene.id].component
            is_read = i < MAX_SCENES and component in drawn
            try:
                found[scene.id] = read_scene(self.store, scene, whole=component in whole) if is_read else box_of(scene)
            except (CorruptError, NotFoundError) as error:
                self.notes.append(f"scene {scene.name} is drawn as a box: {self._hidden(str(error))}")
                found[scene.id] = box_of(scene)
        return found

    def _scene_entries(self, state: _CatalogState, reads: Mapping[str, SceneArrays]) -> Iterable[SceneEntry]:
        poses = state.graph.poses if state.graph else {}
        for entry in state.report.scenes:
            pose, read = poses.get(entry.row.id), reads.get(entry.row.id)
            if pose is None or read is None:
                yield entry
                continue
            metre = state.metres.get(pose.component, MetricScale()).metres_per_unit
            yield replace(
                entry,
                middle=pose.S_map_scene.apply(read.middle[None])[0],
                covariance_m2=middle_covariance_m2(pose, read.middle, metre),
                rotation_sigma_deg=_rotation_sigma_deg(pose),
            )

    # --- plans -------------------------------------------------------------------------------------------------------

    def _islands(
        self, state: _CatalogState, reads: Mapping[str, SceneArrays], edges: Sequence[EdgeEntry]
    ) -> list[Island]:
        members: dict[int, list[Scene]] = {}
        poses = state.graph.poses if state.graph else {}
        for scene in state.scenes:
            if scene.id in poses:
                members.setdefault(poses[scene.id].component, []).append(scene)
        islands = []
        for place, component in enumerate(sorted(members)):
            scenes, metre = members[component], state.metres.get(component, MetricScale())
            island = Island(component, tuple(scene.name for scene in scenes), metre)
            if place < self.params.islands:
                self.progress("report", 0.6, f"plan of component {component}")
                island = self._plan(state, island, scenes, reads, edges)
            islands.append(island)
        return islands

    def _plan(
        self, state: _CatalogState, island: Island, scenes: Sequence[Scene], reads: Mapping[str, SceneArrays],
        edges: Sequence[EdgeEntry],
    ) -> Island:  # fmt: skip
        assert state.graph is not None
        poses = [state.graph.poses[scene.id] for scene in scenes]
        found = [reads[scene.id] for scene in scenes]
        place = {scene.id: i for i, scene in enumerate(scenes)}
        lines = [
            PlanEdge(place[edge.row.target], place[edge.row.source], edge.kind, _tip(edge))
            for edge in edges
            if edge.row.target in place and edge.row.source in place and edge.use not in ("rejected", "no_match")
        ]
        ups = [pose.S_map_scene.rotation @ state.ups[pose.scene] for pose in poses if pose.scene in state.ups]
        metre, up = island.metre.metres_per_unit, median_direction(np.array(ups))
        plan, note = plan_of_component(island.scenes, poses, found, lines, up, metre, _PLAN_PX)
        return replace(island, plan=plan, note=note)

    # --- pictures ----------------------------------------------------------------------------------------------------

    def _pairs(self, made: Report) -> tuple[PairPicture, ...]:
        """Draw pictures of the most doubtful pairs."""
        sizes_ = {entry.row.id: entry.row.num_gaussians for entry in made.scenes}
        doubtful = [edge for edge in made.edges if edge.use in ("undecided", "tentative")]
        doubtful.sort(key=lambda edge: (-edge.doubt, edge.row.pair))
        out: list[PairPicture] = []
        left = self.params.pair_pictures
        for edge in doubtful:
            if left == 0:
                break
            ends = (edge.row.target, edge.row.source)
            if sum(sizes_.get(scene, 0) for scene in ends) > _PICTURE_GAUSSIANS:
                continue
            left -= 1
            self.progress("report", 0.7, edge.row.pair)
            try:
                picture = picture_of_pair(self.store, *ends, side_px=_PICTURE_PX)
            except (CorruptError, NotFoundError) as error:
                self.notes.append(f"{edge.row.pair} is not drawn: {self._hidden(str(error))}")
                continue
            if picture is not None:
                out.append(PairPicture(edge.row, picture))
        return tuple(out)

    def _changes(self, state: _CatalogState) -> tuple[ChangePicture, ...]:
        """Draw pictures of the changes with the highest confidence."""
        found = [] if state.changes is None else [row for row in state.changes.changes if row.box_m is not None]
        sizes_ = {scene.id: scene.num_gaussians for scene in state.scenes}
        found = [
            row
            for row in found
            if row.status != "rejected" and {row.older, row.newer} <= set(sizes_)
            and sizes_[row.older] + sizes_[row.newer] <= _PICTURE_GAUSSIANS
        ]  # fmt: skip
        found.sort(key=lambda row: -row.confidence)
        found = found[: self.params.change_pictures]
        out = []
        for pair in dict.fromkeys((row.older, row.newer) for row in found):
            try:
                drawer = PairRenderer(self.store, *pair)
                for row in found:
                    if (row.older, row.newer) == pair:
                        self.progress("report", 0.9, row.id)
                        picture = drawer.picture(row, side_px=_PICTURE_PX)
                        out.append(ChangePicture(row.id, picture))
            except (CorruptError, NotFoundError) as error:
                self.notes.append(f"changes of {pair[0][:12]} are not drawn: {self._hidden(str(error))}")
        return tuple(out)

    def _hidden(self, text: str) -> str:
        return _without_places(text, _places(self.store))


# --- the catalog -----------------------------------------------------------------------------------------------------


@snapshot_read
def _state(store: Store, settings: Settings, since: str | None) -> _CatalogState:
    """Read the catalog and the parts of the report that need no arrays."""
    when = None if since is None else parse_moment(since)
    scenes, graph = store.scenes.list(), store.revisions.get()
    metres = map_metres(store, graph)
    edges = edge_entries(store, graph)
    revisions = reports.revision_rows(store)
    num_bytes = scene_sizes(store)
    found = status(store, settings)
    places = _places(store)
    changes = None if graph is None else _known_changes(store, settings, since)
    shown = Report(
        title=Path(store.location).name,
        map_id=store.id,
        made_at=datetime.now(UTC).isoformat(timespec="seconds"),
        version=__version__,
        status=_hide_places(found, places),
        scenes=tuple(SceneEntry(row, num_bytes.get(row.id, 0)) for row in reports.scene_rows(store, metres=metres)),
        revisions=tuple(revisions[-_REVISIONS:]),
        num_revisions=len(revisions),
        moved=tuple(_moved(store, revisions)),
        moved_since=None if when is None else _moved_since(store, revisions, when),
        changes=changes,
        objects=None if graph is None else _load_objects(store, settings),
        storage=tuple(StorageEntry(_KINDS.get(one.kind, one.kind), one.count, one.num_bytes) for one in sizes(store)),
        seconds=_seconds(stored for _, stored in edges),
        news=None if when is None or since is None else _news(since, when, scenes, [entry.row for entry, _ in edges]),
        params=settings.report,
    )
    ups = up_directions(store.graphs.list(), scenes)
    return _CatalogState(found, scenes, graph, metres, ups, [entry for entry, _ in edges], changes, shown)


def _known_changes(store: Store, settings: Settings, since: str | None) -> ChangesReport:
    """Return the stored changes, without comparing scenes."""
    asked = filter_by_date(plan_comparisons(store, settings), since, None, None)
    return changes_report(store, settings, asked, min_confidence=settings.change.min_confidence)


def _news(since: str, when: datetime, scenes: Sequence[Scene], edges: Sequence[EdgeRow]) -> Additions:
    tried = [edge for edge in edges if is_after(edge.registered_at, when)]
    return Additions(
        since=since,
        scenes=tuple(scene.name for scene in scenes if is_after(scene.ingested_at, when)),
        num_tried=len(tried),
        num_accepted=sum(edge.status == "accepted" for edge in tried),
    )


def _moved(store: Store, revisions: Sequence[RevisionRow]) -> Iterable[PoseDifferences]:
    """Return the pose changes between the newest stored revisions, newest first."""
    kept = [row.number for row in revisions if row.dropped_at is None]
    for after, before in list(zip(reversed(kept), reversed(kept[:-1]), strict=False))[:_COMPARED_REVISIONS]:
        yield PoseDifferences(before, after, tuple(reports.pose_change_rows(store, before, after)))


def _moved_since(store: Store, revisions: Sequence[RevisionRow], when: datetime) -> PoseDifferences | None:
    kept = [row for row in revisions if row.dropped_at is None]
    before = [row.number for row in kept if not is_after(row.created_at, when)]
    if not before or before[-1] == kept[-1].number:
        return None
    rows = reports.pose_change_rows(store, before[-1], kept[-1].number)
    return PoseDifferences(before[-1], kept[-1].number, tuple(rows))


def _seconds(stored: Iterable[StoredRegistration]) -> dict[str, float]:
    """Return the wall time per step, summed over all current edges."""
    total: dict[str, float] = {}
    for one in stored:
        for step, value in one.registration.seconds.items():
            total[step] = total.get(step, 0.0) + float(value)
    return dict(sorted(total.items(), key=lambda item: -item[1]))


def _edges(state: _CatalogState, reads: Mapping[str, SceneArrays]) -> list[EdgeEntry]:
    """Return every edge with its residual under the newest poses."""
    poses = state.graph.poses if state.graph else {}
    out = []
    for entry in state.edges:
        row = entry.row
        a, b = poses.get(row.target), poses.get(row.source)
        if a is not None and b is not None and a.component == b.component:
            entry = replace(entry, component=a.component)
            if row.S_target_source is not None and row.status == "accepted":
                middle = reads[row.source].middle[None]
                alone = a.S_map_scene @ row.S_target_source
                gap = float(np.linalg.norm(alone.apply(middle) - b.S_map_scene.apply(middle)))
                turn = angle_between(alone.rotation, b.S_map_scene.rotation)
                metre = state.metres.get(a.component, MetricScale()).metres_per_unit
                entry = replace(entry, translation_m=gap * metre, rotation_deg=float(np.degrees(turn)))
        out.append(entry)
    return out


def _tip(edge: EdgeEntry) -> str:
    chi2 = "" if edge.chi2 is None else f", chi2 {edge.chi2:.3g}"
    off = "" if edge.translation_m is None else f", off by {edge.translation_m:.3g} m"
    return f"{edge.row.pair}: {edge.kind}{chi2}{off}"


def _rotation_sigma_deg(pose: ScenePose) -> float | None:
    if pose.covariance is None:
        return None
    return float(np.degrees(np.sqrt(max(0.0, float(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])))))


# --- places of files -------------------------------------------------------------------------------------------------


def _places(store: Store) -> dict[str, str]:
    """Return short names for local paths, which a shared page must not show."""
    targets = [*store.exports.targets(), str(store.folder), str(store.home), store.location]
    for one in store.quarantine.list():
        if one.what.startswith(f"{CAPTURE} "):  # and its cameras, which may lie above it
            targets += [str(folder) for folder in [Path(one.about), *Path(one.about).parents][:4] if folder.name]
    return {target: Path(target).name for target in targets if "/" in target}


def _without_places(text: str, places: Mapping[str, str]) -> str:
    for place in sorted(places, key=len, reverse=True):
        text = text.replace(shlex.quote(place), shlex.quote(places[place])).replace(place, places[place])
    return text


def _hide_places(found: MapStatus, places: Mapping[str, str]) -> MapStatus:
    todo = tuple(
        replace(row, verb=_without_places(row.verb, places), meaning=_without_places(row.meaning, places))
        for row in found.todo
    )
    at_work = tuple(
        replace(row, what=_without_places(row.what, places), task=_without_places(row.task, places))
        for row in found.at_work
    )
    return replace(found, todo=todo, at_work=at_work)
