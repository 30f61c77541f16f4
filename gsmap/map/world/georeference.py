"""Georeference stage: read, check and store observations of the world, and solve the poses with them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsmap.errors import ConfigError, GsmapError, InputError, NotFoundError
from gsmap.formats import gcp_list
from gsmap.geodesy.crs import WGS84, crs
from gsmap.geodesy.frame import frame_at, from_frame, to_frame
from gsmap.geodesy.survey import check_area, frame_for, in_frame
from gsmap.ingest.dates import photo_date
from gsmap.map.date_filter import parse_moment
from gsmap.map.localization.photo_poses import LocalizePhotos
from gsmap.map.settings import Settings
from gsmap.map.stages.optimize import Solution, solve_observed
from gsmap.map.world.photo_names import PhotoMatches, match_photos
from gsmap.map.world.pixel_points import photo_size, surface_at, view_of
from gsmap.map.world.specified_points import SpecifiedPoint, parse_scene_point
from gsmap.store import Store
from gsmap.store.world import Observation
from gsmap.types import Cameras
from gsmap.types.world import UNSOLVED, ControlPoint, ImagePoint, PositionFix, ScaleBar, Survey, WorldFrame
from gsmap.world.exif import read_folder
from gsmap.world.params import BAR_SIGMA_FRACTION, DEPTH_SIGMA_FRACTION, PIXEL_SIGMA_PX

SURVEYED = "survey"
"""The name of a position fix that gives the position of a scene's origin."""


_OTHER_DAYS = 2  # more than clocks and zones are off, and than a night that a survey goes over


@dataclass(frozen=True, eq=False)
class Request:
    """The observations to add.

    Args:
        crs: CRS of the map; None leaves it unchanged.
        gcp: a ``gcp_list.txt``.
        exif: folder of photos with GNSS positions in EXIF.
        bars: (A, B, metres) distances between points.
        check: names of control points to hold out; None leaves them unchanged, an empty one holds out none.
        sigma_m: (horizontal, vertical) standard deviations of control points; None for the setting.
        bar_sigma_m: standard deviation of the distances; None for a fraction of each (`BAR_SIGMA_FRACTION`).
        photo_size_px: width and height of the photos in which pixels were picked, if the captures have smaller ones.
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
class _NewObservations:
    """Observations to store, and notes for the user."""

    items: list[Observation] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def georeference(
    store: Store, request: Request, settings: Settings, localise: LocalizePhotos | None = None
) -> tuple[tuple[str, ...], Solution | None]:
    """Read observations, check them, solve the poses with them, and store them; if one is wrong, store none.

    Args:
        localise: localizes photos that are not cameras of a scene.

    Returns:
        Remarks for the person, and the poses with these observations, not kept yet; None where the newest are that.

    Raises:
        ConfigError, InputError, NotFoundError: an unknown CRS, a file that is wrong (with its line), a photo that may
            be one of several cameras, a point that no photo of the map shows, a place that does not exist, or
            observations that have no solution.
    """
    noted = _NewObservations()
    before = store.world.survey()
    if request.crs is not None:
        crs(request.crs)
    if request.gcp is not None:
        _read_gcp(store, Path(request.gcp), request, settings, localise, before, noted)
    if request.exif is not None:
        _read_exif(store, Path(request.exif), settings, before, noted)
    for one in request.bars:
        noted.items.append(_bar(store, *one, request.bar_sigma_m, before))
    if request.check is not None:
        _hold_out(before, set(request.check), noted)
    places = [one for one in noted.items if isinstance(one, (ControlPoint, PositionFix))]
    check_area(places, settings.world.area_margin_deg)
    frame = _frame(before, request.crs, places)
    if frame is not None:
        crs(frame.crs).check_area(_origin(frame), ["the map"], settings.world.area_margin_deg)
        noted.items.append(frame)
    _refuse_unreachable(before, frame or before.frame, places)
    if not noted.items:
        raise ConfigError(
            "specify observations of the world: --gcp FILE, --exif DIR or --scale-bar A B METRES",
            code="nothing_requested",
        )
    solution = _solved(store, noted.items, settings)
    store.world.add(noted.items)
    return tuple(noted.notes), solution


def _solved(store: Store, items: Sequence[Observation], settings: Settings) -> Solution | None:
    """Solve the poses as if observations had been stored.

    Raises:
        InputError: a component that had a solution has none with them.
    """
    try:
        solution = solve_observed(store, settings, store.world.survey(items))
    except (np.linalg.LinAlgError, FloatingPointError, RuntimeError) as error:
        raise InputError(
            f"nothing was noted: the poses cannot be solved with these observations ({error}); check positions, "
            "units and photos, or give fewer of them",
            code="unsolvable_observations",
        ) from error
    before = {tie.problem for tie in store.revisions.world()}
    for tie in solution.answer.world if solution is not None else ():
        if tie.problem == UNSOLVED and UNSOLVED not in before:
            raise InputError(
                f"nothing was noted: in component {tie.component} {tie.problem}; check positions, units and photos, or "
                "give fewer of them",
                code="unsolvable_observations",
            )
    return solution


def survey_position(
    store: Store, ref: str, position: Sequence[float], crs_text: str, sigma_m: tuple[float, float], settings: Settings
) -> None:
    """Store the world position of the origin of a scene's frame.

    Raises:
        ConfigError, InputError: an unknown CRS, or a point outside of its area.
    """
    scene = store.scenes.get(ref)
    fix = PositionFix(
        SURVEYED, scene.id, np.zeros(3), crs(crs_text).text, np.array(position, dtype=np.float64), sigma_m
    )
    check_area([fix], settings.world.area_margin_deg)
    before = store.world.survey()
    frame = _frame(before, None, [fix])
    _refuse_unreachable(before, frame or before.frame, [fix])
    store.world.add([fix] if frame is None else [fix, frame])


def forget_position(store: Store, ref: str) -> bool:
    """Remove the surveyed position of a scene; return true if it had one."""
    scene = store.scenes.get(ref)
    if not any(fix.scene == scene.id and fix.name == SURVEYED for fix in store.world.survey().fixes):
        return False
    store.world.remove((SURVEYED,), kinds=("fix",), scene=scene.id)
    return True


def _refuse_unreachable(before: Survey, frame: WorldFrame | None, new: Sequence[ControlPoint | PositionFix]) -> None:
    """Raise an error if PROJ cannot transform an observation to the map's CRS."""
    points = tuple(one for one in (*before.points, *new) if isinstance(one, ControlPoint))
    fixes = tuple(one for one in (*before.fixes, *new) if isinstance(one, PositionFix))
    in_frame(Survey(frame, points, (), fixes))


def _origin(frame: WorldFrame) -> np.ndarray:
    return from_frame(frame, np.zeros((1, 3)))


def _frame(before: Survey, crs_text: str | None, new: Sequence[ControlPoint | PositionFix]) -> WorldFrame | None:
    """Return the world frame to store; None if the stored frame stays or no frame can be chosen yet."""
    known = before.frame
    if known is not None and (crs_text is None or crs(crs_text).text == known.crs):
        return None
    points = {one.name: one for one in (*before.points, *new) if isinstance(one, ControlPoint)}
    fixes = {(one.name, one.scene): one for one in (*before.fixes, *new) if isinstance(one, PositionFix)}
    if not points and not fixes:
        if crs_text is None:
            return None
        raise InputError(
            f"nothing of this map lies in {crs_text} yet: give --gcp FILE or --exif DIR with it",
            code="not_georeferenced",
        )
    first: ControlPoint | PositionFix = next(iter(points.values())) if points else next(iter(fixes.values()))
    return frame_for(crs_text or first.crs, Survey(None, tuple(points.values()), (), tuple(fixes.values())))


# --- control points ---------------------------------------------------------------------------------------------------


def _read_gcp(
    store: Store,
    path: Path,
    request: Request,
    settings: Settings,
    localise: LocalizePhotos | None,
    before: Survey,
    noted: _NewObservations,
) -> None:
    found = gcp_list.read(path)
    crs(found.crs)
    # A place without a name is the point that it was when it was given before, written otherwise.
    known = {tuple(point.position): point.name for point in before.points if point.crs == found.crs}
    names_known = [one if one.is_named else replace(one, name=known.get(one.position, one.name)) for one in found.lines]
    found = replace(found, lines=tuple(names_known))
    params = settings.world
    sigma = request.sigma_m or (params.gcp_sigma_m, params.gcp_sigma_m)
    held = set(request.check or ())
    names = {line.name for line in found.lines}
    cameras = _Cameras(store)
    first: dict[str, str] = {}
    for line in found.lines:
        first.setdefault(line.image, f"{path}, line {line.line}")
    matches = cameras.match(first)
    of_photo = {image: cameras[matches.cameras[image]] if image in matches.cameras else None for image in first}
    strangers = sorted(image for image, camera in of_photo.items() if camera is None)
    placed = localise(strangers) if localise is not None and strangers else {}
    seen: list[ImagePoint] = []
    picked: dict[tuple[str, str, str], str] = {}
    missing: set[str] = set()
    for line in found.lines:
        where = f"{path}, line {line.line}"
        camera, stranger = of_photo[line.image], placed.get(line.image)
        if camera is not None:
            scene, one = camera
            named = next(iter(one.photo_rows))
            picked_px = _pixel(line.pixel, photo_size(one), request.photo_size_px, where, line.image)
            one, pixel = view_of(one, picked_px)
            pose, intrinsics, covariance = one.T_frame_camera[0], one.intrinsics_px[0], None
        elif stranger is not None:
            scene, named = stranger.scene, line.image
            pixel = _pixel(line.pixel, stranger.size_px, request.photo_size_px, where, line.image)
            pose, intrinsics, covariance = stranger.T_scene_camera, stranger.intrinsics_px, stranger.covariance
        else:
            missing.add(line.image)
            continue
        if (earlier := picked.setdefault((line.name, scene, named), where)) is not where:
            raise InputError(f"{where}: point {line.name} in {line.image} again, as on {earlier}", code="duplicate")
        seen.append(
            ImagePoint(line.name, named, scene, pixel, PIXEL_SIGMA_PX, np.array(pose), np.array(intrinsics), covariance)
        )
    if not seen:
        raise NotFoundError(
            f"none of the {len(missing)} photos that {path} names is a camera of this map (the first is "
            f"{sorted(missing)[0]}): a photo goes by the name that its capture's cameras have for it, SCENE/NAME where "
            "several scenes have one of that name",
            code="photos_not_matched",
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
        noted.items += [_with_depth(store, shown[0])] if len(shown) == 1 else shown


def _pixel(
    pixel: tuple[float, float], size: Sequence[int], full: tuple[int, int] | None, where: str, image: str
) -> np.ndarray:
    """Scale a pixel to the size of the capture's photo."""
    at = np.array(pixel, dtype=np.float64)
    if full is not None:
        if abs(full[0] / size[0] * size[1] / full[1] - 1) > 0.01:
            raise InputError(
                f"{where}: {image} is {size[0]}x{size[1]}, which is no smaller picture of {full[0]}x{full[1]}",
                code="size_mismatch",
            )
        at = at * np.array(size) / np.array(full)
    if not (0 <= at[0] <= size[0] and 0 <= at[1] <= size[1]):
        raise InputError(
            f"{where}: pixel {pixel[0]:g} {pixel[1]:g} lies outside of {image}, which is {size[0]}x{size[1]} in its "
            "capture: say --photo-size WIDTH HEIGHT where pixels were picked in a larger picture",
            code="pixel_outside",
        )
    return at


class _Cameras:
    """The real (not synthesized) cameras of all scenes, which are read once."""

    def __init__(self, store: Store) -> None:
        scenes = {scene.name: (scene.id, store.scenes.cameras(scene.id)) for scene in store.scenes.list()}
        self._of_scene = {name: one for name, one in scenes.items() if not one[1].synthesised}

    def match(self, photos: Mapping[str, str]) -> PhotoMatches:
        """Match photos to cameras; the values are their sources, see `gsmap.map.world.photo_names`."""
        names = {name: list(one.photo_rows) for name, (_, one) in self._of_scene.items()}
        return match_photos(photos, names, photos)

    def __getitem__(self, camera: tuple[str, int]) -> tuple[str, Cameras]:
        """Return the id of a scene and the cameras of one of its photos, by the scene's name and the photo's number."""
        scene, cameras = self._of_scene[camera[0]]
        return scene, cameras[list(cameras.photo_rows.values())[camera[1]]]


def _with_depth(store: Store, image: ImagePoint) -> ImagePoint:
    """Add a rendered depth to the observation of a control point that only one photo shows."""
    size = np.ceil(2 * image.intrinsics_px[2:]).astype(np.int64)
    camera = Cameras(image.T_scene_camera[None], image.intrinsics_px[None], size[None], (image.image,))
    try:
        gaussians = store.scenes.gaussians(image.scene)
        seen = surface_at(gaussians, camera, image.pixel, DEPTH_SIGMA_FRACTION)
    except GsmapError:
        return image  # of a pruned or damaged scene; the ray alone still counts
    return image if seen is None else replace(image, depth=seen[0], depth_sigma=seen[1])


def _hold_out(before: Survey, names: set[str], noted: _NewObservations) -> None:
    """Mark some of the stored and new control points as check points."""
    fresh = {one.name for one in noted.items if isinstance(one, ControlPoint)}
    known = fresh | {point.name for point in before.points}
    if unknown := sorted(names - known):
        raise NotFoundError(
            f"no control point is called {unknown[0]!r}; the map has {', '.join(sorted(known)[:8]) or 'none'}"
            f"{f' and {len(known) - 8} more' if len(known) > 8 else ''}",
            code="observation_not_found",
        )
    for point in before.points:
        if point.name not in fresh and point.check != (point.name in names):
            noted.items.append(replace(point, check=point.name in names))


# --- positions and lengths --------------------------------------------------------------------------------------------


def _read_exif(store: Store, folder: Path, settings: Settings, before: Survey, noted: _NewObservations) -> None:
    cameras, positions = _Cameras(store), read_folder(folder)
    # Photos without a position take part: they may be those that a camera is of.
    matches = cameras.match(dict.fromkeys(positions, str(folder)))
    placed = {photo: one for photo, one in positions.items() if one is not None and photo in matches.cameras}
    bare = {photo for photo in matches.by_file_name if photo in placed}
    by_file_name: list[tuple[str, PositionFix]] = []
    for photo, one in placed.items():
        if one.height_m is None:
            continue
        scene, camera = cameras[matches.cameras[photo]]
        sigma, common, sea_level = one.sigmas(settings.world)
        position = np.array([one.longitude_deg, one.latitude_deg, one.height_m])
        fix = PositionFix(
            next(iter(camera.photo_rows)), scene, camera.centers[0], WGS84, position, sigma, common, sea_level
        )
        noted.items.append(fix)
        if photo in bare:
            by_file_name.append((photo, fix))
    _refuse_moved(before, by_file_name)
    _refuse_other_days(store, by_file_name)
    strangers = [photo for photo in positions if photo not in matches.cameras and photo not in matches.left_out]
    nowhere = [photo for photo in matches.cameras if photo not in placed]
    without_height = [photo for photo, one in placed.items() if one.height_m is None]
    notes = [
        (strangers, "are in no scene of this map and were left out"),
        (nowhere, "have no position in their EXIF (WGS 84, with N or S and E or W) and were left out"),
        (without_height, "have a position without a height and were left out"),
    ]
    told = [f"{len(some)} photos in {folder} {what}, such as {Path(some[0]).name}" for some, what in notes if some]
    if matches.left_out:
        photo, other = next(iter(matches.left_out.items()))
        told.append(
            f"{len(matches.left_out)} photos in {folder} share only their file name with a camera of this map and were "
            f"left out, such as {photo}; {other} lies where its scene's photos do"
        )
    if not any(isinstance(one, PositionFix) for one in noted.items):
        raise NotFoundError(
            f"no photo in {folder} with a position and a height is a camera of this map: {'; '.join(told)}; photos go "
            "by the names that their captures' cameras have for them, and by folders called as their scenes",
            code="photos_not_matched",
        )
    if bare:
        scenes = sorted({matches.cameras[photo][0] for photo in bare})
        some = ", ".join(scenes[:3]) + (", ..." if len(scenes) > 3 else "")
        told.append(
            f"{len(bare)} photos were matched to cameras of {some} by file name alone: photos of another flight that "
            "are numbered alike would tie the map to a wrong place; folders called as the scenes rule that out"
        )
    noted.notes += told


def _refuse_moved(before: Survey, photos: Sequence[tuple[str, PositionFix]]) -> None:
    """Raise an error if a photo that was matched by file name lies far from the known position of its camera."""
    known = {(fix.name, fix.scene): fix for fix in before.fixes if fix.crs == WGS84}
    again = [(photo, known[fix.name, fix.scene], fix) for photo, fix in photos if (fix.name, fix.scene) in known]
    if not again:
        return
    places = np.array([[old.position, new.position] for _, old, new in again])
    metres = to_frame(frame_at(WGS84, places[:, 1]), places.reshape(-1, 3)).reshape(-1, 2, 3)
    off = np.linalg.norm(metres[:, 1, :2] - metres[:, 0, :2], axis=1)
    reach = [5 * sum(fix.sigma_m[0] + fix.common_sigma_m[0] for fix in (old, new)) for _, old, new in again]
    worst = int(np.argmax(off - reach))
    if off[worst] > reach[worst]:
        photo, old, _ = again[worst]
        raise InputError(
            f"{photo} has the file name of camera {old.name}, which is known to be {off[worst]:.3g} m away: if it is "
            "that camera's photo, let a folder be called as the scene; if it is of another flight, leave it out",
            code="photo_ambiguous",
        )


def _refuse_other_days(store: Store, photos: Sequence[tuple[str, PositionFix]]) -> None:
    """Raise an error if all photos that were matched to a scene by file name were taken on other days."""
    of_scene: dict[str, list[str]] = {}
    for photo, fix in photos:
        of_scene.setdefault(fix.scene, []).append(photo)
    for scene in map(store.scenes.get, of_scene):
        if scene.captured_at is None:
            continue
        captured, off = parse_moment(scene.captured_at), dict[str, int]()
        for photo in of_scene[scene.id]:
            if (taken := photo_date(photo).when) is not None:
                off[photo] = abs(parse_moment(taken) - captured).days
                if off[photo] < _OTHER_DAYS:
                    break
        else:
            if off:
                photo, days = min(off.items(), key=lambda one: one[1])
                raise InputError(
                    f"{photo} has the file name of a camera of {scene.name} and was taken {days} days from it, as were "
                    f"all {len(off)} with a date: if they are its photos, let a folder be called {scene.name}; if they "
                    "are of another flight, leave them out",
                    code="photo_ambiguous",
                )


def _bar(store: Store, a: str, b: str, metres: float, sigma_m: float | None, before: Survey) -> ScaleBar:
    """Return a scale bar, under the name of the bar between the same points if there is one: scenes are renamed."""
    if not (np.isfinite(metres) and metres > 0):
        raise ConfigError(
            f"the length of a scale bar must be a positive number of metres, got {metres:g}", code="invalid_observation"
        )
    ends: list[SpecifiedPoint] = [parse_scene_point(store, text) for text in (a, b)]
    scenes = (str(ends[0].scene), str(ends[1].scene))
    sigmas = [float(np.sqrt(np.trace(end.covariance) / 3)) for end in ends]
    # Nothing is picked to better than a ten-thousandth of what it is picked on.
    sigmas = [
        max(sigma, 1e-4 * float(np.ptp(store.scenes.get(s).bounds))) for sigma, s in zip(sigmas, scenes, strict=True)
    ]
    points = np.stack([end.point for end in ends])
    sigma = sigma_m or BAR_SIGMA_FRACTION * metres
    same = (bar.name for bar in before.bars if bar.scenes == scenes and np.array_equal(bar.points, points))
    return ScaleBar(next(same, f"{a} to {b}"), scenes, points, (sigmas[0], sigmas[1]), metres, sigma)


def take_back(store: Store, names: Iterable[str]) -> int:
    """Remove observations by name, or all observations with the CRS; return their number.

    Raises:
        NotFoundError: one of the names is none.
    """
    return store.world.remove(tuple(names))
