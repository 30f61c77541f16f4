"""Small maps for localization only: a folder with ``localize.json`` and one file per scene.

What is in it: of every scene that has a place its pose, metre, name and date, features of its views, and its Gaussians
merged to fewer, both rounded. It is no map: nothing can be added to it, and no other verb opens it.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import (
    is_file,
    open_file,
    remove_empty_folder,
    remove_file,
    staged_folder,
    sync_file,
    sync_folder,
    write_owned,
)
from gsmap.errors import MALFORMED, ConfigError, CorruptError, GsmapError, InputError, NotFoundError, StoreError
from gsmap.export.levels import Params as LevelParams
from gsmap.export.levels import make_level
from gsmap.formats.quantise import check_size
from gsmap.geometry.metric_scale import in_metres
from gsmap.localize import (
    MapScene,
    ViewIndex,
    new_segment,
    packed_features,
    packed_gaussians,
    reduction,
    view_index,
)
from gsmap.localize.features import INDEXED_FEATURES
from gsmap.map.changes.compare import standing_comparisons
from gsmap.map.localization.localize import Localizer, SearchRegion
from gsmap.map.objects.map_objects import MapObjects
from gsmap.map.objects.static_filter import DynamicContent, find_dynamic_content
from gsmap.map.outputs import Output, note_target
from gsmap.map.settings import Settings, settings_of
from gsmap.methods import family
from gsmap.store import Store
from gsmap.store.change_rows import Comparison
from gsmap.store.error_translation import translate_errors
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap.types.localization import SceneFeatures
from gsmap.types.progress import StageProgress
from gsmap.types.rows.exports import SmallMapReport, SmallSceneRow

_log = logging.getLogger("gsmap.map")
FILE_NAME = "localize.json"
_FORMAT, _VERSION = "gsmap small map", 2
_MAX_JSON, _MAX_SCENE = 1 << 25, 1 << 31
_BAD_ZIP = (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, RuntimeError)
_HEADER_BYTES = 1500  # of a scene in localize.json, about
_ROUNDS = 3
_DEVIATION_PX = 4.0  # of merged Gaussians in the pictures that they are fitted to: as sharp as photographs ask for
_COARSE = (0.5, 0.7, 1.0, 1.25, 1.5)  # steps that Gaussians are rounded to, before any is merged: `packed_gaussians`
_SPARSER = 0.11  # of N Gaussians merged to n each takes (N / n) ** 0.11 times the bytes: neighbours are less alike


@dataclass(frozen=True, eq=False)
class SmallMapScene:
    """The metadata of a scene in a small map.

    Args:
        id, name, captured_at: as in the map.
        component: component of ``S_map_scene``.
        covariance: (7, 7) covariance of that pose, or None.
        bounds: (2, 3) box of its Gaussians, scene frame.
        sha256: digest of its file.
    """

    id: str
    name: str
    captured_at: str | None
    component: int
    S_map_scene: Sim3
    covariance: np.ndarray | None
    bounds: np.ndarray
    sha256: str


# --- made ------------------------------------------------------------------------------------------------------------


def export_small(
    store: Store,
    out: Path,
    budget_bytes: int,
    settings: Settings,
    progress: StageProgress,
    known: MapObjects | None = None,
) -> SmallMapReport:
    """Write a small map; after an error, no partial map remains.

    Args:
        budget_bytes: maximum size of all files together.
        known: objects of the map, to leave out dynamic content; default: leave out what changes show to be gone.

    Raises:
        StoreError: the folder is not empty.
        ConfigError: with so few bytes hardly a photograph would be found; how many it takes is said.
        NotFoundError: the map has no poses yet.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} exists: choose another name", code="already_exists")
    if settings.localize.extractor != "sift":
        raise ConfigError(
            "a small map cannot contain a model: export it with the built-in features (--set localize.extractor=sift)",
            code="small_map_extractor",
        )
    localizer = Localizer(store, settings, progress)
    scenes = sorted(localizer.placed)
    standing = standing_comparisons(store, settings)
    passing = {} if known is None else find_dynamic_content(store, known, standing)
    wanted: dict[str, int] = {}
    shown: dict[str, int] = {}
    for number, scene in enumerate(scenes):
        progress("export", 0.4 * number / len(scenes), f"what of {localizer.scenes[scene].name} shows")
        whole = _scene_content(localizer, scene, passing.get(scene), standing)
        wanted[scene], shown[scene] = whole.num_bytes, len(whole.gaussians)
    free = budget_bytes - _HEADER_BYTES * len(scenes) - 500
    factor = free / max(sum(wanted.values()), 1)
    files: dict[str, bytes] = {}
    rows: list[SmallSceneRow] = []
    total = 0
    for _ in range(_ROUNDS):
        files, rows = {}, []
        for number, scene in enumerate(scenes):
            progress("export", 0.4 + 0.5 * number / len(scenes), f"packing {localizer.scenes[scene].name}")
            whole = _scene_content(localizer, scene, passing.get(scene), standing)
            content, row = _packed(localizer, whole, factor * wanted[scene])
            files[scene] = content
            rows.append(row)
        total = sum(map(len, files.values())) + _HEADER_BYTES * len(scenes) + 500
        if total <= budget_bytes:
            break
        factor *= 0.97 * free / max(total - (budget_bytes - free), 1)
    _require_enough(rows, shown, budget_bytes, total)
    header = _header(store, localizer, files)
    out.parent.mkdir(parents=True, exist_ok=True)
    if (refused := note_target(store, out, {"small_map": True})) is not None:
        _log.warning("%s: the folder is not recorded in the map, so a purge will not find this small map", refused)
    with translate_errors(out, "no small map was made"), staged_folder(out.absolute(), store.id) as staged:
        for name, content in (*((f"{scene}.npz", files[scene]) for scene in scenes), (FILE_NAME, header)):
            (staged / name).write_bytes(content)
            sync_file(staged / name)
        if out.exists():
            out.rmdir()
        os.rename(staged, out)
        sync_folder(out.absolute().parent)
    num_bytes = sum(map(len, files.values())) + len(header)
    progress("export", 1.0, f"{num_bytes / 1e6:.2f} MB")
    return SmallMapReport(out=os.fspath(out), scenes=tuple(rows), num_bytes=num_bytes, budget_bytes=budget_bytes)


@dataclass(frozen=True, eq=False)
class _SceneContent:
    """The content of a scene that a small map may store.

    Args:
        scene: scene id.
        features: features of its views.
        gaussians: Gaussians visible in its own images, each of one colour.
        cameras: cameras of these images; None if the scene has none.
        first: number of features per view that retrieval uses.
    """

    scene: str
    features: SceneFeatures
    gaussians: Gaussians
    cameras: Cameras | None
    first: int

    @property
    def step(self) -> float:
        return packed_gaussians.place_step(self.gaussians)

    @property
    def num_bytes(self) -> int:
        """Packed size in bytes, before coarser rounding."""
        features = packed_features.pack(self.features, self.step, self.first)
        return len(_npz(features)) + len(_npz(packed_gaussians.pack(self.gaussians)))


def _scene_content(
    localizer: Localizer, scene: str, passing: DynamicContent | None, standing: Sequence[Comparison]
) -> _SceneContent:
    """Return the content of a scene that a small map may store.

    Args:
        passing: dynamic content to leave out; None leaves out what changes show to be gone.
        standing: the comparisons that hold.
    """
    store, placed = localizer.store, localizer.placed[scene]
    held = store.scenes.cameras(scene)
    own = None if held is None or held.synthesised else held
    features = placed.features
    if passing is None:
        gone = _removed(store, scene, standing)
    else:
        gone = passing.rows(store, scene)
        features = reduction.remove_features(features, placed.gaussians.means, gone)
    weights, coloured = reduction.measure_visibility(placed, own)
    kept = coloured[np.flatnonzero((weights >= reduction.MIN_BLENDING_WEIGHT) & ~np.asarray(gone))]
    placed.drop()
    return _SceneContent(scene, features, kept, own, INDEXED_FEATURES)


def _removed(store: Store, scene: str, standing: Sequence[Comparison]) -> np.ndarray | bool:
    """Return a mask that is True for Gaussians that disappeared in later changes; all False without comparisons."""
    out: np.ndarray | bool = False
    for comparison in standing:
        if comparison.older != scene or not comparison.changes:
            continue
        found = store.changes.load(comparison.number).changes
        for change, kept in zip(found, comparison.changes, strict=True):
            if kept.status != "rejected" and kept.kind in ("disappeared", "moved", "replaced"):
                if out is False:
                    out = np.zeros(store.scenes.get(scene).num_gaussians, bool)
                out[change.before] = True  # type: ignore[index]
    return out


def _packed(localizer: Localizer, whole: _SceneContent, num_bytes: float) -> tuple[bytes, SmallSceneRow]:
    """Pack a scene in about ``num_bytes``: first round values more coarsely, then merge Gaussians."""
    shown = whole.gaussians
    all_features = _npz(packed_features.pack(whole.features, whole.step, whole.first))
    part = reduction.FEATURES_FRACTION * num_bytes / len(all_features)
    kept = reduction.limit_features(whole.features, int(part * whole.features.num_features))
    arrays = packed_features.pack(kept, whole.step, whole.first)
    free = max(num_bytes - len(_npz(arrays)), 1)
    for coarse in _COARSE:
        packed = packed_gaussians.pack(shown, coarse)
        taken = len(_npz(packed))
        if taken <= free:
            break
    else:
        count = max(int(len(shown) * (free / taken) ** (1 / (1 - _SPARSER))), 1)
        views = reduction.REFINE_VIEWS if count < reduction.REFINE_BELOW_FRACTION * len(shown) else 0
        told = LevelParams(views=views, steps=reduction.REFINE_STEPS)
        shown = make_level(shown, count, whole.cameras, told, deviation_px=_DEVIATION_PX).gaussians
        packed = packed_gaussians.pack(shown, coarse)
    content = _npz(arrays | packed)
    about = localizer.scenes[whole.scene]
    row = SmallSceneRow(
        scene=whole.scene,
        scene_name=about.name,
        num_views=kept.num_views,
        num_features=kept.num_features,
        features_of=whole.features.num_features,
        num_gaussians=len(shown),
        gaussians_of=about.num_gaussians,
        num_bytes=len(content),
    )
    return content, row


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    made = io.BytesIO()
    np.savez_compressed(made, **arrays)  # type: ignore[arg-type]
    return made.getvalue()


def _require_enough(rows: Sequence[SmallSceneRow], shown: Mapping[str, int], budget: int, total: int) -> None:
    for row in rows:
        per_view = min(row.num_features, row.features_of) / max(row.num_views, 1)
        whole = row.features_of / max(row.num_views, 1)
        part = row.num_gaussians / max(shown[row.scene], 1)
        lacks = max(
            min(reduction.MIN_FEATURES, whole) / max(per_view, 1e-9),
            reduction.MIN_GAUSSIANS_FRACTION / max(part, 1e-9),
            total / budget,
        )
        if lacks > 1:
            need = budget * lacks * 1.1
            raise ConfigError(
                f"{budget / 1e6:.2f} MB are too few for {len(rows)} scenes: {row.scene_name} would keep "
                f"{per_view:.0f} features a view and {part:.0%} of the Gaussians that show, by which hardly a "
                f"photograph would be found; give about {need / 1e6:.1f} MB",
                code="small_map_budget",
            )


def _header(store: Store, localizer: Localizer, files: Mapping[str, bytes]) -> bytes:
    import hashlib

    poses = store.revisions.poses()
    scenes = []
    for scene, content in files.items():
        pose, about = poses[scene], localizer.scenes[scene]
        scenes.append(
            {
                "id": scene,
                "name": about.name,
                "captured_at": about.captured_at,
                "component": pose.component,
                "S_map_scene": pose.S_map_scene.matrix().tolist(),
                "covariance": None if pose.covariance is None else np.asarray(pose.covariance).tolist(),
                "bounds": np.asarray(about.bounds).tolist(),
                "sha256": hashlib.sha256(content).hexdigest(),
            }
        )
    told = {
        "format": _FORMAT,
        "version": _VERSION,
        "map_id": store.id,
        "metres_per_unit": {str(component): value for component, value in localizer.metres.items()},
        "world": [
            {"component": tie.component, "S_world_map": tie.S_world_map.matrix().tolist(), "crs": tie.frame.crs}
            for tie in store.revisions.world()
            if tie.S_world_map is not None and tie.frame is not None
        ],
        "scenes": scenes,
    }
    return json.dumps(told).encode()


# --- purged ----------------------------------------------------------------------------------------------------------


def owner_of(folder: Path) -> str | None:
    """Return the id of the map that a small map was exported from; None if the folder holds none that says so."""
    try:
        told = _read_header(folder / FILE_NAME)
        return str(told["map_id"]) if all(row["id"] for row in told["scenes"]) else None
    except (GsmapError, *MALFORMED):
        return None


def _num_files(folder: Path, map_id: str, scene: str) -> int:
    """Return the number of files that are about a scene: its own, and the list of all scenes if it names it."""
    if owner_of(folder) != map_id:
        raise InputError("it holds a small map that this map or version of gsmap did not write", code="foreign_export")
    listed = any(row["id"] == scene for row in _read_header(folder / FILE_NAME)["scenes"])
    return int(listed) + int(is_file(folder / f"{scene}.npz"))


def _forget(folder: Path, map_id: str, scene: str) -> None:
    """Delete a scene from a small map; the last one with the folder.

    The list goes first, so that an interrupted call leaves a small map that works, and the same call goes on.
    """
    told = _read_header(folder / FILE_NAME)
    left = [row for row in told["scenes"] if row["id"] != scene]
    if left and len(left) < len(told["scenes"]):
        text = json.dumps(told | {"scenes": left})
        write_owned(folder / FILE_NAME, map_id, lambda staged: staged.write_text(text, encoding="utf-8"))
    remove_file(folder, f"{scene}.npz")
    if not left:
        remove_file(folder, FILE_NAME)
    sync_folder(folder)
    remove_empty_folder(folder.parent, folder.name)


SMALL_MAPS = Output(
    is_at=lambda folder, map_id: os.path.lexists(folder / FILE_NAME), num_files=_num_files, forget=_forget
)


# --- read ------------------------------------------------------------------------------------------------------------


def is_small(path: str | os.PathLike[str]) -> bool:
    """Return true if the path is a small map."""
    return (Path(path) / FILE_NAME).is_file()


class SmallLocalizer(Localizer):
    """The scenes of a small map, ready to localize photos; see `Localizer`.

    Args:
        folder: folder of the small map.
        settings: settings of localization; the stored data do not depend on them.

    Raises:
        CorruptError: it was not written by gsmap, or bytes differ.
        ConfigError: it was written by a newer one; or another extractor is asked for.
    """

    def __init__(self, folder: str | os.PathLike[str], settings: Settings | None = None) -> None:
        self.settings = settings or settings_of({})
        self.params = self.settings.localize
        self.folder = Path(folder)
        if self.params.extractor != "sift":
            raise ConfigError(
                "a small map holds features of the built-in extractor: localize.extractor must be sift",
                code="small_map_extractor",
            )
        told = _read_header(self.folder / FILE_NAME)
        try:
            self.metres = {int(k): _positive(v) for k, v in told["metres_per_unit"].items()}
            small = [_scene(row) for row in told["scenes"]]
        except (GsmapError, *MALFORMED) as error:
            raise _corrupt(self.folder, error) from error
        self.small = {one.id: one for one in small}
        self.scenes = self.small  # type: ignore[assignment]
        self.placed = {}
        for one in small:
            self.placed[one.id] = MapScene(
                one.id,
                in_metres(one.S_map_scene, self.metres.get(one.component, 1.0)),
                one.component,
                one.covariance,
                partial(self._small_gaussians, one.id),
                partial(self._small_features, one.id),
            )
        self._used, self._capture_views = [], {}
        held = [(placed.features, one) for one, placed in self.placed.items()]
        self.index = view_index([new_segment(held)])
        for placed in self.placed.values():
            placed.drop()
        method = family("extractor").get(self.params.extractor)
        self.extractor = method.make({}, self.params.extractors[self.params.extractor])

    def _renewed(self, error: GsmapError) -> ViewIndex:
        raise error  # it lies in memory

    def near(self, text: str) -> SearchRegion:
        """Parse ``SCENE`` or ``X,Y,Z,R``, see `gsmap.map.localization.localize.parse_near`."""
        from gsmap.map.localization.localize import near_of

        return near_of(text, self._id_of)

    def _id_of(self, name: str) -> str:
        found = [one.id for one in self.small.values() if name in (one.name, one.id)]
        if not found:
            raise NotFoundError(f"{self.folder} has no scene called {name!r}", code="scene_not_found")
        return found[0]

    def _small_gaussians(self, scene: str) -> Gaussians:
        self._use(scene)
        arrays, size = self._arrays(scene, packed_gaussians.NAMES)
        try:
            return packed_gaussians.unpack(arrays, size)
        except MALFORMED as error:
            raise _corrupt(self.folder / f"{scene}.npz", error) from error

    def _small_features(self, scene: str) -> SceneFeatures:
        self._use(scene)
        arrays, size = self._arrays(scene, packed_features.NAMES)
        try:
            return packed_features.unpack(scene, arrays, size)
        except (GsmapError, *MALFORMED) as error:
            raise _corrupt(self.folder / f"{scene}.npz", error) from error

    def _arrays(self, scene: str, names: Sequence[str]) -> tuple[dict[str, np.ndarray], int]:
        """Return arrays from a scene's file after verifying it, and the size of the file."""
        import hashlib

        path = self.folder / f"{scene}.npz"
        try:
            content = _read_file(path, _MAX_SCENE)
            if hashlib.sha256(content).hexdigest() != self.small[scene].sha256:
                raise ValueError("its bytes differ from what was written")
            return _unpacked(path, content, names), len(content)
        except FileNotFoundError as error:
            raise CorruptError(f"{path} is missing: export the small map again", code="small_map_damaged") from error
        except (OSError, EOFError, MemoryError, *_BAD_ZIP, *MALFORMED) as error:
            raise _corrupt(path, error) from error


def _read_file(path: Path, most: int) -> bytes:
    """Read a file of at most ``most`` bytes.

    Raises:
        ValueError: it has more.
    """
    with open(open_file(path), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"{size:,} bytes, more than {most:,}")
        return file.read(size)


def _unpacked(path: Path, content: bytes, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Unpack arrays of a scene's file after checking that their headers match its size.

    Raises:
        ValueError, KeyError, BadZipFile: bytes that `_npz` did not write, or that claim far more than they hold.
    """
    claimed = 0
    with zipfile.ZipFile(io.BytesIO(content)) as stored:
        entries = [stored.getinfo(f"{name}.npy") for name in names]
        for entry in entries:
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{entry.filename} has a compression that gsmap does not use")
            with stored.open(entry) as file:
                if np.lib.format.read_magic(file) != (1, 0):
                    raise ValueError(f"{entry.filename} has another header than gsmap writes")
                shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                size = math.prod(shape) * dtype.itemsize
                if dtype.hasobject or min(shape, default=0) < 0 or size != entry.file_size - file.tell():
                    raise ValueError(f"the content of {entry.filename} does not match its header")
            claimed += size
        check_size(path, claimed, len(content))
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names}


def _read_header(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(_read_file(path, _MAX_JSON))
        if told["format"] != _FORMAT or not isinstance(told["version"], int):
            raise ValueError("it has another format")
    except (OSError, MemoryError, *MALFORMED) as error:
        raise _corrupt(path, error) from error
    if told["version"] != _VERSION:
        raise ConfigError(
            f"{path.parent} was written by another version of gsmap ({told['version']}): export it again",
            code="small_map_version",
        )
    return dict(told)


def _scene(row: Mapping[str, Any]) -> SmallMapScene:
    known = None if row["covariance"] is None else np.array(row["covariance"], np.float64)
    bounds = np.array(row["bounds"], np.float64)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all():
        raise ValueError("an invalid box")
    if known is not None and (known.shape != (7, 7) or not np.isfinite(known).all()):
        raise ValueError("an invalid covariance")
    texts = (row["id"], row["name"], row["sha256"])
    if not all(isinstance(text, str) for text in texts) or not row["id"].isalnum():
        raise ValueError("invalid names")
    return SmallMapScene(
        row["id"],
        row["name"],
        row["captured_at"] if isinstance(row["captured_at"], str) else None,
        int(row["component"]),
        Sim3.from_matrix(np.array(row["S_map_scene"], np.float64)),
        known,
        bounds,
        row["sha256"],
    )


def _positive(value: Any) -> float:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{value} metres per unit")
    return float(value)


def _corrupt(path: Path, error: Exception) -> CorruptError:
    return CorruptError(f"{path} is not a small map or is damaged ({error}): export it again", code="small_map_damaged")
