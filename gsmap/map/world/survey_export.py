"""Survey export stage: write the merged map as a point cloud, an orthophoto or a floor plan in a CRS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsmap.durable import write_output
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.export.survey_files import (
    POINT_STEP_M,
    pixel_size,
    polygons_of,
    render_orthophoto,
    require_library,
    write_dxf,
    write_geojson,
    write_geotiff,
    write_points,
)
from gsmap.geodesy.crs import WGS84, crs
from gsmap.geodesy.frame import from_frame
from gsmap.geometry.boxes import robust_box
from gsmap.geometry.transforms import transform_gaussians
from gsmap.map.georeferenced_components import GeoreferencedComponent, world_notes
from gsmap.map.pictures.floor_plans import read_scene
from gsmap.map.settings import Settings
from gsmap.map.stages.export import ExportPlan, FindOmitted, Request, make_content, plan
from gsmap.report import PlanScene, make_plan
from gsmap.report.plan import rings
from gsmap.store import Store
from gsmap.types import Gaussians, Sim3
from gsmap.types.progress import Progress
from gsmap.types.world import WorldFrame

KINDS = {
    **dict.fromkeys((".las", ".laz"), "points"),
    **dict.fromkeys((".tif", ".tiff"), "orthophoto"),
    **dict.fromkeys((".geojson", ".dxf"), "floor plan"),
}
"""Kind of file by suffix."""

_SOLID = 0.3  # opacity from which a Gaussian is a point of the surface
_LONGEST_PX, _MOST_PX = 8192, 200_000_000
_FOOTPRINT_POINTS = 1_000_000  # sampled of a scene
_ABOVE_EYES = 0.3  # height shown above the cameras, as a fraction of their height above the floor
_WALL_BAND = (0.4, 0.9)  # of the height of the cameras above the floor, at which walls are cut
_EYES_M = 1.6  # height of cameras above the floor where a map has none
_WALL_CELL_M = 0.05
_LEAST_WALL_CELLS = 8
_MAX_WALL_SCALE_M = 0.3


@dataclass(frozen=True)
class SurveyOptions:
    """Options of a survey export.

    Args:
        crs: CRS of the file; None for that of the map. GeoJSON is in longitude and latitude (WGS 84) always.
        pixel_size: side of a pixel of an orthophoto, in the unit of the CRS; None for at most 8192 pixels on a side.
    """

    crs: str | None = None
    pixel_size: float | None = None


def export_survey(
    store: Store,
    out: Path,
    request: Request,
    options: SurveyOptions,
    settings: Settings,
    progress: Progress,
    find_omitted: FindOmitted | None = None,
) -> tuple[str, ...]:
    """Write one georeferenced component of the merged map as the kind of file that the suffix of ``out`` names.

    Returns:
        Notes for the user.

    Raises:
        NotFoundError: no component, or not this one, is georeferenced.
        ConfigError: several are, and none was chosen; or options that do not fit the kind of file.
    """
    kind = KINDS[out.suffix.lower()]
    if options.pixel_size is not None and kind != "orthophoto":
        raise ConfigError(f"--pixel-size applies to orthophotos (.tif), not to a {kind}", code="option_not_applicable")
    if options.crs is not None and out.suffix.lower() == ".geojson":
        raise ConfigError(
            "--crs does not apply to GeoJSON, whose coordinates are longitude and latitude (RFC 7946)",
            code="option_not_applicable",
        )
    require_library(out)
    planned = plan(store, replace(request, format="ply", up="z"), settings, find_omitted)
    component, placed = _component(planned, request.component)
    planned = replace(planned, tiles=[tile for tile in planned.tiles if tile.component == component])
    parts = _parts(store, planned, settings, placed, progress)
    system = options.crs or placed.frame.crs
    is_drawing = out.suffix.lower() == ".dxf"
    if kind == "orthophoto" or is_drawing:
        epsg = _projected_epsg(system, "a drawing" if is_drawing else "an orthophoto")
    if kind == "points":
        notes = _write_points(out, parts, placed.frame, system)
    else:
        eyes = _eyes(store, planned, placed)
        whole = Gaussians.concatenate(list(parts))
        if kind == "orthophoto":
            notes = _write_orthophoto(out, whole, eyes, placed, system, epsg, options.pixel_size)
        else:
            footprints = _footprints(store, planned, placed)
            notes = _write_floor_plan(out, whole, eyes, placed, system if is_drawing else WGS84, footprints)
    of_tiles = world_notes(planned.world, planned.recipe.format, planned.recipe.up)
    return (*(note for note in planned.notes if note not in of_tiles), *notes)


def _projected_epsg(system: str, what: str) -> int:
    """Return the EPSG code of a CRS; raise an error for one without eastings and northings, before scenes are read."""
    here = crs(system)
    if here.projected_epsg is None:
        raise ConfigError(
            f"{what} needs a projected CRS with an EPSG code, and {here.text} is none: choose one with --crs",
            code="unsupported_crs",
        )
    return here.projected_epsg


def _component(planned: ExportPlan, wanted: int | None) -> tuple[int, GeoreferencedComponent]:
    if not planned.world:
        which = "the map" if wanted is None else f"component {wanted}"
        raise NotFoundError(
            f"{which} is not georeferenced: add control points or GNSS positions (gsmap georeference)",
            code="not_georeferenced",
        )
    if len(planned.world) > 1:
        raise ConfigError(
            f"components {', '.join(map(str, sorted(planned.world)))} are georeferenced: choose one with --component",
            code="missing_option",
        )
    return next(iter(planned.world.items()))


def _parts(
    store: Store, planned: ExportPlan, settings: Settings, placed: GeoreferencedComponent, progress: Progress
) -> Iterator[Gaussians]:
    """Yield the merged Gaussians of each tile in the world frame: metres east, north and up."""
    with TemporaryDirectory(prefix="gsmap-survey-") as folder:
        for number, tile in enumerate(planned.tiles):
            progress(number / len(planned.tiles), f"tile {number + 1} of {len(planned.tiles)}")
            made = make_content(store, planned, settings, tile, folder)(lambda fraction, text: None)
            yield transform_gaussians(made.gaussians, placed.S_world_map)


def _eyes(store: Store, planned: ExportPlan, placed: GeoreferencedComponent) -> np.ndarray:
    """Return the centres (N, 3) of all real cameras in the world frame."""
    poses = {scene: S for tile in planned.tiles for scene, S in tile.poses.items()}
    found = [(store.scenes.cameras(scene), S) for scene, S in sorted(poses.items())]
    eyes = [placed.S_world_map.apply(S.apply(cameras.centers)) for cameras, S in found if not cameras.synthesised]
    return np.concatenate([np.zeros((0, 3)), *eyes])


def _solid(gaussians: Gaussians) -> Gaussians:
    return gaussians[np.flatnonzero(gaussians.opacities >= _SOLID)]


def _write_points(out: Path, parts: Iterator[Gaussians], frame: WorldFrame, system: str) -> tuple[str, ...]:
    here = crs(system)
    origin = np.round(from_frame(frame, np.zeros((1, 3)), system)[0])
    # A step of a millimetre in each axis of the CRS, whose unit may be a degree.
    away = from_frame(frame, np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), system)
    steps = POINT_STEP_M * np.abs(away[1:] - away[0]).max(0)
    solid = map(_solid, parts)
    coordinates = ((from_frame(frame, part.means, system), part) for part in solid if len(part))
    count = 0

    def write(path: Path) -> None:
        nonlocal count
        count = write_points(path, coordinates, origin, steps, here.named)

    write_output(out, write)
    return (
        f"{count} points in {here.text}: Gaussians with an opacity of at least {_SOLID}; heights are {here.heights}",
    )


def _write_orthophoto(
    out: Path,
    whole: Gaussians,
    eyes: np.ndarray,
    placed: GeoreferencedComponent,
    system: str,
    epsg: int,
    pixel: float | None,
) -> tuple[str, ...]:
    """Write an orthophoto with pixels of ``pixel`` units of the CRS; None selects their size."""
    here = crs(system)
    shown, note = _below_ceiling(whole, eyes)
    corners = robust_box(shown.means.astype(np.float64), outside=0.002)
    box = np.array([[x, y, 0.0] for x in corners[:, 0] for y in corners[:, 1]])
    target = from_frame(placed.frame, box, system)
    flat = _plane_similarity(box[:, :2], target[:, :2])  # convergence, scale, unit
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    pixel = pixel_size(high - low, pixel, _LONGEST_PX, _MOST_PX)
    off = np.linalg.norm(flat.apply(box)[:, :2] - target[:, :2], axis=1).max()
    if off > pixel:
        raise InputError(
            f"over this area, the CRS bends by {off:.3g} of its units, more than a pixel ({pixel:g}): choose larger "
            "pixels, or a part of the map with --bbox",
            code="precision_loss",
        )
    corner = np.array([np.floor(low[0] / pixel), np.ceil(high[1] / pixel)]) * pixel
    size = np.ceil((np.array([high[0], corner[1]]) - np.array([corner[0], low[1]])) / pixel).astype(int)
    # Rendered in metres along the axes of the CRS, about the corner.
    S = Sim3(flat.rotation, (flat.translation - [*corner, 0]) / flat.scale, 1.0)
    rgba = render_orthophoto(
        transform_gaussians(shown, S), np.zeros(2), (int(size[0]), int(size[1])), pixel / flat.scale
    )
    write_output(out, lambda path: write_geotiff(path, rgba, corner, pixel, epsg, here.name))
    return (f"{size[0]} x {size[1]} pixels of {pixel:g} in {here.text}{note}",)


def _plane_similarity(points: np.ndarray, target: np.ndarray) -> Sim3:
    """Fit a similarity of the plane (scale, rotation about z, translation) to points and their targets (N, 2)."""
    middle, aim = points.mean(0), target.mean(0)
    a, b = ((p - m) @ [1, 1j] for p, m in ((points, middle), (target, aim)))
    turn = (a.conj() @ b) / (a.conj() @ a)
    scale = abs(turn)
    c, s = turn.real / scale, turn.imag / scale
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Sim3(rotation, np.array([*aim, 0]) - scale * rotation @ [*middle, 0], float(scale))


def _below_ceiling(whole: Gaussians, eyes: np.ndarray) -> tuple[Gaussians, str]:
    """Return the Gaussians that are not well above the cameras, as ceilings are, and a note."""
    if not len(eyes):
        return whole, ""
    floor, eye = float(np.quantile(whole.means[:, 2], 0.02)), float(np.median(eyes[:, 2]))
    ceiling = eye + _ABOVE_EYES * max(eye - floor, 0.0)
    below = whole.means[:, 2] < ceiling
    if below.mean() > 0.999:
        return whole, ""
    return whole[np.flatnonzero(below)], f"; what is more than {ceiling - floor:.2f} m above the floor is left out"


def _write_floor_plan(
    out: Path,
    whole: Gaussians,
    eyes: np.ndarray,
    placed: GeoreferencedComponent,
    system: str,
    footprints: Iterator[tuple[dict[str, object], Sequence[np.ndarray]]],
) -> tuple[str, ...]:
    here, is_drawing = crs(system), out.suffix.lower() == ".dxf"

    def in_crs(ring: np.ndarray) -> np.ndarray:
        return from_frame(placed.frame, np.c_[ring, np.zeros(len(ring))], system)[:, :2]

    features = []
    for properties, found in (*footprints, *_walls(whole, eyes)):
        polygons = [[in_crs(ring) for ring in polygon] for polygon in polygons_of(found)]
        if polygons:
            features.append((properties, polygons))
    write = partial(write_dxf, unit_m=here.unit_m) if is_drawing else write_geojson
    write_output(out, lambda path: write(path, features))
    kinds = [properties["kind"] for properties, _ in features]
    return (
        f"{kinds.count('footprint')} footprints of scenes and {kinds.count('walls')} cross section of walls, in "
        + (here.text if is_drawing else "longitude and latitude (WGS 84)"),
    )


def _footprints(
    store: Store, planned: ExportPlan, placed: GeoreferencedComponent
) -> Iterator[tuple[dict[str, object], Sequence[np.ndarray]]]:
    poses = {scene: S for tile in planned.tiles for scene, S in tile.poses.items()}
    for scene, S in sorted(poses.items(), key=lambda one: planned.scenes[one[0]].name):
        about = planned.scenes[scene]
        points = placed.S_world_map.apply(S.apply(read_scene(store, about, whole=True, most=_FOOTPRINT_POINTS).points))
        drawn = make_plan([PlanScene(about.name, "placed", points, np.zeros((0, 3)), points.mean(0))], [], None)
        if drawn is None:
            continue
        turn = drawn.R_plan_map[:2, :2]
        yield (
            {"kind": "footprint", "scene": about.name, "captured_at": about.captured_at},
            [ring @ turn for ring in drawn.footprints[0]],
        )


def _walls(whole: Gaussians, eyes: np.ndarray) -> Iterator[tuple[dict[str, object], Sequence[np.ndarray]]]:
    """Yield the horizontal cross section of what stands between the floor and the height of the cameras."""
    from scipy import ndimage

    solid = _solid(whole)
    solid = solid[np.flatnonzero(solid.scales.max(1) < _MAX_WALL_SCALE_M)]
    if not len(solid):
        return
    floor = float(np.quantile(solid.means[:, 2], 0.02))
    eye = float(np.median(eyes[:, 2])) - floor if len(eyes) else _EYES_M
    low, high = (floor + share * eye for share in _WALL_BAND)
    band = solid.means[(solid.means[:, 2] > low) & (solid.means[:, 2] < high), :2].astype(np.float64)
    if not len(band):
        return
    start = band.min(0) - 2 * _WALL_CELL_M
    cells = np.floor((band - start) / _WALL_CELL_M).astype(int)
    mask = np.zeros(cells.max(0) + 3, bool)
    mask[cells[:, 0], cells[:, 1]] = True
    mask = ndimage.binary_closing(mask)
    patches, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    mask &= np.bincount(patches.ravel())[patches] >= _LEAST_WALL_CELLS
    found = [_corners(ring) * _WALL_CELL_M + start for ring in rings(mask)]
    yield {"kind": "walls", "above_floor_m": [round(low - floor, 3), round(high - floor, 3)]}, found


def _corners(ring: np.ndarray) -> np.ndarray:
    """Return the vertices (K, 2) of a ring at which it turns."""
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    result: np.ndarray = ring[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]]
    return result
