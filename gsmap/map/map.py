"""`Map`, the facade of gsmap, with each verb of the command line as a method."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from gsmap.engine import WorkerSession
from gsmap.errors import ConfigError, NotFoundError, SchemaVersionError, StoreError
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import reports
from gsmap.map.metric_scales import metres_at
from gsmap.map.progress_logging import log_progress
from gsmap.map.shared_jobs import announce_work, explain_purges
from gsmap.store import Store
from gsmap.texts import counted
from gsmap.types import Cameras, Change, Gaussians, PoseGraph, Prior, Scene, SceneGraph, ScenePose, Sim3
from gsmap.types.metric_scale import MetricScale
from gsmap.types.progress import StageProgress
from gsmap.types.rows.base import Table
from gsmap.types.scene import SceneEdits

if TYPE_CHECKING:
    from PIL.Image import Image

    from gsmap.map.localization.photo_poses import LocalizePhotos
    from gsmap.map.objects.map_objects import MapObjects
    from gsmap.map.settings import Settings
    from gsmap.map.stages.register import Pairs
    from gsmap.map.world.georeference import Request
    from gsmap.types.rows.backups import BackupReport, CloneReport, RestoreReport, SnapshotRow
    from gsmap.types.rows.changes import ChangeDetail, ChangeRow, ChangesReport
    from gsmap.types.rows.evaluation import EvaluationReport
    from gsmap.types.rows.exports import ExportReport, SmallMapReport, TileRow
    from gsmap.types.rows.find import FindReport
    from gsmap.types.rows.localize import LocalizeReport, PhotoRow
    from gsmap.types.rows.localize_scan import ScanRow
    from gsmap.types.rows.map_operations import BranchRow, MergeReport, PurgeReport, SplitReport
    from gsmap.types.rows.maps import CheckReport, MapStatus, ModelRow, PruneReport, SettingRow, ViewReport
    from gsmap.types.rows.objects import HistoryReport, ObjectRow, ObjectsReport
    from gsmap.types.rows.pairs import EdgeRow, PairExplanation, PairReport
    from gsmap.types.rows.reports import WrittenReport
    from gsmap.types.rows.revisions import PoseChangeRow, RevisionRow, UpdateReport
    from gsmap.types.rows.scenes import GraphRow, IngestRow, PoseRow, PriorRow, SceneReport, SceneRow
    from gsmap.types.rows.thinning import ThinReport
    from gsmap.types.rows.world import MeasureReport, WorldReport
    from gsmap.view import ViewServer


def create(
    path: str | os.PathLike[str], progress: StageProgress | None = None, *, catalog_url: str | None = None
) -> Map:
    """Make an empty map and open it.

    Args:
        catalog_url: SQLAlchemy URL of an empty PostgreSQL database to keep the catalog in, for many writers.
    """
    return Map(Store.create(path, catalog_url=catalog_url), progress)


def open(path: str | os.PathLike[str], progress: StageProgress | None = None) -> Map:
    """Open a map, or a branch or tag (``MAP@NAME``); read-only if its folder cannot be written, or if an older release
    wrote it (see `migrate`).
    """
    if not Store.can_write(path):
        return Map(Store.open(path, "r"), progress)
    try:
        return Map(Store.open(path, "w"), progress)
    except SchemaVersionError as error:
        if error.code != "map_too_old":
            raise
        return Map(Store.open(path, "r"), progress)


def open_or_create(path: str | os.PathLike[str], progress: StageProgress | None = None) -> Map:
    """Open a map, or create it if it is missing."""
    if not Store.exists(path):
        try:
            return create(path, progress)
        except StoreError as error:
            if error.code != "already_exists" or not Store.exists(path):
                raise  # otherwise another process has just created it
    return open(path, progress)


def migrate(path: str | os.PathLike[str]) -> tuple[str | None, str | None]:
    """Migrate an older map to this version's schema; return the schema before and after."""
    return Store.migrate(path)


def restore(
    target: str | os.PathLike[str],
    path: str | os.PathLike[str],
    at: str | None = None,
    progress: StageProgress | None = None,
    *,
    catalog_url: str | None = None,
) -> RestoreReport:
    """Restore a map from a backup (``gsmap restore DEST MAP``) with its id; after an error, no partial map remains.

    Args:
        target: the backup: a folder, ``file:///folder`` or ``s3://bucket/prefix``.
        path: a folder that does not exist.
        at: time, for the last snapshot at or before it, or the beginning of a snapshot's name; default: newest.
        catalog_url: SQLAlchemy URL of an empty PostgreSQL database to keep the catalog in.
    """
    from gsmap.map import backups

    told = log_progress(progress)
    return backups.restore(
        target, path, at=at, catalog_url=catalog_url, progress=lambda f, text: told("restore", f, text)
    )


def snapshots(target: str | os.PathLike[str]) -> Table[SnapshotRow]:
    """List the sound snapshots of a backup (``gsmap backup MAP DEST --list``), oldest first; log damaged ones."""
    from gsmap.map import backups

    rows, problems = backups.snapshots(target)
    for problem in problems:
        logging.getLogger("gsmap.map").warning("%s", problem)
    return Table(rows)


def accept_catalog(path: str | os.PathLike[str]) -> list[str]:
    """Accept the catalog of a map that another program changed; return the differences.

    For salvage, or after a change by another program: from then on these bytes count as written, right or wrong.

    Raises:
        CorruptError: SQLite finds it broken: only a backup helps.
    """
    return Store.accept_catalog(path)


class Map(AbstractContextManager["Map"]):
    """An open map. Every method is a verb of the command line and returns types or rows (`gsmap.types.rows`)."""

    def __init__(self, store: Store, progress: StageProgress | None = None) -> None:
        self.store = store
        self._progress = log_progress(progress)
        self._run: tuple[str | None, dict[str, Any]] = (None, {})
        self._workers = WorkerSession()

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        try:
            names = [scene.name for scene in self.scenes()]
        except StoreError as error:
            return f"Map({self.store.location!r}, {error})"
        shown = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
        return f"Map({self.store.location!r}, {len(names)} scenes{': ' if names else ''}{shown})"

    def __bool__(self) -> bool:
        return True  # an empty map is one, too

    def __len__(self) -> int:
        """Return the number of living scenes."""
        return len(self.scenes())

    def __iter__(self) -> Iterator[Scene]:
        """Iterate over the living scenes in the order of their ingest."""
        return iter(self.scenes())

    def __contains__(self, ref: object) -> bool:
        """Return whether a living scene has this name or id, or is this `Scene`."""
        wanted = ref.id if isinstance(ref, Scene) else ref
        return any(wanted in (scene.name, scene.id) for scene in self.scenes())

    def __getitem__(self, ref: str) -> Scene:
        """Return a living scene by name, id or the beginning of its id.

        Raises:
            NotFoundError: no such scene; a `LookupError`.
        """
        return self.store.scenes.get(ref)

    def close(self) -> None:
        """Close the map. From then on, methods that read or write it raise `StoreError`; `settings` can be read."""
        self._workers.close()  # first: they have the map open
        self.store.close()

    # --- settings ----------------------------------------------------------------------------------------------------

    @cached_property
    def settings(self) -> Settings:
        """The settings in force: defaults, changed by the map's preset, its settings, and settings of this run
        (`with_settings`).
        """
        from gsmap.map.settings import map_settings

        return map_settings(self.store.folder, *self._run)

    def _settings_to_look_by(self) -> Settings:
        """Return the settings in force, or the defaults if they are invalid, for reports."""
        from gsmap.map.settings import Settings

        try:
            return self.settings
        except ConfigError:
            return Settings()

    def with_settings(self, values: Mapping[str, Any] | None = None, preset: str | None = None) -> Map:
        """Change settings while this map is open, without writing ``settings.toml``; return the map.

        Args:
            values: by dotted name, such as ``{"register.verdict.max_log_nfa": -6}``.
            preset: replaces the map's preset and settings.

        Raises:
            ConfigError: no such preset or setting (the nearest is named), or a value that does not fit.
        """
        before, self._run = self._run, (preset or self._run[0], {**self._run[1], **(values or {})})
        self.__dict__.pop("settings", None)
        try:
            self.settings  # noqa: B018  # refuse here what makes no sense
        except ConfigError:
            self._run = before
            raise
        return self

    def change_settings(
        self, values: Mapping[str, Any] | None = None, *, preset: str | None = None, unset: Sequence[str] = ()
    ) -> None:
        """Change the settings stored with the map (``gsmap settings MAP --set``), all or none."""
        from gsmap.map.settings import write_settings

        with self.store.catalog.lock():
            write_settings(self.store.folder, values or {}, preset=preset, drop=tuple(unset))
            self.store.upload_settings()
        self.__dict__.pop("settings", None)

    def setting_rows(self) -> Table[SettingRow]:
        """List every setting with value, default, unit and meaning (``gsmap settings MAP``)."""
        return Table(reports.setting_rows(self.settings))

    # --- ingest, describe, register, optimize ------------------------------------------------------------------------

    def ingest(
        self,
        *captures: str | os.PathLike[str] | Gaussians,
        cameras: str | os.PathLike[str] | Cameras | None = None,
        name: str | None = None,
        captured_at: str | None = None,
        scale: str = "auto",
        clean: bool = False,
        bbox: Sequence[float] | None = None,
        supersedes: str | None = None,
    ) -> Table[IngestRow]:
        """Add captures from files and folders, or one capture from memory; validate each capture before writing it.

        Of several, those that cannot be read are set aside: they are named in the logs (``gsmap.map``), by `status` and
        in ``store.quarantine.encountered``, and tried again whenever they are given. Other files are skipped with a
        warning.

        Args:
            captures: files and folders; or `Gaussians`, with `Cameras` or none.
            cameras, name: cameras and name of a single capture.
            captured_at: capture date of all captures, ISO 8601; UTC if it has no zone. Default: a sidecar, the EXIF of
                the frames, or the name (`gsmap.ingest.find_date`).
            scale: ``known`` (metres), ``unknown`` (any unit) or ``auto`` (estimated by registration).
            clean: remove invalid Gaussians, floaters and background (`gsmap.ingest.clean`); notes say how many of each.
                Superseding the scene by the same file without it undoes this, and the other way round.
            bbox: with ``clean``, remove everything outside this box, too: x0 y0 z0 x1 y1 z1 in coordinates of the file.
            supersedes: scene to replace by a retrained capture of the same frames in the same coordinates. The capture
                takes over its pose, annotations and edges, which are verified but not searched again.

        Raises:
            NotFoundError, InputError, ConfigError: see `gsmap.ingest`; where nothing could be a capture, or the one
                file that is named cannot be read.
            InputError: a capture that does not lie where the scene that it supersedes lies; nothing is changed.
        """
        from gsmap.map.stages.ingest import ingest, readers
        from gsmap.map.stages.supersede import supersede

        options: dict[str, Any] = {
            "cameras": cameras,
            "name": name,
            "captured_at": captured_at,
            "scale": scale,
            "clean": clean,
            "bbox": bbox,
        }
        if supersedes is not None:
            found, _ = readers(captures, **options)
            if len(found) != 1:
                raise ConfigError(
                    f"--supersedes needs one capture, but {len(found)} captures were found: name one of them",
                    code="many_captures",
                )
            with announce_work(self.store, "ingest"):
                capture = found[0].read()
                done = supersede(self.store, capture, supersedes, self.settings, self._progress, named=name is not None)
            return Table([reports.ingest_row(done.scene, new=True, dated=False, notes=(*capture.notes, *done.notes))])

        added = ingest(self.store, captures, progress=self._progress, **options)
        return Table(reports.ingest_row(one.scene, new=one.new, dated=one.dated, notes=one.notes) for one in added)

    def describe(self, *scenes: str) -> Table[GraphRow]:
        """Compute the scene graphs that are missing for the current recipe.

        Args:
            scenes: restrict to these scenes, and repeat damaged graphs.
        """
        from gsmap.map.stages.describe import describe, unthinned

        described = [self.store.scenes.get(ref) for ref in scenes] or unthinned(self.scenes())
        with announce_work(self.store, "describe"):
            keys = describe(self.store, described, self.settings, self._progress, verify=bool(scenes))
        return Table(reports.graph_row(self.store, scene, keys[scene.id]) for scene in described if scene.id in keys)

    def register(self, pairs: Pairs = "auto") -> Table[EdgeRow]:
        """Register pairs of described scenes.

        Args:
            pairs: ``auto`` (candidates not registered by this recipe), ``all``, one pair ``A:B``, a `Path` of a file
                with one pair per line, or pairs of scenes; named pairs are registered again.
        """
        from gsmap.map.stages.register import register

        with announce_work(self.store, "register"):
            made = register(self.store, pairs, self.settings, self._progress)
        return Table(reports.rows_of_edges(self.store, made))

    def add_edge(self, pair: str, S_target_source: Sim3, sigmas: np.ndarray, note: str = "") -> EdgeRow:
        """Add a measured pose of scene B in scene A of ``A:B`` as an edge.

        Args:
            sigmas: (7,) standard deviations [rot_rad (3), trans (3), log_scale], on the source side and in its unit.
        """
        from gsmap.map.stages.register import add_edge

        a, b = self._pair(pair)
        add_edge(self.store, a, b, S_target_source, sigmas, note)
        return reports.edge_row(self.store, a, b)

    def confirm(self, what: str, note: str = "", *, withdraw: bool = False) -> EdgeRow | ChangeRow:
        """Confirm the edge of a pair ``A:B``, which is then always used, or a change (``c12``).

        Args:
            withdraw: withdraw the last review.
        """
        return self._review(what, "withdraw" if withdraw else "confirm", note)

    def reject(self, what: str, note: str = "", *, withdraw: bool = False) -> EdgeRow | ChangeRow:
        """Reject the edge of a pair ``A:B``, or a change (``c12``); see `confirm`."""
        return self._review(what, "withdraw" if withdraw else "reject", note)

    def _review(self, what: str, review: str, note: str) -> EdgeRow | ChangeRow:
        from gsmap.map.changes.rows import change_row
        from gsmap.store.changes import number_of

        if (number := number_of(what)) is not None:
            self.store.changes.review(number, review, note)
            return change_row(self.store, number)
        a, b = self._pair(what)
        self.store.registrations.review(a.id, b.id, review, note)
        return reports.edge_row(self.store, a, b)

    def _pair(self, pair: str) -> tuple[Scene, Scene]:
        return reports.pair_of(self.store, pair)

    def optimize(self) -> RevisionRow:
        """Optimize all scene poses and store them as a new revision."""
        from gsmap.map.stages.optimize import optimize

        with announce_work(self.store, "optimize"):
            number = optimize(self.store, self.settings, self._progress)
        return reports.revision_row(self.store, number)

    def update(
        self, *captures: str | os.PathLike[str], captured_at: str | None = None, clean: bool = False
    ) -> UpdateReport:
        """Ingest captures, then compute missing scene graphs, edges and poses; report what changed.

        Args:
            captured_at, clean: as in `ingest`.
        """
        from gsmap.map.stages.describe import describe, unthinned
        from gsmap.map.stages.optimize import solve
        from gsmap.map.stages.register import RegisteredPairs, register

        if captured_at is not None and not captures:
            raise ConfigError(
                "--captured-at needs captures: name their files, or change the date of a scene with gsmap edit",
                code="option_not_applicable",
            )
        if clean and not captures:
            raise ConfigError("--clean needs captures: name their files", code="option_not_applicable")
        before = reports.history_position(self.store)
        with announce_work(self.store, "update"):
            ingested = self.ingest(*captures, captured_at=captured_at, clean=clean) if captures else []
            scenes = self.store.scenes.summaries()
            with explain_purges(self.store, scenes):
                describe(self.store, unthinned(scenes), self.settings, self._progress)
                known = RegisteredPairs()
                register(self.store, "auto", self.settings, self._progress, known)
                # Poses may tell of new neighbours, and their edges of new poses.
                while solve(self.store, self.settings, self._progress):
                    if not register(self.store, "auto", self.settings, self._progress, known):
                        break
        return reports.update_report(self.store, ingested, before, self.metres)

    def set_prior(self, prior: Prior) -> PriorRow | None:
        """Set the pose prior of a scene (GPS, survey, an anchor) in place of the previous prior; see `Prior`.

        Raises:
            InputError: what `optimize` could not use; nothing is noted.
        """
        from gsmap.optimize.measurements import check_priors

        check_priors([prior.scene], [prior])
        self.store.priors.set(prior)
        return reports.prior_row(self.store, self.store.scenes.get(prior.scene))

    def remove_prior(self, scene: str) -> None:
        """Remove the surveyed world position of a scene or, without one, its pose prior."""
        from gsmap.map.world.georeference import forget_position

        if not forget_position(self.store, scene):
            self.store.priors.remove(scene)

    # --- changes -----------------------------------------------------------------------------------------------------

    def changes(
        self,
        pair: str | None = None,
        *,
        since: str | None = None,
        between: Sequence[str] | None = None,
        as_of: str | None = None,
        min_confidence: float = 0.0,
        pictures: str | os.PathLike[str] | None = None,
    ) -> ChangesReport:
        """Report the changes between each capture and the previous captures of the same place.

        What has not been compared under these settings and at these poses is compared first, unless the map is open for
        reading only.

        Args:
            pair: restrict to the two captures of ``A:B``; damaged results are repeated.
            since: restrict to newer captures dated after this, ISO 8601.
            between: restrict to newer captures dated after the first and at or before the second date.
            as_of: restrict to newer captures dated at or before this.
            min_confidence: minimum confidence, in [0, 1].
            pictures: folder for images before and after each change; an empty or new one, or one of this map.

        Raises:
            NotFoundError: the map has no poses yet, or no such scene.
            InputError: the dates do not order the two given captures.
        """
        from gsmap.map.changes.compare import compare, plan_comparisons
        from gsmap.map.changes.rows import changes_report, filter_by_date

        asked = plan_comparisons(self.store, self.settings, None if pair is None else self._pair(pair))
        asked = filter_by_date(asked, since, between, as_of)
        if self.store.catalog.writable:
            with announce_work(self.store, "changes"):
                compare(self.store, asked, self.settings, self._progress, verify=pair is not None)
        report = changes_report(self.store, self.settings, asked, min_confidence=min_confidence)
        if pictures is None:
            return report
        from gsmap.map.pictures.comparison_pictures import draw

        files = draw(self.store, Path(pictures), report.changes, self._progress)
        return replace(report, changes=tuple(replace(row, picture=files.get(row.id)) for row in report.changes))

    def show_change(self, name: str) -> ChangeDetail:
        """Report one change (``gsmap show MAP c12``).

        Raises:
            NotFoundError: no change is called so, or it is no longer found.
        """
        from gsmap.map.changes import rows

        return rows.change_detail(self.store, rows.parse_change_id(name))

    def read_change(self, name: str) -> Change:
        """Return a change (``c12``) with its arrays: voxels in the map frame, and rows of the Gaussians of both
        captures.

        Raises:
            NotFoundError: no change is called so, it is no longer found, or has no place now.
        """
        from gsmap.map.changes import rows

        return rows.change_arrays(self.store, rows.parse_change_id(name))

    # --- objects -----------------------------------------------------------------------------------------------------

    def objects(self) -> ObjectsReport:
        """Report the objects of the map and their relations (``gsmap graph MAP``).

        Raises:
            NotFoundError: the map has no poses yet.
        """
        from gsmap.map.objects.map_objects import compute_objects, objects_report

        return objects_report(compute_objects(self.store, self.settings, self._progress))

    def graph(self) -> Any:
        """Return the objects as a `networkx.MultiDiGraph` (see `gsmap.objects.object_graph`)."""
        from gsmap.map.objects.map_objects import as_networkx, compute_objects

        return as_networkx(compute_objects(self.store, self.settings, self._progress))

    def write_graph(self, out: str | os.PathLike[str], format: str = "json") -> ObjectsReport:
        """Write the objects as ``json`` or ``graphml``; after an error, no partial file remains."""
        from gsmap.map.objects.map_objects import compute_objects, objects_report, write_graph

        known = compute_objects(self.store, self.settings, self._progress)
        write_graph(known, out, format, self.store.id)
        return objects_report(known)

    def history(self, place: str | None = None, *, box: Sequence[float] | None = None) -> HistoryReport:
        """Report the objects of a place over time.

        Args:
            place: an object by its id or name, or a point ``X,Y,Z`` of the map.
            box: lowest and highest corner, six numbers.

        Raises:
            ConfigError: not one place.
            NotFoundError: no such object, or the map has no poses yet.
        """
        from gsmap.map.objects.map_objects import compute_objects, history_report

        return history_report(compute_objects(self.store, self.settings, self._progress), place, box)

    def is_object(self, ref: str) -> bool:
        """Return true if a text is the id or name of an object (such as ``o12``) and not of a scene."""
        from gsmap.store.objects import number_of

        return number_of(ref) is not None and ref not in {scene.name for scene in self.scenes()}

    def edit_object(
        self,
        ref: str,
        *,
        name: str | None = None,
        label: str | None = None,
        note: str | None = None,
        same_as: str | None = None,
        author: str = "",
    ) -> ObjectRow:
        """Annotate an object (``gsmap edit MAP o12``); earlier annotations stay in its history.

        Args:
            ref: id or name.
            name: unique name; ``none`` removes it.
            label: class label; ``none`` removes it.
            note: note to add.
            same_as: object that is the same; ``none`` separates them.
            author: author of the annotation.

        Raises:
            NotFoundError: no such object.
            InputError: a name that is taken, or two that a capture shows apart; nothing is written.
        """
        from gsmap.map.objects.map_objects import edit_object

        words = {"name": name, "label": label, "note": note, "same_as": same_as}
        return edit_object(self.store, self.settings, ref, self._progress, author=author, **words)

    # --- localize ----------------------------------------------------------------------------------------------------

    def localize(
        self,
        *files: str | os.PathLike[str] | np.ndarray | Image,
        intrinsics: str | Sequence[float] | None = None,
        focal: str | float | None = None,
        near: str | None = None,
        together: bool = False,
        video: str | os.PathLike[str] | None = None,
        masks: str | os.PathLike[str] | None = None,
        depth: str | os.PathLike[str] | None = None,
        depth_scale: float = 1000.0,
        changes: bool = False,
        pictures: str | os.PathLike[str] | None = None,
        add: bool = False,
        captured_at: str | None = None,
    ) -> LocalizeReport:
        """Localize photos and scans (``gsmap localize MAP FILE...``).

        What views are found by is made for every scene that lacks it, and kept unless the map is read-only.

        Args:
            files: photos and scans; or photos in memory: PIL images, or RGB arrays (H, W, 3) in uint8 or as floats in
                [0, 1]. The latter are called ``photo_0`` and so on, by their position.
            intrinsics: ``fx fy cx cy`` of all photos, in pixels of the upright image; or a text, the name of a COLMAP
                camera model and its parameters, such as ``SIMPLE_RADIAL,700,400,300,-0.1`` or ``EQUIRECTANGULAR``.
            focal: focal length in pixels, or ``auto`` to estimate it; default: EXIF.
            near: restrict to places that this scene shows, or to ``X,Y,Z,R`` around a point of the map.
            together: the photos show one place and overlap; localized photos help to localize the others.
            video: a video, whose sharpest frames are localized together; needs the extra ``video``.
            masks: folder with a mask of each photo, black where it is ignored (people, cars): of ``photo.jpg`` it is
                ``photo.jpg.png``.
            depth, depth_scale: a depth image of the view of the single photo, and its value of one metre.
            changes: report regions that differ from the map; ``pictures`` is a folder to draw them in.
            add: store localized photos as evidence, dated by ``captured_at`` or EXIF.

        Raises:
            NotFoundError: no such file or scene, or nothing in the map has a place.
            InputError: a file is neither a picture nor a scan.
            ConfigError: what is said of the lens or the place makes no sense.
        """
        from gsmap.map.localization.photo_localization import PhotoOptions, localize_files

        with announce_work(self.store, "localize"):
            return localize_files(
                self.store,
                self.settings,
                files,
                intrinsics=intrinsics,
                focal=focal,
                near=near,
                together=together,
                video=video,
                progress=self._progress,
                masks=masks,
                depth=depth,
                depth_scale=depth_scale,
                options=PhotoOptions(changes, pictures, add, captured_at),
            )

    def find(
        self,
        text: str | None = None,
        *,
        picture: str | os.PathLike[str] | None = None,
        like: str | None = None,
        at: Sequence[float] | None = None,
        top: int = 10,
        pictures: str | os.PathLike[str] | None = None,
    ) -> FindReport:
        """Search for objects and places (``gsmap find MAP``), best first.

        Args:
            text: text; the map's image encoder needs a text encoder.
            picture: image file that shows one object.
            like: id of an object, or ``SCENE:NODE``, a row of a scene's object layer.
            at: (3,) point in the frame of component 0.
            top: maximum number of hits.
            pictures: folder for an image of each hit; an empty or new one, or one of this map.

        Raises:
            NotFoundError: no poses yet, or no such scene, node, object, or thing at the point.
            ConfigError: not one thing to look for, or words or a picture that the embedder cannot read.
        """
        from gsmap.map.find.place_search import Request, find_places, with_pictures

        request = Request(text, picture, like, at, top)
        report, boxes = find_places(self.store, request, self.settings, self._progress)
        if pictures is None:
            return report
        return with_pictures(self.store, report, boxes, Path(pictures), self._progress)

    # --- scans -------------------------------------------------------------------------------------------------------

    def localize_scan(
        self,
        file: str | os.PathLike[str],
        *,
        intrinsics: Sequence[float] | None = None,
        colour: str | os.PathLike[str] | None = None,
        depth_scale: float = 1000.0,
        scale: str | None = None,
        near: str | None = None,
    ) -> ScanRow:
        """Localize a point cloud, mesh, splat or depth image, without storing anything.

        Args:
            file: ``.ply .pcd .xyz .las .laz .obj .stl .glb``, any splat, or (with ``intrinsics``) a depth picture.
            intrinsics: ``fx, fy, cx, cy`` of a depth picture, pixels.
            colour: colour image aligned with the depth image.
            depth_scale: depth value of one metre.
            scale: ``known`` (the file is in metres), ``unknown`` or ``auto``; default: ``known``, but ``auto`` for
                splats, ``.obj`` and ``.stl``.
            near: restrict to scenes near a scene (name), or near a ball ``X,Y,Z,R`` in the frame of component 0.

        Raises:
            NotFoundError: no such file, or the map has no poses yet.
            InputError, ConfigError, MissingDependencyError: see `gsmap.formats.scans`.
        """
        from gsmap.map.localization.localize_scan import Request, localize_scan

        request = Request(Path(file), intrinsics, colour, depth_scale, scale, near)
        return localize_scan(self.store, request, self.settings, self._progress)

    # --- export ------------------------------------------------------------------------------------------------------

    def export(
        self,
        out: str | os.PathLike[str],
        *,
        format: str | None = None,
        tile_size_m: float | None = None,
        bbox: Sequence[float] | None = None,
        merge: str | None = None,
        revision: int | None = None,
        component: int | None = None,
        steps: int | None = None,
        budget_s: float | None = None,
        provenance: bool = False,
        uncompressed: bool = False,
        prefer: str | None = None,
        as_of: str | None = None,
        static: bool = False,
        up: str | None = None,
        nonrigid: bool = False,
        wait: bool = False,
    ) -> ExportReport:
        """Export merged tiles to a folder; unchanged tiles are kept.

        Merged tiles are also kept in the user's cache folder, so that a further format or folder merges nothing again.

        Args:
            format: suffix of the tiles' files, or a tree of levels: ``3dtiles`` or ``streamed-sog``; default: ``spz``,
                or ``ply`` with ``provenance``.
            tile_size_m: tile size in metres; 0 for one file per component; default: one file of a component whose
                captures have at most 1.5 million Gaussians, and tiles of 10 m of a larger one.
            bbox: box ``x0 y0 z0 x1 y1 z1`` of the map to export, map unit.
            merge: ``tto``, ``voxel``, ``union``, ``distance``, or a plug-in's; default: the setting ``merge.method``.
            revision: revision of the poses; default: newest.
            component: restrict to this component.
            steps: optimization steps per tile; default: by tile size.
            budget_s: maximum wall seconds per tile; a tile cut short is marked ``truncated``.
            provenance: add the property ``scene`` to ``.ply`` files.
            uncompressed: write ``3dtiles`` as float32, for viewers without SPZ in glTF.
            prefer: preferred capture where captures disagree: ``newest``, ``best`` (best observed) or ``both``;
                default: the merger's setting.
            as_of: restrict to captures dated at or before this (ISO 8601; a day until its end); undated ones are left
                out. Poses are those of the revision.
            static: export static content only, without objects that moved or were observed to be absent. Missing
                comparisons of visits are made first.
            up: vertical axis of the files: ``z``, that of the map, or ``y``, as viewers of the format expect it;
                default: ``z`` for ``ply``, ``3dtiles`` and ``streamed-sog``, ``y`` for other formats.
            nonrigid: warp captures that are stretched or bent onto the captures they overlap with, so that no seam is
                left. The capture with most overlap with captures that agree with it keeps its shape.
            wait: wait while another export runs in the folder.

        Raises:
            BusyError: another export is at work in the folder; it is named.
            ConfigError, InputError, StoreError: see `gsmap.export`; no half-written tile is left.
        """
        from gsmap.map.objects.static_filter import find_omitted
        from gsmap.map.stages.export import Request, export

        request = Request(
            format=format or ("ply" if provenance else "spz"),
            tile_size_m=tile_size_m,
            bbox=bbox,
            merge=merge,
            revision=revision,
            component=component,
            steps=steps,
            budget_s=budget_s,
            provenance=provenance,
            uncompressed=uncompressed,
            prefer=prefer,
            as_of=as_of,
            static=static,
            up=up,
            nonrigid=nonrigid,
        )

        def progress(fraction: float, text: str) -> None:
            self._progress("export", fraction, text)

        known, told = self.static_content() if static else (None, ())
        made, notes = export(
            self.store,
            Path(out),
            request,
            self.settings,
            progress,
            wait=wait,
            find_omitted=partial(find_omitted, known=known),
        )
        return reports.export_report(self.store, Path(out), made, (*told, *notes))

    def export_survey(
        self,
        out: str | os.PathLike[str],
        *,
        crs: str | None = None,
        pixel_size: float | None = None,
        bbox: Sequence[float] | None = None,
        merge: str | None = None,
        revision: int | None = None,
        component: int | None = None,
        steps: int | None = None,
        prefer: str | None = None,
        as_of: str | None = None,
        static: bool = False,
    ) -> ExportReport:
        """Write a georeferenced component as a file for surveyors (``gsmap export MAP FILE``).

        Args:
            out: ``.las`` or ``.laz`` (points with colours), ``.tif`` (an orthophoto as GeoTIFF, without ceilings), or
                ``.geojson`` or ``.dxf`` (footprints of scenes, and a cross section of walls).
            crs: CRS of the file; default: that of the map.
            pixel_size: side of a pixel of an orthophoto, in the unit of the CRS; default: 1, 2 or 5 times a power of
                ten, for at most 8192 pixels on a side.
            bbox, merge, revision, component, steps, prefer, as_of, static: as in `export`.

        Raises:
            NotFoundError: no component is georeferenced.
            ConfigError: several are, and none was chosen; or options that do not fit the kind of file.
            MissingDependencyError: laspy or ezdxf is not installed.
        """
        from gsmap.map.objects.static_filter import find_omitted
        from gsmap.map.stages.export import Request
        from gsmap.map.world.survey_export import SurveyOptions, export_survey
        from gsmap.types.rows.exports import ExportReport

        request = Request(
            bbox=bbox,
            merge=merge,
            revision=revision,
            component=component,
            steps=steps,
            prefer=prefer,
            as_of=as_of,
            static=static,
        )
        known, told = self.static_content() if static else (None, ())
        notes = export_survey(
            self.store,
            Path(out),
            request,
            SurveyOptions(crs, pixel_size),
            self.settings,
            lambda fraction, text: self._progress("export", fraction, text),
            partial(find_omitted, known=known),
        )
        return ExportReport(out=os.fspath(out), tiles=(), recomputed=1, reused=0, removed=0, notes=(*told, *notes))

    def static_content(self) -> tuple[MapObjects, tuple[str, ...]]:
        """Compare all visits, and return the objects of the map with notes on visits that are left out."""
        from gsmap.map.changes.compare import compare, missing_comparisons, plan_comparisons
        from gsmap.map.objects.map_objects import compute_objects

        asked = plan_comparisons(self.store, self.settings)
        told = asked.notes
        if self.store.catalog.writable:
            with announce_work(self.store, "changes"):
                compare(self.store, asked, self.settings, self._progress)
        elif missing := len(missing_comparisons(self.store, asked, self.settings)):
            told += (f"{counted(missing, 'pair')} of visits not compared, and the map is open for reading only",)
        return compute_objects(self.store, self.settings, self._progress), told

    def export_small(self, out: str | os.PathLike[str], budget_bytes: int, *, static: bool = False) -> SmallMapReport:
        """Export a small map for localization only (``gsmap export MAP OUT --for localize``).

        Args:
            static: export static content only, see `export`.

        Raises:
            StoreError: the folder is not empty.
            ConfigError: so few bytes that hardly a photograph would be found; how many it takes is said.
            NotFoundError: the map has no poses yet.
        """
        from gsmap.map.small_map.export import export_small

        known = self.static_content()[0] if static else None
        with announce_work(self.store, "export"):
            return export_small(self.store, Path(out), budget_bytes, self.settings, self._progress, known)

    def _repr_html_(self) -> str:
        return reports.map_html(self.store, self.status(), self.scene_rows())

    # --- look --------------------------------------------------------------------------------------------------------

    def scenes(self) -> list[Scene]:
        """List the living scenes, in the order of ingest."""
        return self.store.scenes.list()

    def metres(self, revision: int | None = None) -> dict[int, MetricScale]:
        """Return the metric scale of each component of a revision, by default the newest."""
        return metres_at(self.store, revision)

    def poses(self, revision: int | None = None) -> dict[str, ScenePose]:
        """Return the poses of a revision, by default the newest, by scene name; removed scenes by their id.

        ``m.poses()["hall"].S_map_scene`` maps points of scene ``hall`` to the frame of its component.
        """
        graph, names = self.pose_graph(revision), {scene.id: scene.name for scene in self.scenes()}
        return {names.get(scene, scene): pose for scene, pose in ({} if graph is None else graph.poses).items()}

    def pose_graph(self, revision: int | None = None) -> PoseGraph | None:
        """Return the poses of a revision, by default the newest; None before the first optimize."""
        return self.store.revisions.get(revision)

    def read(self, ref: str, *, frame: str = "scene") -> tuple[Gaussians, Cameras]:
        """Read the Gaussians and cameras of a scene, in the scene frame or in the ``map`` frame of its component.

        Raises:
            NotFoundError: no such scene, or no pose for it yet.
            ConfigError: another frame.
        """
        scene = self.store.scenes.get(ref)
        gaussians, cameras = self.store.scenes.gaussians(scene.id), self.store.scenes.cameras(scene.id)
        if frame == "scene":
            return gaussians, cameras
        if frame != "map":
            raise ConfigError(
                f"the frame to read a scene in must be 'scene' or 'map', got {frame!r}", code="invalid_choice"
            )
        graph = self.pose_graph()
        if graph is None or scene.id not in graph.poses:
            raise NotFoundError(
                f"scene {scene.name} has no place in the map yet: run gsmap update first", code="scene_unplaced"
            )
        S_map_scene = graph.poses[scene.id].S_map_scene
        return transform_gaussians(gaussians, S_map_scene), transform_cameras(cameras, S_map_scene)

    def scene_rows(
        self,
        *,
        component: int | None = None,
        status: str | None = None,
        after: str | None = None,
        tag: str | None = None,
        as_of: str | None = None,
    ) -> Table[SceneRow]:
        """List scenes (``gsmap list MAP scenes``), filtered by component, status, date or tag."""
        chosen: dict[str, Any] = {"component": component, "status": status, "after": after, "tag": tag, "as_of": as_of}
        return Table(reports.scene_rows(self.store, **chosen, metres=self.metres()))

    def edge_rows(
        self,
        *,
        component: int | None = None,
        status: str | None = None,
        after: str | None = None,
        tag: str | None = None,
        as_of: str | None = None,
    ) -> Table[EdgeRow]:
        """List edges (``gsmap list MAP edges``), filtered by status or use, date, or their scenes."""
        chosen: dict[str, Any] = {"component": component, "status": status, "after": after, "tag": tag, "as_of": as_of}
        return Table(reports.edge_rows(self.store, **chosen))

    def revision_rows(self) -> Table[RevisionRow]:
        """List revisions (``gsmap list MAP revisions``)."""
        return Table(reports.revision_rows(self.store))

    def tile_rows(self) -> Table[TileRow]:
        """List tiles (``gsmap list MAP tiles``)."""
        return Table(reports.tile_rows(self.store))

    def model_rows(self) -> Table[ModelRow]:
        """List ONNX models (``gsmap models list MAP``)."""
        return Table(reports.model_rows(self.store))

    def pose_rows(self, crs: str | None = None) -> Table[PoseRow]:
        """List the poses of all placed scenes (``gsmap poses MAP``) in the map and the world (``crs``, default: the
        map's CRS).
        """
        return Table(reports.pose_rows(self.store, crs))

    def status(self) -> MapStatus:
        """Report open tasks with the commands that resolve them (``gsmap status MAP``)."""
        from gsmap.map.changes.rows import num_open
        from gsmap.map.objects.static_filter import find_omitted
        from gsmap.map.status import status

        return status(self.store, self.settings, num_open, find_omitted)

    def show_scene(self, ref: str) -> SceneReport:
        """Report a scene with its nodes and edges (``gsmap show MAP SCENE``)."""
        scene = self.store.scenes.get(ref)
        return reports.scene_report(self.store, scene, *self._graph_of(scene), self.metres())

    def show_pair(self, pair: str) -> PairReport:
        """Report a pair with its edge, evidence and history (``gsmap show MAP A:B``)."""
        return reports.pair_report(self.store, *self._pair(pair))

    def why(self, pair: str, *, pictures: str | os.PathLike[str] | None = None) -> PairExplanation:
        """Explain why a pair is, or is not, an edge (``gsmap why MAP A:B``).

        Args:
            pictures: folder for an image of both captures from the same cameras; an empty or new one, or one of this
                map.
        """
        from gsmap.map.pair_explanation import explain_pair

        scenes = self._pair(pair)
        report = explain_pair(self.store, self.settings, *scenes)
        if pictures is None:
            return report
        from gsmap.map.pictures.comparison_pictures import draw_pair

        return replace(report, picture=draw_pair(self.store, Path(pictures), *scenes))

    def _graph_of(self, scene: Scene) -> tuple[SceneGraph | None, str]:
        """Return a scene's graph by the settings in force, or else its newest graph and a note on that choice."""
        from gsmap.map.stages.describe import graph_keys

        graph, note = None, "its graph was made by other settings or another version: run gsmap update"
        try:
            graph = self.store.graphs.load(scene.id, graph_keys(self.store, [scene], self.settings)[scene.id])
        except ConfigError as error:  # what is in the map can be looked at whatever the settings say
            note = f"its newest graph, since the map's settings cannot be read: {error}"
        if graph is not None:
            return graph, ""
        newest = self.store.graphs.load(scene.id)
        return newest, "" if newest is None or scene.thinning else note  # a thinned scene is not described again

    def diff(self, before: int, after: int) -> Table[PoseChangeRow]:
        """List how each scene moved between two revisions (``gsmap diff MAP R1 R2``), measured at the scene's
        centre.
        """
        return Table(reports.pose_change_rows(self.store, before, after))

    def evaluate(
        self,
        truth: str | os.PathLike[str],
        images: str | os.PathLike[str] | None = None,
        *,
        tiles: str | os.PathLike[str] | None = None,
        lpips: str | os.PathLike[str] | None = None,
        max_rre_deg: float | None = None,
        max_rte_m: float | None = None,
        truth_sigma: tuple[float, float] | None = None,
    ) -> EvaluationReport:
        """Evaluate edges and poses against ground truth, and renders against photos (``gsmap evaluate MAP``).

        Args:
            truth: folder of ``NAME.json`` with ``T_scene_world`` (4x4), the world in metres.
            images: folder of photos named like the cameras.
            tiles: export folder to compare with the photos, too.
            lpips: an LPIPS network to compare with the photos, too.
            max_rre_deg, max_rte_m: maximum rotation error and translation error (at the source's centre) of a right
                edge; default: the settings ``evaluate.*``.
            truth_sigma: standard deviations of the truth in degrees and metres; default: 0.

        Raises:
            ConfigError: tiles or a network without photographs to compare with, or bars that are not positive.
            NotFoundError, InputError: see `gsmap.map.evaluation.evaluate`.
        """
        from gsmap.map.evaluation import evaluate

        if images is None and (tiles is not None or lpips is not None):
            raise ConfigError(
                "--tiles and --lpips compare with photos: give the folder of images, too", code="missing_option"
            )
        params = self.settings.evaluate
        if max_rre_deg is not None:
            params = replace(params, max_rre_deg=max_rre_deg)
        if max_rte_m is not None:
            params = replace(params, max_rte_m=max_rte_m)
        if truth_sigma is not None:
            params = replace(params, truth_sigma_deg=truth_sigma[0], truth_sigma_m=truth_sigma[1])
        report = evaluate.poses(self.store, truth, params, self.metres())
        if images is None:
            return report
        rows = evaluate.images(
            self.store,
            images,
            lambda f, text: self._progress("evaluate", f, text),
            tiles=tiles,
            lpips=lpips,
            limits=self.settings.describe.object.limits,
        )
        return replace(report, images=rows)

    def view(
        self, *, port: int = 0, tiles: str | os.PathLike[str] | None = None, read_only: bool = False
    ) -> ViewServer:
        """Serve a page to view and review the map (``gsmap view MAP``), on this machine only, until it is closed.

        Args:
            tiles: folder of exported 3D Tiles to show beside the scenes.
            read_only: disable changes from the page; they are also disabled if the map is read-only.

        Raises:
            ConfigError: the port is taken, the page was not built, or that folder holds no 3D Tiles of this map.
        """
        from gsmap.map.page.actions import actions_of
        from gsmap.map.page.source import MapPageSource, cache_folder
        from gsmap.view import ViewServer

        settings = self._settings_to_look_by()
        actions = {} if read_only or not self.store.catalog.writable else actions_of(self)
        page_source = MapPageSource(self.store, settings, actions, None if tiles is None else Path(tiles))
        return ViewServer(page_source, cache_folder(), settings.view, port=port)

    def write_site(self, folder: str | os.PathLike[str], *, tiles: str | os.PathLike[str] | None = None) -> ViewReport:
        """Write the page as files that any web server can host (``gsmap view MAP --export DIR``).

        In a new folder it appears whole or not at all. ``gsmap-site.json`` lists its files; others are never touched.

        Args:
            folder: an empty or new one, or one that this map's page was written to before, the files of which are
                replaced, ``map.json`` and ``index.html`` last.
            tiles: as in `view`; they are copied.

        Raises:
            ConfigError: the folder holds something else, or a page of a gsmap that kept no list of its files; another
                file lies where one has to go; the page was not built; or ``tiles`` are not this map's.
        """
        from gsmap.map.page.export import write_site

        chosen = None if tiles is None else Path(tiles)
        return write_site(self.store, self._settings_to_look_by(), Path(folder), chosen, self._progress)

    def write_page(self, path: str | os.PathLike[str], *, megabytes: float = 20.0) -> ViewReport:
        """Write the page with the map as one file (``gsmap export MAP OUT.html --format html``).

        Args:
            path: path ending with ``.html``; an earlier page or report of this map is replaced.
            megabytes: maximum size of the levels of detail in MB; the file is about a third larger, plus the page
                itself.

        Raises:
            ConfigError: another file, or the page was not built.
            NotFoundError: no such folder.
        """
        from gsmap.map.page.export import write_page

        return write_page(self.store, self._settings_to_look_by(), Path(path), megabytes, self._progress)

    def report(self, path: str | os.PathLike[str], *, since: str | None = None, pictures: bool = True) -> WrittenReport:
        """Write a self-contained report page (``gsmap report MAP OUT.html``) with doubtful edges, changes and open
        tasks.

        Args:
            path: path ending with ``.html``; an earlier report is replaced.
            since: list what is new since this date, ISO 8601.
            pictures: draw doubtful pairs and changes.

        Raises:
            ConfigError: another file, or no date.
            NotFoundError: no such folder.
        """
        from gsmap.map.report.builder import write_report

        return write_report(self.store, self._settings_to_look_by(), Path(path), since, pictures, self._progress)

    def draw_pair(self, pair: str, path: str | os.PathLike[str]) -> None:
        """Draw both captures of a pair from the same cameras (``gsmap show MAP A:B --picture``).

        Raises:
            NotFoundError: no pose was found.
        """
        from gsmap.map.pictures.comparison_pictures import picture_of_pair, save_picture

        a, b = self._pair(pair)
        if (picture := picture_of_pair(self.store, a.id, b.id)) is None:
            raise NotFoundError(
                f"{a.name}:{b.name} has no pose by which both captures could be drawn: gsmap why MAP A:B explains it",
                code="no_pose_of_pair",
            )
        save_picture(picture, path)

    def draw_object(self, ref: str, path: str | os.PathLike[str]) -> None:
        """Draw an object by its id or name (``gsmap show MAP o12 --picture``).

        Raises:
            NotFoundError: no such object.
        """
        from gsmap.map.objects.map_objects import compute_objects
        from gsmap.map.pictures.comparison_pictures import save_picture
        from gsmap.map.pictures.object_pictures import ObjectPictures

        known = compute_objects(self.store, self.settings, self._progress)
        save_picture(ObjectPictures(self.store, known).draw(ref), path)

    def draw_change(self, name: str, path: str | os.PathLike[str]) -> None:
        """Draw the place before and after a change (``gsmap show MAP c12 --picture``).

        Raises:
            NotFoundError: no such change, or it has no place now.
        """
        from gsmap.map.pictures.comparison_pictures import picture_of_change, save_picture

        row = self.show_change(name)
        if (picture := picture_of_change(self.store, row)) is None:
            raise NotFoundError(
                f"{name} has no position: its newer capture has no pose; run gsmap update", code="change_unplaced"
            )
        save_picture(picture, path)

    def draw_graph(self, ref: str, path: str | os.PathLike[str]) -> None:
        """Draw the scene graph over a render (``gsmap show MAP SCENE --picture``)."""
        from gsmap.map.pictures.comparison_pictures import save_picture
        from gsmap.view.graph_picture import draw_graph

        scene = self.store.scenes.get(ref)
        graph, _ = self._graph_of(scene)
        if graph is None:
            raise NotFoundError(
                f"scene {scene.name} has no graph: run gsmap describe MAP {scene.name!r} first", code="no_graph"
            )
        save_picture(draw_graph(*self.read(scene.id), graph), path)

    def write_poses(self, out: str | os.PathLike[str], format: str, crs: str | None = None) -> list[Path]:
        """Export poses for other programs (``gsmap poses MAP OUT --format F``, `gsmap.map.poses`); return the files."""
        from gsmap.map.poses import write_poses

        return write_poses(self.store, Path(out), format, crs)

    # --- the world ---------------------------------------------------------------------------------------------------

    def georeference(
        self,
        request: Request | None = None,
        *,
        remove: Sequence[str] | None = None,
        localise: LocalizePhotos | None = None,
    ) -> WorldReport:
        """Store observations of the world, solve the poses with them, and report residuals (``gsmap georeference
        MAP``).

        Args:
            request: observations to store (`gsmap.map.world.georeference.Request`); None to report only.
            remove: names of observations to remove; an empty sequence removes all, with the CRS.
            localise: localizes photos that are not cameras of a scene
                (`gsmap.map.localization.photo_poses.photo_localizer`).

        Raises:
            ConfigError, InputError, NotFoundError: see `gsmap.map.world.georeference`; nothing is noted then.
        """
        from gsmap.map.stages.optimize import is_solved, solve
        from gsmap.map.world.georeference import georeference, take_back
        from gsmap.map.world.rows import world_report

        notes: tuple[str, ...] = ()
        if request is not None or remove is not None:
            with announce_work(self.store, "georeference"):
                if remove is not None:
                    notes = (f"{take_back(self.store, remove)} observations were removed",)
                solution = None
                if request is not None:
                    told, solution = georeference(self.store, request, self.settings, localise)
                    notes += told
                solve(self.store, self.settings, self._progress, solution)
        return world_report(self.store, stale=not is_solved(self.store, self.settings), notes=notes)

    def set_world_position(
        self, scene: str, position: Sequence[float], sigma_m: tuple[float, float], crs: str = "EPSG:4326"
    ) -> None:
        """Store the world position of the origin of a scene's frame (``gsmap prior MAP SCENE --latitude ...``).

        Args:
            position: (3,) longitude or easting first, then latitude or northing, then height.
            sigma_m: horizontal and vertical standard deviations.
        """
        from gsmap.map.world.georeference import survey_position

        survey_position(self.store, scene, position, crs, sigma_m, self.settings)

    def measure(self, a: str, b: str, *, component: int | None = None, crs: str | None = None) -> MeasureReport:
        """Measure the distance between two points in metres (``gsmap measure MAP A B``).

        Args:
            a, b: ``X,Y,Z`` (map), ``SCENE:X,Y,Z``, ``SCENE:CAMERA@COLUMN,ROW`` or ``world:X,Y,Z``.
            component: component of points given in the map, if it has several.
            crs: CRS of the returned world coordinates; default: the map's.
        """
        from gsmap.map.world.distances import measure

        return measure(self.store, a, b, self.settings, component=component, crs=crs)

    # --- upkeep ------------------------------------------------------------------------------------------------------

    def edit(
        self,
        ref: str,
        *,
        tags: Sequence[str] = (),
        untag: Sequence[str] = (),
        author: str = "",
        **edits: Unpack[SceneEdits],
    ) -> SceneRow:
        """Edit a scene's name, date, notes and tags (``gsmap edit MAP SCENE``); its history keeps earlier values.

        Args:
            tags, untag: tags to add and to remove, or one tag.
            author: author of the edit.
            edits: new ``name``, ``captured_at`` (``none`` removes the date), ``note`` or ``metres_per_unit`` (of the
                scene's own frame; 0 removes it).
        """
        from gsmap.ingest import given_date

        if (date := edits.get("captured_at")) is not None:
            edits["captured_at"] = "" if date.strip().lower() == "none" else given_date(date).when
        added, removed = ((one,) if isinstance(one, str) else tuple(one) for one in (tags, untag))
        scene = self.store.scenes.edit(ref, tags_add=added, tags_remove=removed, author=author, **edits)
        return reports.scene_row(self.store, scene, self.metres())

    def photo_rows(self) -> list[PhotoRow]:
        """List the stored photos (``gsmap list MAP photos``), oldest first, with positions by the newest poses."""
        from gsmap.map.localization.photos import photo_rows

        return photo_rows(self.store)

    def remove_photo(self, which: str) -> PhotoRow:
        """Remove a stored photo (``gsmap remove MAP PHOTO --photo``) by file, number (``p3``) or digest.

        Raises:
            NotFoundError: none is called so, or several.
        """
        number = self.store.photos.find(which).number
        row = next(row for row in self.photo_rows() if row.id == f"p{number}")
        self.store.photos.remove(number)
        return row

    def remove(self, ref: str) -> SceneRow:
        """Remove a scene; older revisions keep it."""
        row = reports.scene_row(self.store, self.store.scenes.get(ref), self.metres())
        self.store.scenes.remove(ref)
        return row

    def branch(self, name: str) -> BranchRow:
        """Make a branch (``gsmap branch MAP NAME``), a second catalog for the same arrays; `open` it as
        ``MAP@NAME``.
        """
        return self.store.branches.make(name)

    def tag(self, name: str) -> BranchRow:
        """Make a tag (``gsmap tag MAP NAME``), the current state as read-only; `open` it as ``MAP@NAME``."""
        return self.store.branches.make(name, tag=True)

    def branches(self, kind: str | None = None) -> Table[BranchRow]:
        """List the branches and tags, or only one kind (``branch`` or ``tag``)."""
        return Table(row for row in self.store.branches.list() if kind in (None, row.kind))

    def delete_branch(self, name: str, kind: str | None = None) -> BranchRow:
        """Delete a branch or tag (``gsmap branch MAP NAME --delete``); `prune` reclaims its data.

        Raises:
            NotFoundError: none of that kind is called so.
        """
        row = self.store.branches.get(name)
        if kind not in (None, row.kind):
            raise NotFoundError(
                f"{name} is a {row.kind}: gsmap {row.kind} {self.store.home} {name} --delete",
                code="wrong_reference_kind",
            )
        self.store.branches.delete(name)
        return row

    def merge(self, source: str | os.PathLike[str]) -> MergeReport:
        """Merge another map, branch or tag into this map (``gsmap merge MAP SOURCE``), without computing anything."""
        from gsmap.map import map_operations

        return map_operations.merge(self.store, source)

    def split(
        self,
        out: str | os.PathLike[str],
        *,
        island: int | None = None,
        box: Sequence[float] | None = None,
        scenes: Sequence[str] | None = None,
    ) -> SplitReport:
        """Make a new map of some scenes with all their results (``gsmap split MAP OUT``).

        Args:
            island: restrict to this component.
            box: ``x0 y0 z0 x1 y1 z1``: restrict to scenes that reach into this box, in the frame of that component
                (default: 0).
            scenes: names of the scenes.
        """
        from gsmap.map import map_operations

        return map_operations.split(self.store, out, map_operations.chosen(self.store, island, box, scenes))

    def purge(self, ref: str, *, branches: bool = False) -> PurgeReport:
        """Delete a scene permanently, with its rows, arrays and tiles (``gsmap remove MAP SCENE --purge``).

        Args:
            branches: also purge the map's other branches and tags; else they are listed.
        """
        from gsmap.map.map_operations import purge_report
        from gsmap.map.page.export import SITES
        from gsmap.map.page.source import cache_folder
        from gsmap.map.pictures.comparison_pictures import PICTURES
        from gsmap.map.report.output import REPORTS
        from gsmap.map.small_map.export import SMALL_MAPS
        from gsmap.map.stages.purge import purge
        from gsmap.view.tree_cache import TreeCache

        outputs, caches = (REPORTS, SITES, SMALL_MAPS, PICTURES), (TreeCache(cache_folder(), 0),)
        return purge_report(purge(self.store, ref, outputs, caches, branches=branches))

    def restore_scene(self, ref: str, source: str | os.PathLike[str] | None = None) -> SceneRow:
        """Restore a removed scene (``gsmap restore-scene MAP SCENE``), or copy a scene from another map (``source``).

        With ``source``, arrays of it that are here and damaged are mended.
        """
        from gsmap.map import map_operations

        return reports.scene_row(self.store, map_operations.restore_scene(self.store, ref, source), self.metres())

    def check(self) -> CheckReport:
        """Check every byte of the map against its digest."""
        return self.store.check(lambda f, text: self._progress("check", f, text))

    def prune(self, keep_revisions: int | None = None, *, dry_run: bool = False) -> PruneReport:
        """Delete leftovers of interrupted work and results older than the newest ``keep_revisions`` (None: all)
        revisions."""
        return self.store.prune(keep_revisions=keep_revisions, dry_run=dry_run)

    def thin(
        self,
        *,
        keep_days: float | None = None,
        budget_bytes: int | None = None,
        dry_run: bool = False,
        now: str | None = None,
    ) -> ThinReport:
        """Store superseded captures in compact form (``gsmap thin MAP``), oldest first, and free space.

        Args:
            keep_days: captures of this many days before ``now`` stay whole.
            budget_bytes: thin only until the arrays of living scenes fit.
            now: ISO 8601; None for the time at which the map was last written, or the clock's if that is earlier.

        Raises:
            ConfigError: no days and no budget; or the clock contradicts what is stored, and ``now`` is not given.
        """
        from gsmap.map.thinning.thin import Request, thin

        with announce_work(self.store, "thin"):
            return thin(self.store, Request(keep_days, budget_bytes, dry_run, now), self.settings, self._progress)

    def backup(self, target: str | os.PathLike[str], *, verify: bool = False, keep: int | None = None) -> BackupReport:
        """Back up the map (``gsmap backup MAP DEST``) while other processes use it; send only new data.

        Args:
            target: a folder, ``file:///folder`` or ``s3://bucket/prefix``, for this map alone.
            verify: verify the data in the backup and send damaged data again.
            keep: number of newest snapshots to keep; the others are deleted.
        """
        from gsmap.map import backups

        told = self._progress
        return backups.save(
            self.store, target, verify=verify, keep=keep, progress=lambda f, text: told("backup", f, text)
        )

    def clone(self, path: str | os.PathLike[str]) -> CloneReport:
        """Make an independent copy of the map with its own id (``gsmap clone MAP NEW``)."""
        from gsmap.store import backup

        return backup.clone(self.store, path, lambda f, text: self._progress("clone", f, text))

    def add_model(self, kind: str, path: str | os.PathLike[str], *, preset: str = "clip", copy: bool = True) -> None:
        """Check an ONNX model, and copy it to the map (or reference it) for every later describe."""
        from gsmap.map import models

        models.add(self.store, kind, path, preset, copy, self.settings.describe.object.limits)
