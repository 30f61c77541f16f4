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
from gsmap.geometry.uncertainty import largest_sigma, middle_covariance_m2
from gsmap.map import reports
from gsmap.map.changes.compare import plan_comparisons
from gsmap.map.changes.rows import changes_report, filter_by_date, num_open
from gsmap.map.date_filter import is_after, parse_moment
from gsmap.map.metric_scales import map_metres
from gsmap.map.objects.map_objects import load_objects, objects_report
from gsmap.map.objects.static_filter import find_omitted
from gsmap.map.outputs import note_target
from gsmap.map.pictures.comparison_pictures import PairRenderer, picture_of_pair
from gsmap.map.pictures.floor_plans import MAX_GAUSSIANS, MAX_SCENES, SceneArrays, box_of, plan_of_component, read_scene
from gsmap.map.report.edge_entries import edge_entries
from gsmap.map.reports.common import up_directions
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.status import status
from gsmap.report import (
    SECTIONS,
    EdgeEntry,
    Island,
    Params,
    PlanEdge,
    PoseDifferences,
    Report,
    SceneEntry,
    owner_of,
    page,
)
from gsmap.report.words import verdict
from gsmap.store import Store
from gsmap.store.quarantine import CAPTURE
from gsmap.store.registrations import StoredRegistration
from gsmap.store.sizes import scene_sizes, sizes
from gsmap.types import PoseGraph, ScenePose
from gsmap.types.metric_scale import MetricScale
from gsmap.types.progress import StageProgress
from gsmap.types.rows.changes import ChangesReport
from gsmap.types.rows.maps import MapStatus
from gsmap.types.rows.objects import ObjectsReport
from gsmap.types.rows.reports import WrittenReport
from gsmap.types.rows.revisions import RevisionRow
from gsmap.version import __version__

_SUFFIXES = (".html", ".htm")
_PLAN_PX = 1200  # longer side of the picture under a floor plan
_PICTURE_GAUSSIANS = 3_000_000  # of a pair of scenes that is drawn
_PICTURE_PX = 320  # longer side of one view in a picture of a pair or a change
_REVISIONS = 30  # in the history, the newest
_COMPARED_REVISIONS = 8  # of these, each compared with the one before it


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


@dataclass
class _ReportBuilder:
    """Builds one report.

    Args:
        graph: Newest poses; None before the first optimize.
        metres: Metric scale of each component.
        ups: Direction opposite to gravity in the frame of each scene.
        places: Short names for local paths, which a shared page must not show.
        notes: Notes on omitted content.
    """

    store: Store
    settings: Settings
    since: str | None
    progress: StageProgress
    graph: PoseGraph | None = None
    metres: dict[int, MetricScale] = field(default_factory=dict)
    ups: dict[str, np.ndarray] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def report(self, pictures: bool) -> Report:
        self.progress("report", 0.0, "reading the catalog")
        made = _read_catalog(self.store, self)
        with self.store.located():
            reads = self._arrays(made)
        made = replace(
            made,
            scenes=tuple(self._with_sigmas(entry, reads.get(entry.row.id)) for entry in made.scenes),
            edges=tuple(self._with_residual(edge, reads) for edge in made.edges),
        )
        planned, rest = made.islands[: self.params.islands], made.islands[self.params.islands :]
        made = replace(made, islands=(*(self._with_plan(made, island, reads) for island in planned), *rest))
        if pictures:
            made = replace(made, pair_pictures=self._pairs(made), change_pictures=self._changes(made))
        self.progress("report", 1.0, "")
        return replace(made, notes=tuple(self.notes))

    @property
    def params(self) -> Params:
        return self.settings.report

    @property
    def poses(self) -> Mapping[str, ScenePose]:
        return self.graph.poses if self.graph else {}

    # --- arrays ------------------------------------------------------------------------------------------------------

    def _arrays(self, made: Report) -> dict[str, SceneArrays]:
        """Read the points and centre of every placed scene, within the limits of a report."""
        poses = self.poses
        placed = [entry.row for entry in made.scenes if entry.row.id in poses]
        placed.sort(key=lambda scene: poses[scene.id].component)
        budget = MAX_GAUSSIANS
        whole: set[int] = set()
        drawn = [island.component for island in made.islands[: self.params.islands]]
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

    def _with_sigmas(self, entry: SceneEntry, read: SceneArrays | None) -> SceneEntry:
        pose = self.poses.get(entry.row.id)
        if pose is None or read is None or pose.covariance is None:
            return entry
        covariance_m2 = middle_covariance_m2(pose, read.middle, self.metres[pose.component].metres_per_unit)
        return replace(
            entry,
            position_sigma_m=None if covariance_m2 is None else largest_sigma(covariance_m2),
            rotation_sigma_deg=float(np.degrees(largest_sigma(pose.covariance[:3, :3]))),
        )

    def _with_residual(self, edge: EdgeEntry, reads: Mapping[str, SceneArrays]) -> EdgeEntry:
        """Return an edge with its residual under the newest poses."""
        row, a, b = edge.row, self.poses.get(edge.row.target), self.poses.get(edge.row.source)
        if a is None or b is None or a.component != b.component:
            return edge
        edge = replace(edge, component=a.component)
        if row.S_target_source is None or row.status != "accepted":
            return edge
        middle = reads[row.source].middle[None]
        alone = a.S_map_scene @ row.S_target_source
        gap = float(np.linalg.norm(alone.apply(middle) - b.S_map_scene.apply(middle)))
        turn = angle_between(alone.rotation, b.S_map_scene.rotation)
        return replace(
            edge, translation_m=gap * self.metres[a.component].metres_per_unit, rotation_deg=float(np.degrees(turn))
        )

    # --- plans -------------------------------------------------------------------------------------------------------

    def _with_plan(self, made: Report, island: Island, reads: Mapping[str, SceneArrays]) -> Island:
        """Return a component with its floor plan."""
        self.progress("report", 0.6, f"plan of component {island.component}")
        scenes = [entry.row for entry in made.scenes if entry.row.component == island.component]
        poses = [self.poses[scene.id] for scene in scenes]
        place = {scene.id: i for i, scene in enumerate(scenes)}
        lines = [
            PlanEdge(place[edge.row.target], place[edge.row.source], edge.kind, _tip(edge))
            for edge in made.edges
            if edge.row.target in place and edge.row.source in place and edge.use not in ("rejected", "no_match")
        ]
        ups = [pose.S_map_scene.rotation @ self.ups[pose.scene] for pose in poses if pose.scene in self.ups]
        metre, up = island.metre.metres_per_unit, median_direction(np.array(ups))
        found = [reads[scene.id] for scene in scenes]
        plan, note = plan_of_component(island.scenes, poses, found, lines, up, metre, _PLAN_PX)
        return replace(island, plan=plan, note=note)

    # --- pictures ----------------------------------------------------------------------------------------------------

    def _pairs(self, made: Report) -> dict[tuple[str, str], np.ndarray]:
        """Draw pictures of the most doubtful pairs."""
        sizes_ = {entry.row.id: entry.row.num_gaussians for entry in made.scenes}
        doubtful = [edge for edge in made.edges if edge.use in ("undecided", "tentative")]
        doubtful.sort(key=lambda edge: (-edge.doubt, edge.row.pair))
        out = {}
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
                out[ends] = picture
        return out

    def _changes(self, made: Report) -> dict[str, np.ndarray]:
        """Draw pictures of the changes with the highest confidence."""
        sizes_ = {entry.row.id: entry.row.num_gaussians for entry in made.scenes}
        found = [
            row
            for row in (made.changes.changes if made.changes else ())
            if row.box_m is not None and row.status != "rejected" and {row.older, row.newer} <= set(sizes_)
            and sizes_[row.older] + sizes_[row.newer] <= _PICTURE_GAUSSIANS
        ]  # fmt: skip
        found.sort(key=lambda row: -row.confidence)
        found = found[: self.params.change_pictures]
        out = {}
        for pair in dict.fromkeys((row.older, row.newer) for row in found):
            try:
                drawer = PairRenderer(self.store, *pair)
                for row in found:
                    if (row.older, row.newer) == pair:
                        self.progress("report", 0.9, row.id)
                        out[row.id] = drawer.picture(row, side_px=_PICTURE_PX)
            except (CorruptError, NotFoundError) as error:
                self.notes.append(f"changes of {pair[0][:12]} are not drawn: {self._hidden(str(error))}")
        return out

    def _hidden(self, text: str) -> str:
        return _without_places(text, self.places)


# --- the catalog -----------------------------------------------------------------------------------------------------


@snapshot_read
def _read_catalog(store: Store, builder: _ReportBuilder) -> Report:
    """Read the parts of the report that need no arrays, and what the builder needs of the catalog for the rest."""
    since, settings = builder.since, builder.settings
    when = None if since is None else parse_moment(since)
    builder.graph = graph = store.revisions.get()
    builder.ups = up_directions(store.graphs.list(), store.scenes.list())
    builder.metres, builder.places = map_metres(store, graph), _places(store)
    revisions, num_bytes = reports.revision_rows(store), scene_sizes(store)
    rows, edges = reports.scene_rows(store, metres=builder.metres), edge_entries(store, graph)
    names: dict[int, list[str]] = {}
    for row in rows:
        if row.component is not None:
            names.setdefault(row.component, []).append(row.name)
    return Report(
        title=Path(store.location).name,
        map_id=store.id,
        made_at=datetime.now(UTC).isoformat(timespec="seconds"),
        version=__version__,
        status=_hide_places(status(store, settings, num_open, find_omitted), builder.places),
        scenes=tuple(SceneEntry(row, num_bytes.get(row.id, 0)) for row in rows),
        edges=tuple(entry for entry, _ in edges),
        islands=tuple(Island(one, tuple(names[one]), builder.metres[one]) for one in sorted(names)),
        revisions=tuple(revisions[-_REVISIONS:]),
        num_revisions=len(revisions),
        moved=tuple(_moved(store, revisions)),
        since=since,
        moved_since=None if when is None else _moved_since(store, revisions, when),
        new_scenes=() if when is None else tuple(row.name for row in rows if is_after(row.ingested_at, when)),
        new_edges=() if when is None else tuple(e.row for e, _ in edges if is_after(e.row.registered_at, when)),
        changes=None if graph is None else _known_changes(store, settings, since),
        objects=None if graph is None else _load_objects(store, settings),
        storage=sizes(store),
        seconds=_seconds(stored for _, stored in edges),
        params=settings.report,
    )


def _known_changes(store: Store, settings: Settings, since: str | None) -> ChangesReport:
    """Return the stored changes, without comparing scenes."""
    asked = filter_by_date(plan_comparisons(store, settings), since, None, None)
    return changes_report(store, settings, asked, min_confidence=settings.change.min_confidence)


def _load_objects(store: Store, settings: Settings) -> ObjectsReport | None:
    """Return the stored objects; None if they are out of date."""
    try:
        return objects_report(load_objects(store, settings))
    except NotFoundError:
        return None


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


def _tip(edge: EdgeEntry) -> str:
    chi2 = "" if edge.chi2 is None else f", chi2 {edge.chi2:.3g}"
    off = "" if edge.translation_m is None else f", off by {edge.translation_m:.3g} m"
    return f"{edge.row.pair}: {edge.kind}{chi2}{off}"


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
