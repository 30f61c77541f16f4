"""`Map`: every verb of the command line as a method. Doors only: the work is in `gsmap.map.stages` and `reports`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmap.engine import WorkerSession
from gsmap.errors import ConfigError, NotFoundError
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import reports
from gsmap.map import values as as_values
from gsmap.map.logs import logged
from gsmap.map.metres import metres_at
from gsmap.map.sharing import at_work
from gsmap.store import Store
from gsmap.types import Cameras, Change, Gaussians, PoseGraph, Prior, Scene, SceneGraph, Sim3
from gsmap.types.metre import Metre
from gsmap.types.progress import StageProgress
from gsmap.types.rows import (
    BackupReport,
    BranchRow,
    ChangeDetail,
    ChangeRow,
    ChangesReport,
    CheckReport,
    CloneReport,
    EdgeRow,
    EvaluationReport,
    ExportReport,
    FindReport,
    GraphRow,
    HistoryReport,
    IngestRow,
    LocalizeReport,
    MapStatus,
    MeasureReport,
    MergeReport,
    ModelRow,
    ObjectRow,
    ObjectsReport,
    PairReport,
    PhotoRow,
    PoseChangeRow,
    PoseRow,
    PriorRow,
    PruneReport,
    PurgeReport,
    RestoreReport,
    RevisionRow,
    SceneReport,
    SceneRow,
    SettingRow,
    SmallMapReport,
    SnapshotRow,
    SplitReport,
    Table,
    ThinReport,
    TileRow,
    UpdateReport,
    ViewReport,
    WhyReport,
    WorldReport,
    WrittenReport,
)
from gsmap.types.rows.localize_scan import ScanRow

if TYPE_CHECKING:
    from gsmap.map.objects import Known
    from gsmap.map.placed_photos import Localise
    from gsmap.map.settings import Settings
    from gsmap.map.stages.georeference import Request
    from gsmap.map.stages.register import Pairs
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
    """Open a map, or a branch or tag of one (``MAP@NAME``); read-only where its folder cannot be written."""
    return Map(Store.open(path, "w" if Store.can_write(path) else "r"), progress)


def open_or_create(path: str | os.PathLike[str], progress: StageProgress | None = None) -> Map:
    """Open a map, making it first where there is none."""
    return open(path, progress) if Store.exists(path) else create(path, progress)


def migrate(path: str | os.PathLike[str]) -> tuple[str | None, str | None]:
    """Bring an older map to this version's schema; returns the schema before and after."""
    return Store.migrate(path)


def restore(
    target: str | os.PathLike[str],
    path: str | os.PathLike[str],
    at: str | None = None,
    progress: StageProgress | None = None,
    *,
    catalog_url: str | None = None,
) -> RestoreReport:
    """``gsmap restore DEST MAP``: make a map from a backup, whole or not at all; it is the same map, with its id.

    Args:
        target: the backup: a folder, ``file:///folder`` or ``s3://bucket/prefix``.
        path: a folder that does not exist.
        at: the last snapshot at or before this time, or one by the beginning of its name; the newest by default.
        catalog_url: SQLAlchemy URL of an empty PostgreSQL database to keep the catalog in.
    """
    from gsmap.map import backing

    told = logged(progress)
    return backing.restore(
        target, path, at=at, catalog_url=catalog_url, progress=lambda f, text: told("restore", f, text)
    )


def snapshots(target: str | os.PathLike[str]) -> Table[SnapshotRow]:
    """``gsmap backup MAP DEST --list``: the states in a backup, oldest first."""
    from gsmap.map import backing

    return Table(backing.snapshots(target))


def accept_catalog(path: str | os.PathLike[str]) -> list[str]:
    """Take the catalog of a map that differs from what gsmap wrote as it is; returns what differed, in words.

    For salvage, or after a change by another program: from then on these bytes count as written, right or wrong.

    Raises:
        CorruptError: SQLite finds it broken: only a backup helps.
    """
    return Store.accept_catalog(path)


class Map(AbstractContextManager["Map"]):
    """An open map. Every method is a verb of the command line, and returns types or typed rows (`gsmap.types.rows`)."""

    def __init__(self, store: Store, progress: StageProgress | None = None) -> None:
        self.store = store
        self._progress = logged(progress)
        self._run: tuple[str | None, dict[str, Any]] = (None, {})
        self._workers = WorkerSession()

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        self._workers.close()  # first: they have the map open
        self.store.close()

    # --- settings ----------------------------------------------------------------------------------------------------

    @cached_property
    def settings(self) -> Settings:
        """The tree in force: defaults, the map's preset and settings, then those of this run (`with_settings`)."""
        from gsmap.map.settings import map_settings

        return map_settings(self.store.folder, *self._run)

    def _settings_to_look_by(self) -> Settings:
        """Those in force, or the defaults where these cannot be: a map is looked at whatever its settings say."""
        from gsmap.map.settings import Settings

        try:
            return self.settings
        except ConfigError:
            return Settings()

    def with_settings(self, values: Mapping[str, Any] | None = None, preset: str | None = None) -> Map:
        """Change settings for as long as this map is open, and not in ``settings.toml``; returns the map itself.

        Args:
            values: by dotted name, such as ``{"register.verdict.max_log_nfa": -6}``.
            preset: start from this preset instead of from what the map is set to.

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
        """``gsmap settings MAP --set``: change the map's own settings; nothing is written if any makes no sense."""
        from gsmap.map.settings import write_settings

        with self.store.catalog.lock():
            write_settings(self.store.folder, values or {}, preset=preset, drop=tuple(unset))
            self.store.send_settings()
        self.__dict__.pop("settings", None)

    def setting_rows(self) -> Table[SettingRow]:
        """``gsmap settings MAP``: every setting with value, default, unit and meaning."""
        return Table(reports.setting_rows(self.settings))

    # --- ingest, describe, register, optimize ------------------------------------------------------------------------

    def ingest(
        self,
        *captures: str | os.PathLike[str] | Gaussians,
        cameras: str | os.PathLike[str] | Cameras | None = None,
        name: str | None = None,
        captured_at: str | None = None,
        scale: str = "auto",
        supersedes: str | None = None,
    ) -> Table[IngestRow]:
        """Add captures: those found at files and folders, or one in memory. Each is checked whole before it is written.

        Of several, those that cannot be read are set aside: they are named in the logs (``gsmap.map``), by `status` and
        in ``store.set_aside.met``, and tried again whenever they are given. What is no splat is skipped with a warning.

        Args:
            captures: files and folders; or `Gaussians`, with `Cameras` or none.
            cameras, name: of the one capture given.
            captured_at: of every capture given, ISO 8601; UTC where it has no zone. Else each is dated by what lies
                beside it: a sidecar, the EXIF of its frames, or its name (`gsmap.ingest.find_date`).
            scale: ``known`` (metres), ``unknown`` (any unit) or ``auto`` (registration finds out).
            supersedes: the one capture given was trained again of the frames of this scene, in its frame of
                coordinates: it takes the scene's place, with its pose, what was said of it, and its edges, which are
                checked and not searched again.

        Raises:
            NotFoundError, InputError, ConfigError: see `gsmap.ingest`; where nothing could be a capture, or the one
                file that is named cannot be read.
            InputError: a capture that does not lie where the scene that it supersedes lies; nothing is changed.
        """
        from gsmap.map.stages.ingest import ingest, readers
        from gsmap.map.stages.supersede import supersede

        options: dict[str, Any] = {"cameras": cameras, "name": name, "captured_at": captured_at, "scale": scale}
        if supersedes is not None:
            found, _ = readers(captures, **options)
            if len(found) != 1:
                raise ConfigError(
                    f"one capture takes the place of {supersedes}, {len(found)} were found: name one",
                    code="many_captures",
                )
            with at_work(self.store, "ingest"):
                capture = found[0].read()
                done = supersede(self.store, capture, supersedes, self.settings, self._progress, named=name is not None)
            return Table([reports.ingest_row(done.scene, new=True, dated=False, notes=(*capture.notes, *done.notes))])

        added = ingest(self.store, captures, progress=self._progress, **options)
        return Table(reports.ingest_row(one.scene, new=one.new, dated=one.dated, notes=one.notes) for one in added)

    def describe(self, *scenes: str) -> Table[GraphRow]:
        """The scene graph of every scene, made where the present recipe has not made it yet.

        Args:
            scenes: only these; and where their graph is damaged it is made again.
        """
        from gsmap.map.stages.describe import describe, unthinned

        wanted = [self.store.scenes.get(ref) for ref in scenes] or unthinned(self.scenes())
        with at_work(self.store, "describe"):
            keys = describe(self.store, wanted, self.settings, self._progress, verify=bool(scenes))
        return Table(reports.graph_row(self.store, scene, keys[scene.id]) for scene in wanted if scene.id in keys)

    def register(self, pairs: Pairs = "auto") -> Table[EdgeRow]:
        """Register pairs of described scenes.

        Args:
            pairs: ``auto`` (candidates that this recipe has not registered yet), ``all``, one pair ``A:B``, a `Path` of
                a file with a pair a line, or pairs of scenes; pairs that are named are registered again.
        """
        from gsmap.map.stages.register import register

        with at_work(self.store, "register"):
            made = register(self.store, pairs, self.settings, self._progress)
        return Table(reports.rows_of_edges(self.store, made))

    def add_edge(self, pair: str, S_target_source: Sim3, sigmas: np.ndarray, note: str = "") -> EdgeRow:
        """Keep a measurement of your own of how scene B lies in scene A of ``A:B``; the next optimize uses it.

        Args:
            sigmas: (7,) standard deviations [rot_rad (3), trans (3), log_scale], on the source side and in its unit.
        """
        from gsmap.map.stages.register import add_edge

        a, b = self._pair(pair)
        add_edge(self.store, a, b, S_target_source, sigmas, note)
        return reports.edge_row(self.store, a, b)

    def confirm(self, what: str, note: str = "", *, withdraw: bool = False) -> EdgeRow | ChangeRow:
        """Vouch for the edge of a pair ``A:B``: it is used whatever the votes say; or for a change (``c12``).

        Args:
            withdraw: take the last review back.
        """
        return self._review(what, "withdraw" if withdraw else "confirm", note)

    def reject(self, what: str, note: str = "", *, withdraw: bool = False) -> EdgeRow | ChangeRow:
        """Rule out the edge of a pair ``A:B``, or a change (``c12``) that is none; see `confirm`."""
        return self._review(what, "withdraw" if withdraw else "reject", note)

    def _review(self, what: str, review: str, note: str) -> EdgeRow | ChangeRow:
        from gsmap.map import changes

        if (number := changes.number_of(what)) is not None:
            self.store.changes.review(number, review, note)
            return changes.change_row(self.store, self._settings_to_look_by(), number)
        a, b = self._pair(what)
        self.store.registrations.review(a.id, b.id, review, note)
        return reports.edge_row(self.store, a, b)

    def _pair(self, pair: str) -> tuple[Scene, Scene]:
        return reports.pair_of(self.store, pair)

    def optimize(self) -> RevisionRow:
        """Solve for all scene poses and keep the answer as a new revision."""
        from gsmap.map.stages.optimize import optimize

        with at_work(self.store, "optimize"):
            number = optimize(self.store, self.settings, self._progress)
        return reports.revision_row(self.store, number)

    def update(self, *captures: str | os.PathLike[str], captured_at: str | None = None) -> UpdateReport:
        """Ingest the captures, then describe, register and optimize whatever is missing; says what that changed.

        Args:
            captured_at: as in `ingest`.
        """
        from gsmap.map.stages.describe import describe, unthinned
        from gsmap.map.stages.optimize import solve
        from gsmap.map.stages.register import Known, register

        if captured_at is not None and not captures:
            raise ConfigError(
                "captured-at is of captures: name their files, or correct a scene with gsmap edit",
                code="option_not_applicable",
            )
        before = reports.mark(self.store)
        with at_work(self.store, "update"):
            ingested = self.ingest(*captures, captured_at=captured_at) if captures else []
            describe(self.store, unthinned(self.store.scenes.brief()), self.settings, self._progress)
            known = Known()
            register(self.store, "auto", self.settings, self._progress, known)
            # Poses may tell of new neighbours, and their edges of new poses.
            while solve(self.store, self.settings, self._progress):
                if not register(self.store, "auto", self.settings, self._progress, known):
                    break
        return reports.update_report(self.store, ingested, before, self.metres)

    def set_prior(self, prior: Prior) -> PriorRow | None:
        """Tell where a scene lies (GPS, survey, an anchor), in place of what was told before; see `Prior`.

        Raises:
            InputError: what `optimize` could not use; nothing is noted.
        """
        from gsmap.optimize.measurements import check_priors

        check_priors([prior.scene], [prior])
        self.store.priors.set(prior)
        return reports.prior_row(self.store, self.store.scenes.get(prior.scene))

    def remove_prior(self, scene: str) -> None:
        """Take back what was told of where a scene lies: in the world, where that was told last, else in the map."""
        from gsmap.map.stages.georeference import forget_position

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
        """What changed from each capture to those that were taken of the same places just before it.

        What has not been compared under these settings and at these poses is compared first, unless the map is open for
        reading only.

        Args:
            pair: only the two captures of ``A:B``; damaged arrays of theirs are made again.
            since: only where the newer capture is dated after this, ISO 8601.
            between: two dates: only where the newer capture is dated after the first, at or before the second.
            as_of: only where it is dated at or before this.
            min_confidence: only changes that are at least as sure.
            pictures: a folder to draw each change in, before and after; an empty or new one, or one of this map.

        Raises:
            NotFoundError: the map has no poses yet, or no such scene.
            InputError: of the two captures that are named, nobody knows which is newer.
        """
        from gsmap.map.changes import changes_report, within
        from gsmap.map.stages.change import compare, wanted

        asked = wanted(self.store, self.settings, None if pair is None else self._pair(pair))
        asked = within(asked, since, between, as_of)
        if self.store.catalog.writable:
            with at_work(self.store, "changes"):
                compare(self.store, asked, self.settings, self._progress, verify=pair is not None)
        report = changes_report(self.store, self.settings, asked, min_confidence=min_confidence)
        if pictures is None:
            return report
        from gsmap.map.pictures import draw

        files = draw(self.store, Path(pictures), report.changes, self.settings, self._progress)
        return replace(report, changes=tuple(replace(row, picture=files.get(row.id)) for row in report.changes))

    def show_change(self, name: str) -> ChangeDetail:
        """``gsmap show MAP c12``: everything known of one change.

        Raises:
            NotFoundError: no change is called so, or it is no longer found.
        """
        from gsmap.map import changes

        return changes.change_detail(self.store, self._settings_to_look_by(), changes.named(name))

    def read_change(self, name: str) -> Change:
        """A change (``c12``) with its arrays, map frame: voxels, and rows of the Gaussians of either capture.

        Raises:
            NotFoundError: no change is called so, it is no longer found, or has no place now.
        """
        from gsmap.map import changes

        return changes.change_arrays(self.store, changes.named(name))

    # --- objects -----------------------------------------------------------------------------------------------------

    def objects(self) -> ObjectsReport:
        """``gsmap graph MAP``: things of all captures as objects of the map, and how they stand to each other.

        Raises:
            NotFoundError: the map has no poses yet.
        """
        from gsmap.map.objects import known_objects, objects_report

        return objects_report(known_objects(self.store, self.settings, self._progress))

    def graph(self) -> Any:
        """The same as a `networkx.MultiDiGraph` (see `gsmap.objects.object_graph`)."""
        from gsmap.map.objects import as_networkx, known_objects

        return as_networkx(known_objects(self.store, self.settings, self._progress))

    def write_graph(self, out: str | os.PathLike[str], format: str = "json") -> ObjectsReport:
        """Write the same as ``json`` or ``graphml``, whole or not at all."""
        from gsmap.map.objects import known_objects, objects_report, write_graph

        known = known_objects(self.store, self.settings, self._progress)
        write_graph(known, out, format)
        return objects_report(known)

    def history(self, place: str | None = None, *, box: Sequence[float] | None = None) -> HistoryReport:
        """What stood at a place, when it was seen, and when it was gone.

        Args:
            place: an object by its id or name, or a point ``X,Y,Z`` of the map.
            box: six numbers, its lowest and highest corner.

        Raises:
            ConfigError: not one place.
            NotFoundError: no such object, or the map has no poses yet.
        """
        from gsmap.map.objects import history_report, known_objects

        return history_report(known_objects(self.store, self.settings, self._progress), place, box)

    def is_object(self, ref: str) -> bool:
        """Whether a text names an object (``o12``) and no scene."""
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
        """``gsmap edit MAP o12``: what people call an object; what was said before stays in its history.

        Args:
            ref: its id or its name.
            name: no other object's; ``none`` takes it back.
            label: what kind of thing it is; ``none`` takes it back.
            note: added to those that there are.
            same_as: the object that it is one with, which is told for both from then on; ``none`` takes that back.
            author: who says so.

        Raises:
            NotFoundError: no such object.
            InputError: a name that is taken, or two that a capture shows apart; nothing is written.
        """
        from gsmap.map.objects import edit_object

        words = {"name": name, "label": label, "note": note, "same_as": same_as}
        return edit_object(self.store, self.settings, ref, self._progress, author=author, **words)

    # --- localize ----------------------------------------------------------------------------------------------------

    def localize(
        self,
        *files: str | os.PathLike[str],
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
        """``gsmap localize MAP FILE...``: where photographs were taken and scans lie, or why that is not said.

        What views are found by is made for every scene that lacks it, and kept unless the map is read-only.

        Args:
            intrinsics: ``fx fy cx cy`` of all photos, in pixels of the upright picture.
            focal: focal length in pixels, or ``auto`` to solve for it; by default what the file says (EXIF).
            near: only what this scene shows, or ``X,Y,Z,R`` around a point of the map.
            together: the photos show one place and overlap: whoever is placed helps the others.
            video: a clip, whose sharpest frames are photos of one place; needs the extra ``video``.
            masks: a folder with a mask of each photo, black where it does not count (people, cars, the own hand): of
                ``photo.jpg`` it is ``photo.jpg.png``.
            depth, depth_scale: a depth picture of the view of the one photo given, and its values that make a metre.
            changes: say where a placed photo shows something else than the map; ``pictures`` draws it in a folder.
            add: keep placed photos as evidence of what stood there, dated by ``captured_at`` or their EXIF.

        Raises:
            NotFoundError: no such file or scene, or nothing in the map has a place.
            InputError: a file is neither a picture nor a scan.
            ConfigError: what is said of the lens or the place makes no sense.
        """
        from gsmap.map.localizing import Tells, localize_files

        with at_work(self.store, "localize"):
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
                tells=Tells(changes, pictures, add, captured_at),
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
        """``gsmap find MAP``: places that are like what is asked for, best first; nothing is kept.

        Args:
            text: words; the map's image encoder needs a text tower.
            picture: a file that shows such a thing.
            like: an object's id, or ``SCENE:NODE``, a row of a scene's layer of objects.
            at: (3,) a point of the frame of component 0.
            top: how many hits at most.
            pictures: a folder to draw each hit in; an empty or new one, or one of this map.

        Raises:
            NotFoundError: no poses yet, or no such scene, node, object, or thing at the point.
            ConfigError: not one thing to look for, or words or a picture that the embedder cannot read.
        """
        from gsmap.map.finding import Request, find_places, with_pictures

        request = Request(text, picture, like, at, top)
        report, boxes = find_places(self.store, request, self.settings, self._progress)
        if pictures is None:
            return report
        return with_pictures(self.store, report, boxes, Path(pictures), self.settings, self._progress)

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
        """Where a point cloud, mesh, splat or depth picture lies in the map; nothing of it is kept.

        Args:
            file: ``.ply .pcd .xyz .las .laz .obj .stl .glb``, any splat, or (with ``intrinsics``) a depth picture.
            intrinsics: ``fx, fy, cx, cy`` of a depth picture, pixels.
            colour: a picture aligned with the depth picture.
            depth_scale: values of the depth picture that make a metre.
            scale: ``known`` (the file is in metres), ``unknown`` or ``auto``; by default ``known``, but for splats,
                ``.obj`` and ``.stl``, whose unit nobody knows: ``auto``.
            near: only scenes near one (its name), or near ``X,Y,Z,R``, a ball in the frame of component 0.

        Raises:
            NotFoundError: no such file, or the map has no poses yet.
            InputError, ConfigError, MissingDependencyError: see `gsmap.formats.scans`.
        """
        from gsmap.map.stages.localize_scan import Request, localize_scan

        request = Request(Path(file), intrinsics, colour, depth_scale, scale, near)
        return localize_scan(self.store, request, self.settings, self._progress)

    # --- export ------------------------------------------------------------------------------------------------------

    def export(
        self,
        out: str | os.PathLike[str],
        *,
        format: str = "ply",
        tile_size_m: float = 10.0,
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
        wait: bool = False,
    ) -> ExportReport:
        """Write merged tiles to a folder; only those that changed since it was last exported to are made.

        Args:
            format: suffix of the tiles' files, or a tree of levels: ``3dtiles`` or ``streamed-sog``.
            tile_size_m: edge of a tile; 0 is one file per component.
            bbox: ``x0 y0 z0 x1 y1 z1`` only this box of the map, in its unit, as poses are.
            merge: ``tto``, ``voxel``, ``union``, ``distance``, or one that another package adds; by default what the
                setting ``merge.method`` says.
            revision: poses of this revision, the newest by default.
            component: only this component.
            steps: optimisation steps per tile; chosen from its size by default.
            budget_s: ceiling in wall seconds per tile; a tile that it cuts short is marked ``truncated``.
            provenance: add the property ``scene`` to ``.ply`` files.
            uncompressed: the content of ``3dtiles`` as float32, for viewers that do not read SPZ in glTF.
            prefer: whom to believe where captures disagree: ``newest``, ``best`` (whoever saw it best) or ``both``; by
                default what the merger's settings say.
            as_of: only captures dated at or before this (ISO 8601; of a day, its end) take part, those without a date
                left out; poses are those of the revision all the same.
            static: only what persists: without things that moved, or that a look at their place did not show; what was
                looked at once is kept. Visits that were not compared are compared first.
            wait: where another export is at work in the folder, until it has ended.

        Raises:
            BusyError: another export is at work in the folder; it is named.
            ConfigError, InputError, StoreError: see `gsmap.export`; no half-written tile is left.
        """
        from gsmap.map.stages.export import Request, export

        request = Request(
            format=format,
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
        )

        def progress(fraction: float, text: str) -> None:
            self._progress("export", fraction, text)

        known, told = self.what_stays() if static else (None, ())
        made, notes = export(self.store, Path(out), request, self.settings, progress, wait=wait, known=known)
        return reports.export_report(self.store, Path(out), made, (*told, *notes))

    def what_stays(self) -> tuple[Known, tuple[str, ...]]:
        """The objects of the map after all visits were compared, and who takes no part in that."""
        from gsmap.map.objects import known_objects
        from gsmap.map.stages.change import compare, lacking, wanted

        asked = wanted(self.store, self.settings)
        told = asked.notes
        if self.store.catalog.writable:
            with at_work(self.store, "changes"):
                compare(self.store, asked, self.settings, self._progress)
        elif missing := len(lacking(self.store, asked, self.settings)):
            told += (f"{missing} pairs of visits are not compared, and the map is open for reading only",)
        return known_objects(self.store, self.settings, self._progress), told

    def export_small(self, out: str | os.PathLike[str], budget_bytes: int, *, static: bool = False) -> SmallMapReport:
        """``gsmap export MAP OUT --for localize``: a small map by which photographs are placed, and no more.

        Args:
            static: only what persists, see `export`.

        Raises:
            StoreError: the folder is not empty.
            ConfigError: so few bytes that hardly a photograph would be found; how many it takes is said.
            NotFoundError: the map has no poses yet.
        """
        from gsmap.map.small_map import export_small

        known = self.what_stays()[0] if static else None
        with at_work(self.store, "export"):
            return export_small(self.store, Path(out), budget_bytes, self.settings, self._progress, known)

    def _repr_html_(self) -> str:
        return reports.map_html(self.store, self.status(), self.scene_rows())

    # --- look --------------------------------------------------------------------------------------------------------

    def scenes(self) -> list[Scene]:
        """The living scenes in the order they came."""
        return self.store.scenes.list()

    def metres(self, revision: int | None = None) -> dict[int, Metre]:
        """How long a metre is in the frame of each component of a revision, by default the newest."""
        return metres_at(self.store, self._settings_to_look_by(), revision)

    def pose_graph(self, revision: int | None = None) -> PoseGraph | None:
        """The poses of a revision, of the newest one by default; None before the first optimize."""
        return self.store.revisions.get(revision)

    def read(self, ref: str, *, frame: str = "scene") -> tuple[Gaussians, Cameras]:
        """Gaussians and cameras of one scene, in its own frame or in the ``map`` frame of its component.

        Raises:
            NotFoundError: no such scene, or no pose for it yet.
            ConfigError: another frame.
        """
        scene = self.store.scenes.get(ref)
        gaussians, cameras = self.store.scenes.gaussians(scene.id), self.store.scenes.cameras(scene.id)
        if frame == "scene":
            return gaussians, cameras
        if frame != "map":
            raise ConfigError(f"a scene is read in frame 'scene' or 'map', got {frame!r}", code="invalid_choice")
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
        """``gsmap list MAP scenes``: all, or those of one component or status, captured after a date or at or before
        one, or with a tag."""
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
        """``gsmap list MAP edges``: all, or those of one status, registered after a date, between scenes as asked."""
        chosen: dict[str, Any] = {"component": component, "status": status, "after": after, "tag": tag, "as_of": as_of}
        return Table(reports.edge_rows(self.store, **chosen))

    def revision_rows(self) -> Table[RevisionRow]:
        """``gsmap list MAP revisions``."""
        return Table(reports.revision_rows(self.store))

    def tile_rows(self) -> Table[TileRow]:
        """``gsmap list MAP tiles``."""
        return Table(reports.tile_rows(self.store))

    def model_rows(self) -> Table[ModelRow]:
        """``gsmap models list MAP``."""
        return Table(reports.model_rows(self.store))

    def pose_rows(self, crs: str | None = None) -> Table[PoseRow]:
        """``gsmap poses MAP``: where every placed scene lies, in the map and (``crs``, or the map's own) the world."""
        return Table(reports.pose_rows(self.store, crs))

    def status(self) -> MapStatus:
        """``gsmap status MAP``: what is missing, stale or wants a person, each with the verb that helps."""
        from gsmap.map.status import status

        return status(self.store, self.settings)

    def show_scene(self, ref: str) -> SceneReport:
        """``gsmap show MAP SCENE``: facts, nodes and edges of one scene."""
        scene = self.store.scenes.get(ref)
        return reports.scene_report(self.store, scene, *self._graph_of(scene), self.metres())

    def show_pair(self, pair: str) -> PairReport:
        """``gsmap show MAP A:B``: the pair's edge, its evidence, and its history."""
        return reports.pair_report(self.store, *self._pair(pair))

    def why(self, pair: str, *, pictures: str | os.PathLike[str] | None = None) -> WhyReport:
        """What was asked of a pair on the way from retrieval to its place in the map, and what would settle it.

        Args:
            pictures: a folder to draw both captures in, from the same cameras, under the pose that was found; an empty
                or new one, or one of this map.
        """
        from gsmap.map.why import why

        scenes = self._pair(pair)
        report = why(self.store, self.settings, *scenes)
        if pictures is None:
            return report
        from gsmap.map.pictures import draw_pair

        return replace(report, picture=draw_pair(self.store, Path(pictures), *scenes))

    def _graph_of(self, scene: Scene) -> tuple[SceneGraph | None, str]:
        """A scene's graph under the settings in force, else its newest one; and what is to be known of that choice."""
        from gsmap.map.stages.describe import graph_keys

        graph, note = None, "its graph was made by other settings or another version: run gsmap update"
        try:
            graph = self.store.graphs.load(scene.id, graph_keys(self.store, [scene], self.settings)[scene.id])
        except ConfigError as error:  # what is in the map can be looked at whatever the settings say
            note = f"its newest graph, since the map's settings cannot be read: {error}"
        if graph is not None:
            return graph, ""
        newest = self.store.graphs.load(scene.id)
        return newest, "" if newest is None else note

    def diff(self, before: int, after: int) -> Table[PoseChangeRow]:
        """``gsmap diff MAP R1 R2``: how far each scene moved between two revisions, measured at its middle."""
        return Table(reports.pose_change_rows(self.store, before, after, self._settings_to_look_by()))

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
        """``gsmap evaluate MAP``: edges and poses against ground truth, renders against the captures' own images.

        Args:
            truth: folder of ``NAME.json`` with ``T_scene_world`` (4x4), the world in metres.
            images: folder of photographs named like the cameras.
            tiles: folder that this map was exported to, to be compared with the photographs, too.
            lpips: an LPIPS network to compare photographs with, too.
            max_rre_deg, max_rte_m: an edge that is turned or off (at the source's middle) by more is wrong; by default
                what the settings ``evaluate.*`` say.
            truth_sigma: how exactly a scene's truth is known, standard deviations in degrees and metres; by default 0.

        Raises:
            ConfigError: tiles or a network without photographs to compare with, or bars that are not positive.
            NotFoundError, InputError: see `gsmap.map.evaluating`.
        """
        from gsmap.map import evaluating

        if images is None and (tiles is not None or lpips is not None):
            raise ConfigError(
                "tiles and LPIPS are of photographs: give the folder of images, too", code="missing_option"
            )
        params = self.settings.evaluate
        if max_rre_deg is not None:
            params = replace(params, max_rre_deg=max_rre_deg)
        if max_rte_m is not None:
            params = replace(params, max_rte_m=max_rte_m)
        if truth_sigma is not None:
            params = replace(params, truth_sigma_deg=truth_sigma[0], truth_sigma_m=truth_sigma[1])
        report = evaluating.poses(self.store, truth, params, self.metres())
        if images is None:
            return report
        rows = evaluating.images(
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
        """``gsmap view MAP``: a page that shows the map and lets a person judge it, served on this machine only until
        closed.

        Args:
            tiles: a folder that the map was exported to as 3D Tiles, shown beside the scenes.
            read_only: nothing can be changed from the page; nor can it where the map is open for reading.

        Raises:
            ConfigError: the port is taken, the page was not built, or that folder holds no 3D Tiles of this map.
        """
        from gsmap.map.viewing import MapDoors, cache_folder
        from gsmap.map.viewing_actions import actions_of
        from gsmap.view import ViewServer

        settings = self._settings_to_look_by()
        actions = {} if read_only or not self.store.catalog.writable else actions_of(self)
        doors = MapDoors(self.store, settings, actions, None if tiles is None else Path(tiles))
        return ViewServer(doors, cache_folder(), settings.view, port=port)

    def write_site(self, folder: str | os.PathLike[str], *, tiles: str | os.PathLike[str] | None = None) -> ViewReport:
        """``gsmap view MAP --export DIR``: the page as files that any web server can host.

        In a new folder it appears whole or not at all. ``gsmap-site.json`` lists its files; others are never touched.

        Args:
            folder: an empty or new one, or one that this map's page was written to before, the files of which are
                replaced, ``map.json`` and ``index.html`` last.
            tiles: as in `view`; they are copied.

        Raises:
            ConfigError: the folder holds something else, or a page of a gsmap that kept no list of its files; another
                file lies where one has to go; the page was not built; or ``tiles`` are not this map's.
        """
        from gsmap.map.viewing_site import write_site

        chosen = None if tiles is None else Path(tiles)
        return write_site(self.store, self._settings_to_look_by(), Path(folder), chosen, self._progress)

    def write_page(self, path: str | os.PathLike[str], *, megabytes: float = 20.0) -> ViewReport:
        """``gsmap export MAP OUT.html --format html``: the page with the map in it as one file, for a double click.

        Args:
            path: ends with ``.html``; a page or report of this map that is there is replaced.
            megabytes: of levels of detail, the finest that fit; the file is about a third larger, and a few more for
                the page itself.

        Raises:
            ConfigError: another file, or the page was not built.
            NotFoundError: no such folder.
        """
        from gsmap.map.viewing_site import write_page

        return write_page(self.store, self._settings_to_look_by(), Path(path), megabytes, self._progress)

    def report(self, path: str | os.PathLike[str], *, since: str | None = None, pictures: bool = True) -> WrittenReport:
        """``gsmap report MAP OUT.html``: one page that shows the map, what is doubtful and what to do; loads nothing.

        Args:
            path: a file that ends with ``.html``; a report that is there is replaced.
            since: tell what is new since this date, too, ISO 8601.
            pictures: draw doubtful pairs and changes.

        Raises:
            ConfigError: another file, or no date.
            NotFoundError: no such folder.
        """
        from gsmap.map.reporting import write_report

        return write_report(self.store, self._settings_to_look_by(), Path(path), since, pictures, self._progress)

    def draw_pair(self, pair: str, path: str | os.PathLike[str]) -> None:
        """``gsmap show MAP A:B --picture``: both captures from the same cameras, under the pose that was found.

        Raises:
            NotFoundError: no pose was found.
        """
        from gsmap.map.pictures import picture_of_pair, save_picture

        a, b = self._pair(pair)
        if (picture := picture_of_pair(self.store, a.id, b.id)) is None:
            raise NotFoundError(
                f"{a.name}:{b.name} has no pose to draw both captures in: gsmap why MAP A:B says why",
                code="no_pose_of_pair",
            )
        save_picture(picture, path)

    def draw_change(self, name: str, path: str | os.PathLike[str]) -> None:
        """``gsmap show MAP c12 --picture``: a change before and after.

        Raises:
            NotFoundError: no such change, or it has no place now.
        """
        from gsmap.map.pictures import picture_of_change, save_picture

        row = self.show_change(name)
        if (picture := picture_of_change(self.store, self._settings_to_look_by(), row)) is None:
            raise NotFoundError(
                f"{name} has no place now: its newer capture has none (gsmap update)", code="change_unplaced"
            )
        save_picture(picture, path)

    def draw_graph(self, ref: str, path: str | os.PathLike[str]) -> None:
        """``gsmap show MAP SCENE --picture``: the scene's graph over a render, for a person to judge."""
        from gsmap.map.pictures import save_picture
        from gsmap.view.graph_picture import draw_graph

        scene = self.store.scenes.get(ref)
        graph, _ = self._graph_of(scene)
        if graph is None:
            raise NotFoundError(
                f"scene {scene.name} has no graph: run gsmap describe MAP {scene.name!r} first", code="no_graph"
            )
        save_picture(draw_graph(*self.read(scene.id), graph), path)

    def write_poses(self, out: str | os.PathLike[str], format: str, crs: str | None = None) -> list[Path]:
        """``gsmap poses MAP OUT --format F``: poses for other programs (`gsmap.map.poses`); the files written."""
        from gsmap.map.poses import write_poses

        return write_poses(self.store, Path(out), format, crs, settings=self._settings_to_look_by())

    # --- the world ---------------------------------------------------------------------------------------------------

    def georeference(
        self,
        request: Request | None = None,
        *,
        remove: Sequence[str] | None = None,
        localise: Localise | None = None,
    ) -> WorldReport:
        """``gsmap georeference MAP``: note observations of the world, solve the poses with them, and say how they fit.

        Args:
            request: what to note (`gsmap.map.stages.georeference.Request`); None to look only.
            remove: names of observations to take back; an empty sequence takes back all, with the CRS.
            localise: places photos that are no scene's camera (`gsmap.map.placed_photos.localiser`).

        Raises:
            ConfigError, InputError, NotFoundError: see `gsmap.map.stages.georeference`; nothing is noted then.
        """
        from gsmap.map.stages.georeference import georeference, take_back
        from gsmap.map.stages.optimize import is_solved, solve

        notes: tuple[str, ...] = ()
        if request is not None or remove is not None:
            with at_work(self.store, "georeference"):
                if remove is not None:
                    notes = (f"{take_back(self.store, remove)} observations were taken back",)
                solution = None
                if request is not None:
                    told, solution = georeference(self.store, request, self.settings, localise)
                    notes += told
                solve(self.store, self.settings, self._progress, solution)
        return reports.world_report(self.store, stale=not is_solved(self.store, self.settings), notes=notes)

    def set_world_position(
        self, scene: str, position: Sequence[float], sigma_m: tuple[float, float], crs: str = "EPSG:4326"
    ) -> None:
        """``gsmap prior MAP SCENE --latitude ...``: where the origin of a scene's frame lies in the world.

        Args:
            position: (3,) longitude or easting first, then latitude or northing, then height.
            sigma_m: horizontal and vertical standard deviations.
        """
        from gsmap.map.stages.georeference import survey_position

        survey_position(self.store, scene, position, crs, sigma_m, self.settings)

    def measure(self, a: str, b: str, *, component: int | None = None, crs: str | None = None) -> MeasureReport:
        """``gsmap measure MAP A B``: how far two points are apart in metres, and how well that is known.

        Args:
            a, b: ``X,Y,Z`` (map), ``SCENE:X,Y,Z``, ``SCENE:CAMERA@COLUMN,ROW`` or ``world:X,Y,Z``.
            component: of points given in the map, where it has several.
            crs: of the world coordinates shown; the map's own by default.
        """
        from gsmap.map.measuring import measure

        return measure(self.store, a, b, self.settings, component=component, crs=crs)

    # --- upkeep ------------------------------------------------------------------------------------------------------

    def edit(
        self,
        ref: str,
        *,
        name: str | None = None,
        captured_at: str | None = None,
        note: str | None = None,
        tags: Sequence[str] = (),
        untag: Sequence[str] = (),
        metres_per_unit: float | None = None,
        author: str = "",
    ) -> SceneRow:
        """``gsmap edit MAP SCENE``: a scene's name, date, notes and tags; what was said before stays in its history.

        Args:
            captured_at: ISO 8601, UTC where it has no zone; ``none`` takes the date back.
            metres_per_unit: of the scene's own frame; 0 takes it back.
            author: who says so.
        """
        from gsmap.ingest import given_date

        if captured_at is not None:
            captured_at = "" if captured_at.strip().lower() == "none" else given_date(captured_at).when
        scene = self.store.scenes.edit(
            ref,
            name=name,
            captured_at=captured_at,
            note=note,
            tags_add=tuple(tags),
            tags_remove=tuple(untag),
            metres_per_unit=metres_per_unit,
            author=author,
        )
        return reports.scene_row(self.store, scene, self.metres())

    def photo_rows(self) -> list[PhotoRow]:
        """``gsmap list MAP photos``: the photographs that the map keeps, oldest first, by the newest poses."""
        from gsmap.map.photos import photo_rows

        return photo_rows(self.store)

    def remove_photo(self, which: str) -> PhotoRow:
        """``gsmap remove MAP PHOTO --photo``: take back a photograph that is kept, by file, number (``p3``) or digest.

        Raises:
            NotFoundError: none is called so, or several.
        """
        number = self.store.photos.find(which).number
        row = next(row for row in self.photo_rows() if row.id == f"p{number}")
        self.store.photos.remove(number)
        return row

    def remove(self, ref: str) -> SceneRow:
        """Take a scene out; older revisions keep it."""
        row = reports.scene_row(self.store, self.store.scenes.get(ref), self.metres())
        self.store.scenes.remove(ref)
        return row

    def branch(self, name: str) -> BranchRow:
        """``gsmap branch MAP NAME``: another catalog over the same arrays; `open` it as ``MAP@NAME``."""
        return as_values.branch_row(self.store.branches.make(name))

    def tag(self, name: str) -> BranchRow:
        """``gsmap tag MAP NAME``: the map as it is now, which cannot change; `open` it as ``MAP@NAME``."""
        return as_values.branch_row(self.store.branches.make(name, tag=True))

    def branches(self, kind: str | None = None) -> Table[BranchRow]:
        """The map's branches and tags, or those of one kind (``branch``, ``tag``)."""
        rows = [as_values.branch_row(branch) for branch in self.store.branches.list()]
        return Table(row for row in rows if kind in (None, row.kind))

    def delete_branch(self, name: str, kind: str | None = None) -> BranchRow:
        """``gsmap branch MAP NAME --delete``: forget a branch or tag; what only it named is reclaimed by `prune`.

        Raises:
            NotFoundError: none of that kind is called so.
        """
        row = as_values.branch_row(self.store.branches.get(name))
        if kind not in (None, row.kind):
            raise NotFoundError(
                f"{name} is a {row.kind}: gsmap {row.kind} {self.store.home} {name} --delete",
                code="wrong_reference_kind",
            )
        self.store.branches.delete(name)
        return row

    def merge(self, source: str | os.PathLike[str]) -> MergeReport:
        """``gsmap merge MAP SOURCE``: take all that another map, branch or tag knows; nothing is computed."""
        return as_values.merge(self.store, source)

    def split(
        self,
        out: str | os.PathLike[str],
        *,
        island: int | None = None,
        box: Sequence[float] | None = None,
        scenes: Sequence[str] | None = None,
    ) -> SplitReport:
        """``gsmap split MAP OUT``: a new map of some scenes, with all that is known of and among them.

        Args:
            island: those of this component.
            box: ``x0 y0 z0 x1 y1 z1``, those that reach into it, in the frame of that component, else of component 0.
            scenes: those of these names.
        """
        return as_values.split(self.store, out, as_values.chosen(self.store, island, box, scenes))

    def purge(self, ref: str, *, branches: bool = False) -> PurgeReport:
        """``gsmap remove MAP SCENE --purge``: forget a scene for good: rows, arrays, tiles that were made with it.

        Args:
            branches: in the map's other branches and tags, too; else they are told of.
        """
        from gsmap.map.stages.purge import purge

        return as_values.purge_report(purge(self.store, ref, branches=branches))

    def restore_scene(self, ref: str, source: str | os.PathLike[str] | None = None) -> SceneRow:
        """``gsmap restore-scene MAP SCENE``: bring back a removed scene, or (``source``) take one of another map.

        With ``source``, arrays of it that are here and damaged are mended.
        """
        return reports.scene_row(self.store, as_values.restore_scene(self.store, ref, source), self.metres())

    def check(self) -> CheckReport:
        """Read every byte of the map and compare it with what was written."""
        return reports.check_report(self.store.check(lambda f, text: self._progress("check", f, text)))

    def prune(self, keep_revisions: int | None = None, *, dry_run: bool = False) -> PruneReport:
        """Delete leftovers of interrupted work and what none of the newest ``keep_revisions`` (None: all) names."""
        return reports.prune_report(self.store.prune(keep_revisions=keep_revisions, dry_run=dry_run), dry_run)

    def thin(
        self,
        *,
        keep_days: float | None = None,
        budget_bytes: int | None = None,
        dry_run: bool = False,
        now: str | None = None,
    ) -> ThinReport:
        """``gsmap thin MAP``: keep captures compact that newer ones supersede, the oldest first, and free the rest.

        Args:
            keep_days: what was captured in so many days before ``now`` stays as it is.
            budget_bytes: thin no more than it takes for the arrays of living scenes to fit.
            now: ISO 8601; None for the present.
        """
        from gsmap.map.stages.thin import Request, thin

        with at_work(self.store, "thin"):
            return thin(self.store, Request(keep_days, budget_bytes, dry_run, now), self.settings, self._progress)

    def backup(self, target: str | os.PathLike[str], *, verify: bool = False, keep: int | None = None) -> BackupReport:
        """``gsmap backup MAP DEST``: save the map as it is now, while others go on; only what is new is sent.

        Args:
            target: a folder, ``file:///folder`` or ``s3://bucket/prefix``; of this map alone.
            verify: read again what is there, and send again what is damaged.
            keep: delete all but this many of the newest snapshots, and what only they needed.
        """
        from gsmap.map import backing

        told = self._progress
        return backing.save(
            self.store, target, verify=verify, keep=keep, progress=lambda f, text: told("backup", f, text)
        )

    def clone(self, path: str | os.PathLike[str]) -> CloneReport:
        """``gsmap clone MAP NEW``: another map, of its own id, that begins with what this one holds now."""
        from gsmap.map import backing

        return backing.clone(self.store, path, lambda f, text: self._progress("clone", f, text))

    def add_model(self, kind: str, path: str | os.PathLike[str], *, preset: str = "clip", copy: bool = True) -> None:
        """Register an ONNX model: checked, then copied (or referenced) and used by every later describe."""
        from gsmap.map import models

        models.add(self.store, kind, path, preset, copy, self.settings.describe.object.limits)
