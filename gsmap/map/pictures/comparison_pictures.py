"""Draw images of changes and pairs into a folder, and index the scenes that they show, for purges."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from gsmap.durable import make_folder, open_file, remove_file, remove_staged, write_output, write_owned
from gsmap.errors import MALFORMED, ConfigError, InputError
from gsmap.geometry.metric_scale import in_metres
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map.changes.rows import change_arrays, parse_change_id
from gsmap.map.metric_scales import metres_of_scenes
from gsmap.map.outputs import Output, note_target
from gsmap.methods import text_digest
from gsmap.register.view_cache import ViewCache
from gsmap.store import Store
from gsmap.types import Cameras, PosedScene, Registration, Scene, Sim3
from gsmap.types.progress import StageProgress
from gsmap.types.rows.changes import ChangeRow

_log = logging.getLogger("gsmap.map")
FILE_NAME = "changes.json"
_VERSION = 1
_PICTURE = re.compile(r"c\d+\.png|why-[A-Za-z0-9_.-]{1,100}\.png|find-[0-9a-f]{16}\.png")
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")
VIEWS_PER_SCENE = 2  # maximum number of cameras, for each scene of a pair, that both are drawn from
_TRIED_PER_SCENE = 14  # cameras of each scene, evenly along its capture, among which these are chosen
_MAX_BYTES = 1 << 26


@dataclass
class PictureFolder:
    """The index of a folder of images: the ids of the scenes that each file shows."""

    map_id: str
    scenes: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path, map_id: str) -> PictureFolder:
        """Load the index of a folder; return an empty index if the folder is empty or missing.

        Raises:
            ConfigError: it holds something else, or pictures of another map.
            InputError: what it holds cannot be read.
        """
        path = folder / FILE_NAME
        remove_staged(folder, map_id)
        if not os.path.lexists(path):
            if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
                raise ConfigError(
                    f"{folder} holds other files: give an empty or a new folder for images", code="folder_not_empty"
                )
            return cls(map_id)
        try:
            with open(open_file(path), "rb") as file:
                content = json.loads(file.read(_MAX_BYTES))
            owner, version = str(content["map_id"]), content["version"]
            scenes = {str(name): [str(scene) for scene in ids] for name, ids in content["pictures"].items()}
        except (OSError, *MALFORMED) as error:
            raise InputError(
                f"{path} was not written by gsmap ({error!r}): give another folder", code="foreign_export"
            ) from error
        if owner != map_id or version != _VERSION:
            raise ConfigError(
                f"{folder} holds pictures of another map ({owner[:12]}): give another folder", code="foreign_export"
            )
        return cls(map_id, {name: ids for name, ids in scenes.items() if _PICTURE.fullmatch(name)})

    def save(self, folder: Path) -> None:
        content = {"version": _VERSION, "map_id": self.map_id, "pictures": self.scenes}
        text = json.dumps(content, indent=1)
        write_owned(folder / FILE_NAME, self.map_id, lambda staged: staged.write_text(text, encoding="utf-8"))

    def add(self, store: Store, folder: Path, scenes: Mapping[str, list[str]]) -> None:
        """Record images before they are drawn, so that a purge knows what an interrupted run leaves."""
        make_folder(folder)
        if (refused := note_target(store, folder, {"pictures": True})) is not None:  # like the folder of an export
            _log.warning("%s: the folder is not recorded in the map, so a purge will not find these images", refused)
        self.scenes |= scenes
        self.save(folder)

    def of_scene(self, scene: str) -> list[str]:
        """Return the images that show a scene."""
        return [name for name, ids in self.scenes.items() if scene in ids]

    def forget(self, folder: Path, scene: str) -> None:
        """Delete the images that show a scene."""
        for name in self.of_scene(scene):
            remove_file(folder, name)
            del self.scenes[name]
        self.save(folder)


PICTURES = Output(
    is_at=lambda folder, map_id: os.path.lexists(folder / FILE_NAME),
    num_files=lambda folder, map_id, scene: len(PictureFolder.load(folder, map_id).of_scene(scene)),
    forget=lambda folder, map_id, scene: PictureFolder.load(folder, map_id).forget(folder, scene),
)


def draw(store: Store, folder: Path, rows: Sequence[ChangeRow], progress: StageProgress) -> dict[str, str]:
    """Draw the place before and after each change; return the files by change id.

    Args:
        rows: changes of pairs that have a place in the map.

    Raises:
        ConfigError, InputError: see `PictureFolder.load`.
    """
    known = PictureFolder.load(folder, store.id)
    rows = [row for row in rows if row.box_m is not None]
    known.add(store, folder, {f"{row.id}.png": [row.older, row.newer] for row in rows})
    files: dict[str, str] = {}
    for pair in dict.fromkeys((row.older, row.newer) for row in rows):
        drawer = PairRenderer(store, *pair)
        for row in rows:
            if (row.older, row.newer) == pair:
                progress("pictures", len(files) / len(rows), row.id)
                files[row.id] = str(folder / f"{row.id}.png")
                write_owned(folder / f"{row.id}.png", store.id, partial(drawer.draw, row))
    progress("pictures", 1.0, f"{len(files)} pictures")
    return files


def draw_pair(store: Store, folder: Path, a: Scene, b: Scene) -> str | None:
    """Draw both scenes of a pair from the same cameras, by the pose of the pair's edge; return None without a pose.

    Raises:
        ConfigError, InputError: see `PictureFolder.load`.
    """
    known, stored = PictureFolder.load(folder, store.id), store.registrations.get(a.id, b.id)
    picture = picture_of_pair(store, a.id, b.id)
    if stored is None or picture is None:
        return None
    edge = stored.registration
    called = "-".join(_UNSAFE.sub("_", store.scenes.get(end).name)[:40] for end in (edge.target, edge.source))
    name = f"why-{called}-{text_digest(edge.target + edge.source)[:8]}.png"
    known.add(store, folder, {name: [edge.target, edge.source]})
    write_owned(folder / name, store.id, partial(_save, picture))
    return str(folder / name)


def picture_of_pair(store: Store, a: str, b: str, side_px: int = 320) -> np.ndarray | None:
    """Render both scenes of a pair (ids) from the same cameras, (H, W, 3) uint8; None if the pair's edge has no pose.

    Args:
        side_px: longer side of each view.

    Raises:
        CorruptError, NotFoundError: see `gsmap.store.scenes.Scenes.gaussians`.
    """
    stored = store.registrations.get(a, b)
    if stored is None or stored.registration.S_target_source is None:
        return None
    from gsmap.view.pair_picture import draw_pair

    edge = stored.registration
    seen = pair_views(store, edge)
    names = store.scenes.get(edge.target).name, store.scenes.get(edge.source).name
    return draw_pair(seen.target, seen.source, seen.cameras, unit_m=seen.unit_m, side_px=side_px, names=names)


@dataclass(frozen=True, eq=False)
class PairViews:
    """Two scenes in the target's frame, the cameras whose pictures decide on their pose, and metres per unit."""

    target: PosedScene
    source: PosedScene
    cameras: list[Cameras]
    unit_m: float


def pair_views(store: Store, edge: Registration) -> PairViews:
    """Return both scenes of an edge with a pose, and as many cameras as `num_views` of both, best first."""
    from gsmap.view.pair_picture import choose_cameras

    assert edge.S_target_source is not None
    target, source = (
        posed_scene(store, edge.target, Sim3.identity()),
        posed_scene(store, edge.source, edge.S_target_source),
    )
    graph = store.graphs.load(edge.target)
    unit_m = 1.0 if graph is None else graph.unit_m
    tried = []
    for one, other in ((target, source), (source, target)):
        if one.cameras is not None and len(one.cameras):
            cache = ViewCache(one.gaussians, one.cameras, synthesize=False)
            rows = cache.select_views(other.gaussians.means, VIEWS_PER_SCENE)
            evenly = np.linspace(0, len(one.cameras) - 1, min(len(one.cameras), _TRIED_PER_SCENE)).astype(int)
            tried += [one.cameras[[row]] for row in dict.fromkeys([*rows, *evenly.tolist()])]
    count = num_views([0 if one.cameras is None else len(one.cameras) for one in (target, source)])
    return PairViews(target, source, choose_cameras(target, source, tried, count, unit_m), unit_m)


def num_views(num_cameras: Sequence[int]) -> int:
    """Return the number of cameras from which a pair is drawn.

    Args:
        num_cameras: number of cameras of each of both scenes.
    """
    return sum(min(VIEWS_PER_SCENE, count) for count in num_cameras)


def picture_of_change(store: Store, row: ChangeRow, side_px: int = 320) -> np.ndarray | None:
    """Render the place before and after a change, (H, W, 3) uint8; None without a position. Raises as
    `picture_of_pair`.
    """
    return None if row.box_m is None else PairRenderer(store, row.older, row.newer).picture(row, side_px)


def save_picture(picture: np.ndarray, path: str | os.PathLike[str]) -> None:
    """Write an image (H, W, 3) uint8 in the format of the path's suffix.

    Raises:
        ConfigError: a suffix that no picture has.
    """
    from PIL import Image

    try:
        write_output(Path(path), Image.fromarray(picture).save)
    except ValueError as error:  # a suffix that Pillow does not know
        raise ConfigError(
            f"cannot draw to {path} ({error}): name a file that ends with .png", code="wrong_suffix"
        ) from error


def draw_places(
    store: Store,
    folder: Path,
    scenes: Sequence[str],
    boxes: Sequence[np.ndarray],
    progress: StageProgress,
) -> list[str]:
    """Draw the content of boxes, each from one scene; return the files in the order of the boxes.

    Args:
        scenes: id of the scene of each box.
        boxes: (2, 3) each, map frame and unit.

    Raises:
        ConfigError, InputError: see `PictureFolder.load`.
    """
    from gsmap.view.change_picture import draw_place

    known, poses = PictureFolder.load(folder, store.id), store.revisions.get()
    assert poses is not None
    metres = metres_of_scenes(store, poses)
    names = [
        f"find-{text_digest(f'{scene} {box.tolist()}')[:16]}.png" for scene, box in zip(scenes, boxes, strict=True)
    ]
    known.add(store, folder, {name: [scene] for name, scene in zip(names, scenes, strict=True)})
    for done, scene in enumerate(dict.fromkeys(scenes)):
        progress("pictures", done / len(scenes), scene[:12])
        placed = posed_scene(store, scene, in_metres(poses.poses[scene].S_map_scene, metres[scene]))
        for name, one, box in zip(names, scenes, boxes, strict=True):
            if one == scene:
                write_owned(folder / name, store.id, partial(_save, draw_place(placed, box * metres[scene])))
    progress("pictures", 1.0, f"{len(names)} pictures")
    return [str(folder / name) for name in names]


def _save(drawn: np.ndarray, path: Path) -> None:
    from PIL import Image

    Image.fromarray(drawn).save(path, format="PNG")


class PairRenderer:
    """A renderer of all changes of a pair of scenes, which reads both scenes once."""

    def __init__(self, store: Store, older: str, newer: str) -> None:
        graph = store.revisions.get()
        assert graph is not None
        self._store = store
        self._metres = metres = metres_of_scenes(store, graph)[newer]
        self._older = posed_scene(store, older, in_metres(graph.poses[older].S_map_scene, metres))
        self._newer = posed_scene(store, newer, in_metres(graph.poses[newer].S_map_scene, metres))

    def draw(self, row: ChangeRow, path: Path) -> None:
        """Draw a change to a PNG file."""
        _save(self.picture(row), path)

    def picture(self, row: ChangeRow, side_px: int = 320) -> np.ndarray:
        """Render the place before and after a change beside each other, (H, W, 3) uint8."""
        from gsmap.view.change_picture import beside

        return beside(*self.views(row, side_px))

    def views(self, row: ChangeRow, side_px: int) -> tuple[np.ndarray, np.ndarray]:
        """Render the place before and after a change from the same camera, (H, W, 3) uint8 each."""
        from gsmap.view.change_picture import draw_change

        change = change_arrays(self._store, parse_change_id(row.id))
        box, voxels = change.box * self._metres, change.voxels * self._metres
        return draw_change(self._older, self._newer, box, voxels, side_px)


def posed_scene(store: Store, scene: str, S: Sim3) -> PosedScene:
    """Read a scene and transform it by ``S``."""
    gaussians, cameras = store.scenes.gaussians(scene), store.scenes.cameras(scene)
    return PosedScene(transform_gaussians(gaussians, S), transform_cameras(cameras, S), scene)
