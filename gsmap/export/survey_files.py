"""Write point clouds (LAS, LAZ), orthophotos (GeoTIFF) and floor plans (GeoJSON, DXF), as surveyors hand them over."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import ConfigError, MissingDependencyError
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians

POINT_STEP_M = 0.0005  # of coordinates in LAS files
_FAR = 300.0  # height of the camera in sizes of the picture: rays are parallel to within 0.1 degrees
_BLOCK_PX = 2048
_MODEL_PIXEL_SCALE, _MODEL_TIEPOINT, _GEO_KEYS, _GEO_TEXT = 33550, 33922, 34735, 34737
_DOUBLE, _SHORT, _TEXT = 12, 3, 2
_DXF_UNITS = {1.0: 6, 0.3048: 2, 0.3048006: 21}  # $INSUNITS: metres, feet, US survey feet
_NOT_IN_LAYERS = re.compile(r'[<>/\\":;?*|=`,\x00-\x1f]')


def require_library(path: Path) -> None:
    """Raise an error if a file cannot be written for want of a library.

    Raises:
        MissingDependencyError: laspy or lazrs (.las, .laz), or ezdxf (.dxf) is not installed.
    """
    suffix = path.suffix.lower()
    if suffix == ".dxf" and not importlib.util.find_spec("ezdxf"):
        raise MissingDependencyError(f"{path}: .dxf is written by ezdxf, which is not installed", extra="dxf")
    if suffix not in (".las", ".laz"):
        return
    if not all(importlib.util.find_spec(name) for name in ("laspy", "lazrs")):
        raise MissingDependencyError(f"{path}: .las and .laz are written by laspy, which is not installed", extra="las")


def write_points(
    path: Path, parts: Iterable[tuple[np.ndarray, Gaussians]], origin: np.ndarray, steps: np.ndarray, crs: Any
) -> int:
    """Write Gaussians as coloured points of LAS 1.4 (point format 7); return their number.

    Args:
        parts: float64 coordinates (N, 3) in the CRS, and the Gaussians that give colours and opacities (intensity).
        origin: (3,) offset of the file. steps: (3,) steps of its coordinates.
        crs: `pyproj.CRS` for the header.
    """
    import laspy

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.offsets, header.scales = origin, steps
    header.add_crs(crs)
    count = 0
    with laspy.open(path, mode="w", header=header, do_compress=path.suffix.lower().startswith(".laz")) as file:
        for points, gaussians in parts:
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            colours = np.clip(rgb_of_sh0(gaussians.sh[:, 0]), 0, 1) * 65535
            record.red, record.green, record.blue = colours.round().astype(np.uint16).T
            record.intensity = (gaussians.opacities * 65535).round().astype(np.uint16)
            record.return_number[:] = record.number_of_returns[:] = 1
            file.write_points(record)
            count += len(points)
    return count


def render_orthophoto(gaussians: Gaussians, corner: np.ndarray, size_px: tuple[int, int], pixel_m: float) -> np.ndarray:
    """Render Gaussians from above as (H, W, 4) uint8, transparent where there are none.

    Args:
        gaussians: in metres, x along the columns, y against the rows, z up.
        corner: (2,) upper left corner, x and y.
        size_px: width and height.
        pixel_m: side of a pixel in metres.
    """
    width, height = size_px
    far = _FAR * max(width, height) * pixel_m
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [*(corner + np.array([width, -height]) * pixel_m / 2), float(np.median(gaussians.means[:, 2])) + far]
    focal, index = far / pixel_m, ChunkIndex.build(gaussians)
    out = np.zeros((height, width, 4), np.uint8)
    for top in range(0, height, _BLOCK_PX):
        for left in range(0, width, _BLOCK_PX):
            block = np.array([[min(_BLOCK_PX, width - left), min(_BLOCK_PX, height - top)]])
            lens = np.array([[focal, focal, width / 2 - left, height / 2 - top]])
            image = render(gaussians, Cameras(pose[None], lens, block), depth=False, dominant_id=False, index=index)
            alpha = np.clip(np.nan_to_num(image.alpha[0]), 0, 1)
            colour = np.nan_to_num(image.colour[0]) / np.maximum(alpha, 1e-3)[..., None]
            rgba = np.concatenate([np.clip(colour, 0, 1), alpha[..., None]], axis=-1)
            out[top : top + block[0, 1], left : left + block[0, 0]] = rgba * 255 + 0.5
    return out


def write_geotiff(path: Path, rgba: np.ndarray, corner: np.ndarray, pixel: float, epsg: int, name: str) -> None:
    """Write an RGBA picture (H, W, 4) as a GeoTIFF (OGC GeoTIFF 1.1) in a projected CRS.

    Args:
        corner: (2,) easting and northing of the upper left corner. pixel: side of a pixel in the unit of the CRS.
        epsg, name: of the projected CRS.
    """
    from PIL import Image, TiffImagePlugin

    citation = f"{name.encode('ascii', 'replace').decode()}|"
    keys = [
        *(1, 1, 1, 4),  # version of the directory, of the keys, and their number
        *(1024, 0, 1, 1),  # GTModelType: projected
        *(1025, 0, 1, 1),  # GTRasterType: a pixel is an area
        *(1026, _GEO_TEXT, len(citation), 0),  # GTCitation
        *(3072, 0, 1, epsg),  # ProjectedCRS
    ]
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, value in (
        (_MODEL_PIXEL_SCALE, _DOUBLE, (pixel, pixel, 0.0)),
        (_MODEL_TIEPOINT, _DOUBLE, (0.0, 0.0, 0.0, float(corner[0]), float(corner[1]), 0.0)),
        (_GEO_KEYS, _SHORT, tuple(keys)),
        (_GEO_TEXT, _TEXT, citation),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    Image.fromarray(rgba, "RGBA").save(path, format="TIFF", compression="tiff_adobe_deflate", tiffinfo=tags)


def polygons_of(rings: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """Group closed rings (K, 2) into polygons: an outer ring (anticlockwise) and the holes in it (clockwise)."""
    outer = [ring for ring in rings if _area(ring) > 0]
    polygons = [[ring] for ring in outer]
    for hole in (ring for ring in rings if _area(ring) < 0):
        around = [k for k, ring in enumerate(outer) if _contains(ring, hole[0] + 1e-6 * (hole[1] - hole[0]))]
        if around:
            polygons[min(around, key=lambda k: _area(outer[k]))].append(hole)
    return polygons


def _area(ring: np.ndarray) -> float:
    x, y = ring.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def _contains(ring: np.ndarray, point: np.ndarray) -> bool:
    x, y = ring.T
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    crosses = (y > point[1]) != (y2 > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x + (point[1] - y) / (y2 - y) * (x2 - x)
    return bool((crosses & (at > point[0])).sum() % 2)


def write_geojson(path: Path, features: Iterable[tuple[dict[str, Any], list[list[np.ndarray]]]]) -> None:
    """Write polygons with their properties as GeoJSON (RFC 7946).

    Args:
        features: properties, and polygons of rings (K, 2) of longitudes and latitudes (WGS 84).
    """
    content = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": properties,
                "geometry": {
                    "type": "MultiPolygon",
                    "coordinates": [
                        [np.round(np.vstack([ring, ring[:1]]), 9).tolist() for ring in polygon] for polygon in polygons
                    ],
                },
            }
            for properties, polygons in features
        ],
    }
    path.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")


def write_dxf(path: Path, features: Iterable[tuple[dict[str, Any], list[list[np.ndarray]]]], unit_m: float) -> None:
    """Write the rings of polygons as closed polylines of a DXF drawing (R2010), with one layer for each feature.

    Args:
        features: properties, and polygons of rings (K, 2) of eastings and northings. Layers are named by ``kind`` and
            ``scene``.
        unit_m: metres per unit of the rings.
    """
    import ezdxf

    drawing = ezdxf.new("R2010", units=_DXF_UNITS.get(round(unit_m, 7), 0))
    space = drawing.modelspace()
    for properties, polygons in features:
        words = [str(properties[name]) for name in ("kind", "scene") if name in properties]
        layer = _NOT_IN_LAYERS.sub("_", " ".join(words))
        if layer not in drawing.layers:
            drawing.layers.add(layer)
        for ring in (ring for polygon in polygons for ring in polygon):
            space.add_lwpolyline(ring.tolist(), close=True, dxfattribs={"layer": layer})
    drawing.saveas(path, encoding="utf-8")


def pixel_size(extent: np.ndarray, wanted: float | None, longest_px: int, most_px: int) -> float:
    """Return the side of a pixel: the wanted one, or the smallest of 1, 2 or 5 times a power of ten at which a picture
    of an extent (2,) has at most ``longest_px`` pixels on a side.

    Raises:
        ConfigError: not a positive number, or more than ``most_px`` pixels in all.
    """
    if wanted is None:
        least = float(extent.max()) / longest_px
        power = 10.0 ** np.floor(np.log10(least))
        return float(next(step * power for step in (1, 2, 5, 10) if step * power >= least))
    if not (np.isfinite(wanted) and wanted > 0):
        raise ConfigError(f"the size of a pixel must be a positive number, got {wanted:g}", code="out_of_range")
    if (extent / wanted).prod() > most_px:
        raise ConfigError(
            f"an orthophoto with pixels of {wanted:g} would have {(extent / wanted).prod():,.0f} of them, more than "
            f"{most_px:,}: choose larger pixels, or a part of the map with --bbox",
            code="picture_too_large",
        )
    return wanted
