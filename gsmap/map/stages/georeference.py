"""Georeference: observations of the world read, checked and kept; the poses solved with them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsmap.errors import ConfigError, GsmapError, InputError, NotFoundError
from gsmap.formats import gcp_list
from gsmap.map.places import Place, place_in_scene
from gsmap.map.seeing import same_photo, surface_at
from gsmap.map.settings import Settings
from gsmap.store import Store
from gsmap.store.world import Observation
from gsmap.types import Cameras
from gsmap.types.world import ControlPoint, Fix, ImagePoint, ScaleBar, Survey, WorldFrame
from gsmap.world.crs import WGS84, crs
from gsmap.world.exif import read_folder
from gsmap.world.survey import check_area, frame_for


@dataclass(frozen=True, eq=False)
class PlacedPhoto:
    """A photo that is no scene's camera, but was localised in one.

    Args:
        scene: id of the scene that it was localised by.
        T_scene_camera: (4, 4).
        intrinsics_px: (4,) ``fx fy cx cy``. size_px: (2,) width, height.
        covariance: (6, 6) over [rotation (3, rad), translation (3, scene unit)] on the camera's side.
    """

    scene: str
    T_scene_camera: np.ndarray
    intrinsics_px: np.ndarray
    size_px: tuple[int, int]
    covariance: np.ndarray


SURVEYED = "survey"
"""The name of a fix that says where a scene's origin lies."""

Localise = Callable[[Sequence[str]], dict[str, PlacedPhoto]]
"""Photos by their names as the files have them, to those that were placed; the others are left out."""


@dataclass(frozen=True, eq=False)
class Request:
    """What is to be noted.

    Args:
        crs: that the map is to speak in; None leaves it as it is.
        gcp: a ``gcp_list.txt``.
        exif: a folder of photos whose EXIF says where they were taken.
        bars: (A, B, metres) distances between places.
        check: names of control points to hold out; None leaves them as they are, an empty one holds out none.
        sigma_m: (horizontal, vertical) standard deviations of control points; None for the setting's.
        bar_sigma_m: standard deviation of the distances; None for the setting's.
        photo_size_px: width and height of the photos that pixels were picked in, where the captures have them smaller.
    """

    crs: str | None = None
    gcp: str | os.PathLike[str] | None = None
    exif: str | os.PathLike[str] | None = None
    bars: Sequence[tuple[str, str, float]] = ()
    check: Sequence[str] | None = None
    sigma_m: tuple[float, float] | None = None
    bar_sigma_m: float | None = None
    photo_size_px: tuple[int, int] | None = None


@dataclass(eq=False)
class _Noted:
    """What goes into the catalog, and what a person should know of it."""

    items: list[Observation] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def georeference(
    store: Store, request: Request, settings: Settings, localise: Localise | None = None
) -> tuple[str, ...]:
    """Read, check and note observations; returns what a person should know. Where any is wrong nothing is noted.

    Args:
        localise: finds photos that are no scene's camera in the map.

    Raises:
        ConfigError, InputError, NotFoundError: an unknown CRS, a file that is wrong (with its line), a point that no
            photo of the map shows, a place that does not exist.
    """
    noted = _Noted()
    before = store.world.survey()
    if request.crs is not None:
        crs(request.crs)
    if request.gcp is not None:
        _read_gcp(store, Path(request.gcp), request, settings, localise, noted)
    if request.exif is not None:
        _read_exif(store, Path(request.exif), settings, noted)
    for one in request.bars:
        noted.items.append(_bar(store, *one, request.bar_sigma_m, settings))
    if request.check is not None:
        _hold_out(before, set(request.check), noted)
    places = [one for one in noted.items if isinstance(one, (ControlPoint, Fix))]
    check_area(places, settings.world.area_margin_deg)
    frame = _frame(before, request.crs, places)
    if frame is not None:
        crs(frame.crs).of_geodetic(
            crs(frame.crs).to_geodetic(_origin(frame))
        )  # refuse here what the solve could not do
        noted.items.append(frame)
    if not noted.items:
        raise ConfigError("say what ties the map to the world: --gcp FILE, --exif DIR, --scale-bar A B METRES")
    store.world.add(noted.items)
    return tuple(noted.notes)


def survey_position(
    store: Store, ref: str, position: Sequence[float], crs_text: str, sigma_m: tuple[float, float], settings: Settings
) -> None:
    """Note where the origin of a scene's frame lies in the world.

    Raises:
        ConfigError, InputError: an unknown CRS, or a point outside of its area.
    """
    scene = store.scenes.get(ref)
    fix = Fix(SURVEYED, scene.id, np.zeros(3), crs(crs_text).text, np.array(position, dtype=np.float64), sigma_m)
    check_area([fix], settings.world.area_margin_deg)
    frame = _frame(store.world.survey(), None, [fix])
    store.world.add([fix] if frame is None else [fix, frame])


def forget_position(store: Store, ref: str) -> bool:
    """Take a scene's surveyed position back; whether it had one."""
    scene = store.scenes.get(ref)
    if not any(fix.scene == scene.id and fix.name == SURVEYED for fix in store.world.survey().fixes):
        return False
    store.world.remove((SURVEYED,), kinds=("fix",), scene=scene.id)
    return True


def _origin(frame: WorldFrame) -> np.ndarray:
    from gsmap.world.frame import of_frame

    return of_frame(frame, np.zeros((1, 3)))


def _frame(before: Survey, crs_text: str | None, new: Sequence[ControlPoint | Fix]) -> WorldFrame | None:
    """The world frame that is to be noted; None where that which there is stays, or none can be made yet."""
    known = before.frame
    if known is not None and (crs_text is None or crs(crs_text).text == known.crs):
        return None
    points = {one.name: one for one in (*before.points, *new) if isinstance(one, ControlPoint)}
    fixes = {(one.name, one.scene): one for one in (*before.fixes, *new) if isinstance(one, Fix)}
    if not points and not fixes:
        if crs_text is None:
            return None
        raise InputError(f"nothing of this map lies in {crs_text} yet: give --gcp FILE or --exif DIR with it")
    first: ControlPoint | Fix = next(iter(points.values())) if points else next(iter(fixes.values()))
    return frame_for(crs_text or first.crs, Survey(None, tuple(points.values()), (), tuple(fixes.values())))


# --- control points ---------------------------------------------------------------------------------------------------


def _read_gcp(
    store: Store, path: Path, request: Request, settings: Settings, localise: Localise | None, noted: _Noted
) -> None:
    found = gcp_list.read(path)
    crs(found.crs)
    params = settings.world
    sigma = request.sigma_m or (params.gcp_sigma_m, params.gcp_sigma_m)
    held = set(request.check or ())
    names = {line.name for line in found.lines}
    cameras = _Cameras(store)
    of_photo = {line.image: cameras.find(line.image, f"{path}, line {line.line}") for line in found.lines}
    strangers = sorted(image for image, camera in of_photo.items() if camera is None)
    placed = localise(strangers) if localise is not None and strangers else {}
    seen: list[ImagePoint] = []
    missing: set[str] = set()
    for line in found.lines:
        where = f"{path}, line {line.line}"
        camera, stranger = of_photo[line.image], placed.get(line.image)
        if camera is not None:
            scene, one = camera
            pixel = _pixel(line.pixel, one.sizes_px[0].tolist(), request.photo_size_px, where, line.image)
            pose, intrinsics, covariance = one.T_frame_camera[0], one.intrinsics_px[0], None
            named = one.names[0]
        elif stranger is not None:
            scene, named = stranger.scene, line.image
            pixel = _pixel(line.pixel, stranger.size_px, request.photo_size_px, where, line.image)
            pose, intrinsics, covariance = stranger.T_scene_camera, stranger.intrinsics_px, stranger.covariance
        else:
            missing.add(line.image)
            continue
        seen.append(
            ImagePoint(
                line.name, named, scene, pixel, params.pixel_sigma_px, np.array(pose), np.array(intrinsics), covariance
            )
        )
    if not seen:
        raise NotFoundError(
            f"none of the {len(missing)} photos that {path} names is a camera of this map (the first is "
            f"{sorted(missing)[0]}): a photo goes by the name that its capture's cameras have for it, SCENE/NAME where "
            "several scenes have one of that name"
        )
    if missing:
        some = ", ".join(sorted(missing)[:3])
        noted.notes.append(f"{len(missing)} photos are in no scene of this map and were left out: {some}")
    views = {name: [image for image in seen if image.point == name] for name in names}
    points: dict[str, ControlPoint] = {}
    for line in found.lines:
        position = np.array(line.position)
        points[line.name] = ControlPoint(line.name, found.crs, position, sigma, line.name in held)
    noted.items += points.values()
    for shown in views.values():
        noted.items += [_with_depth(store, shown[0], settings)] if len(shown) == 1 else shown


def _pixel(
    pixel: tuple[float, float], size: Sequence[int], full: tuple[int, int] | None, where: str, image: str
) -> np.ndarray:
    """As the capture has the photo."""
    at = np.array(pixel, dtype=np.float64)
    if full is not None:
        if abs(full[0] / size[0] * size[1] / full[1] - 1) > 0.01:
            raise InputError(
                f"{where}: {image} is {size[0]}x{size[1]}, which is no smaller picture of {full[0]}x{full[1]}"
            )
        at = at * np.array(size) / np.array(full)
    if not (0 <= at[0] <= size[0] and 0 <= at[1] <= size[1]):
        raise InputError(
            f"{where}: pixel {pixel[0]:g} {pixel[1]:g} lies outside of {image}, which is {size[0]}x{size[1]} in its "
            "capture: say --photo-size WIDTH HEIGHT where pixels were picked in a larger picture"
        )
    return at


class _Cameras:
    """The cameras of all scenes by the names of photos; read once each."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._scenes = store.scenes.list()
        self._cameras: dict[str, Cameras] = {}

    def find(self, image: str, where: str) -> tuple[str, Cameras] | None:
        """Scene and camera of a photo (``NAME``, or ``SCENE/NAME``); None where no scene has it.

        Raises:
            InputError: several scenes have it.
        """
        named = [scene for scene in self._scenes if image.startswith(f"{scene.name}/")]
        found = []
        for scene in named or self._scenes:
            if scene.id not in self._cameras:
                self._cameras[scene.id] = self._store.scenes.cameras(scene.id)
            wanted = image.removeprefix(f"{scene.name}/") if named else image
            cameras = self._cameras[scene.id]
            if cameras.synthesised:
                continue
            rows = [k for k, name in enumerate(cameras.names) if name == wanted]
            rows = rows or [k for k, name in enumerate(cameras.names) if same_photo(name, wanted)]
            found += [(scene, cameras[[k]]) for k in rows]
        if not found:
            return None
        if len(found) > 1:
            one, other = found[0][0].name, found[1][0].name
            raise InputError(
                f"{where}: {image} is a camera of {one} and of {other}: write {one}/{image} or {other}/{image}"
            )
        return found[0][0].id, found[0][1]


def _with_depth(store: Store, image: ImagePoint, settings: Settings) -> ImagePoint:
    """A point that one photo alone shows is where its ray meets the rendered surface."""
    size = np.ceil(np.maximum(image.pixel + 1, 2 * image.intrinsics_px[2:])).astype(np.int64)
    camera = Cameras(image.T_scene_camera[None], image.intrinsics_px[None], size[None], (image.image,))
    try:
        gaussians = store.scenes.gaussians(image.scene)
        seen = surface_at(gaussians, camera, image.pixel, settings.world.depth_sigma_share)
    except GsmapError:
        return image  # of a pruned or damaged scene; the ray alone still counts
    return image if seen is None else replace(image, depth=seen[0], depth_sigma=seen[1])


def _hold_out(before: Survey, names: set[str], noted: _Noted) -> None:
    """Which points are check points, of those that stand and those that come."""
    fresh = {one.name for one in noted.items if isinstance(one, ControlPoint)}
    known = fresh | {point.name for point in before.points}
    if unknown := sorted(names - known):
        raise NotFoundError(
            f"no control point is called {unknown[0]!r}: {', '.join(sorted(known)[:8]) or 'there is none'}"
        )
    for point in before.points:
        if point.name not in fresh and point.check != (point.name in names):
            noted.items.append(replace(point, check=point.name in names))


# --- positions and lengths --------------------------------------------------------------------------------------------


def _read_exif(store: Store, folder: Path, settings: Settings, noted: _Noted) -> None:
    cameras = _Cameras(store)
    strangers, without_height = 0, 0
    for photo in read_folder(folder):
        found = cameras.find(photo.image, str(folder))
        if found is None:
            strangers += 1
            continue
        scene, camera = found
        sigma, common = photo.sigmas(settings.world)
        height = photo.height_m
        if height is None:
            without_height += 1
            continue
        position = np.array([photo.longitude_deg, photo.latitude_deg, height])
        noted.items.append(Fix(camera.names[0], scene, camera.centers[0], WGS84, position, sigma, common))
    if not any(isinstance(one, Fix) for one in noted.items):
        raise NotFoundError(
            f"no photo in {folder} that has a position with a height is a camera of this map: photos go by the names "
            "that their captures' cameras have for them"
        )
    if strangers:
        noted.notes.append(f"{strangers} photos in {folder} are in no scene of this map and were left out")
    if without_height:
        noted.notes.append(f"{without_height} photos in {folder} have no height and were left out")


def _bar(store: Store, a: str, b: str, metres: float, sigma_m: float | None, settings: Settings) -> ScaleBar:
    if not (np.isfinite(metres) and metres > 0):
        raise ConfigError(f"a scale bar is so many metres long, got {metres:g}")
    ends: list[Place] = [place_in_scene(store, text, settings) for text in (a, b)]
    scenes = (str(ends[0].scene), str(ends[1].scene))
    sigmas = [float(np.sqrt(np.trace(end.covariance) / 3)) for end in ends]
    # Nothing is picked to better than a ten-thousandth of what it is picked on.
    sigmas = [
        max(sigma, 1e-4 * float(np.ptp(store.scenes.get(s).bounds))) for sigma, s in zip(sigmas, scenes, strict=True)
    ]
    points = np.stack([end.point for end in ends])
    sigma = sigma_m or settings.world.bar_sigma_share * metres
    return ScaleBar(f"{a} to {b}", scenes, points, (sigmas[0], sigmas[1]), metres, sigma)


def take_back(store: Store, names: Iterable[str]) -> int:
    """Forget observations by name, or all of them with the CRS; how many.

    Raises:
        NotFoundError: one of the names is none.
    """
    return store.world.remove(tuple(names))
