"""Convert scenes to catalog rows and arrays, and back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import Row

from gsmap.errors import InputError
from gsmap.store import compact
from gsmap.store.array_archive import StreamedArray
from gsmap.store.arrays import ChunkedArray, digest
from gsmap.store.chunk_boxes import chunk_boxes
from gsmap.store.layout import Shape
from gsmap.stream import blocks
from gsmap.types import Cameras, Gaussians, GaussianSource, Scene, Thinning
from gsmap.types.cameras import PhotoLens
from gsmap.types.gaussians import CHUNK_ROWS as ROWS_AT_ONCE
from gsmap.types.gaussians import FIELDS
from gsmap.types.scene import SceneFacts
from gsmap.types.source import origin_of_source

_FACTS = [field.name for field in fields(SceneFacts)]

LENSES = "cameras.lenses"
"""Name of the array of lenses, which only scenes have whose cameras are not those of their photos."""


def scene_id(gaussians: GaussianSource, cameras: Cameras) -> str:
    """Compute the id of a scene: 32 hex digits of its content, equal for equal Gaussians and cameras in every map.

    The origin of the Gaussians is part of the content; cameras are in the frame of the means.
    """
    shapes = gaussian_shapes(gaussians.num_gaussians, gaussians.sh_degree)
    arrays = [ChunkedArray(shapes[name], np.dtype(np.float32), partial(gaussians.columns, name)) for name in FIELDS]
    views = [cameras.T_frame_camera, cameras.intrinsics_px, cameras.sizes_px]
    origin = origin_of_source(gaussians)
    more = [origin] if origin.any() else []
    more += [lens_array(cameras)] if any(cameras.lenses) else []
    return digest(*arrays, *views, *more, text="\n".join(cameras.names))


def scene_of(row: Row[Any], tags: tuple[str, ...]) -> Scene:
    """Convert a row to a scene."""
    columns = {name: getattr(row, name) for name in _FACTS}
    return Scene(
        **columns | {"bounds": np.array(row.bounds)},
        source=row.source,
        cameras_synthesised=bool(row.cameras_synthesised),
        antialiased=bool(row.antialiased),
        tags=tags,
        thinning=thinning_of(row.thinned),
        origin=np.zeros(3) if row.origin is None else np.array(row.origin, np.float64),
    )


def thinning_of(value: dict[str, Any] | None) -> Thinning | None:
    """Parse the column of a thinned scene."""
    if value is None:
        return None
    up = value["up"]
    up = None if up is None else tuple(up)
    return Thinning(value["at"], value["num_gaussians"], up)


def shapes_of(row: Row[Any]) -> dict[str, Shape]:
    """Return the expected shapes of a scene's arrays."""
    n, c = row.num_gaussians, row.num_cameras
    shapes: dict[str, Shape] = {**gaussian_shapes(n, row.sh_degree), **stored_shapes(n, row.sh_degree)}
    if row.thinned is not None:
        shapes = compact.shapes(n, row.sh_degree)
    shapes |= {
        "cameras.T_frame_camera": (c, 4, 4),
        "cameras.intrinsics_px": (c, 4),
        "cameras.sizes_px": (c, 2),
        "cameras.names": (None,),
        LENSES: (None,),
    }
    return shapes


def gaussian_shapes(count: int, sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each field of ``count`` Gaussians."""
    n, k = count, (sh_degree + 1) ** 2
    return {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,), "sh": (n, k, 3)}


def stored_shapes(count: int, sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each stored array of ``count`` Gaussians.

    SH coefficients of degree 0 are stored apart from those of higher degrees, which registration does not read.
    """
    shapes = gaussian_shapes(count, sh_degree)
    if sh_degree:
        n, k, _ = shapes.pop("sh")
        shapes |= {"sh0": (n, 1, 3), "sh_rest": (n, k - 1, 3)}
    return shapes


def stored_names(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the names of the arrays that hold some fields of Gaussians (or ``sh0``), and of those that may.

    Older releases, and those of degree 0, stored all coefficients in one array ``sh``.
    """
    either = ["sh", "sh0", "sh_rest"] if "sh" in names else ["sh", "sh0"] if "sh0" in names else []
    return [name for name in names if name not in either], either


def fields_of(
    stored: dict[str, np.ndarray], names: Sequence[str], together: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Return fields of Gaussians (or ``sh0``) from the stored arrays of `stored_names`.

    Args:
        together: (N, K, 3) array into which ``sh0`` and ``sh_rest`` were read.
    """
    out = {name: stored[name] for name in names if name in stored}
    if "sh" in names and "sh" not in stored:
        if not {"sh0", "sh_rest"} <= set(stored) or together is None:
            raise KeyError("sh")
        out["sh"] = together
    if "sh0" in names and "sh0" not in stored:
        out["sh0"] = stored["sh"][:, :1]
    return out


class GaussianBlocks:
    """The Gaussians of a source as streamed arrays that are written block by block, each block read once.

    Args:
        source: in the order to be written.
        rows: of a block.
    """

    def __init__(self, source: GaussianSource, rows: int) -> None:
        self._blocks = blocks(source, rows)
        self._rows = rows
        self._count = 0
        self._block = Gaussians.empty()
        self._boxes: list[np.ndarray] = []
        shapes = stored_shapes(source.num_gaussians, source.sh_degree)
        self.arrays = {
            name: StreamedArray(shape, np.dtype(np.float32), partial(self._of, name)) for name, shape in shapes.items()
        }

    def boxes(self) -> np.ndarray:
        """Return the boxes (C, 2, 3) of the blocks, after all blocks have been written."""
        return np.array(self._boxes, dtype=np.float64).reshape(-1, 2, 3)

    def _of(self, name: str, start: int) -> np.ndarray:
        if start == self._rows * self._count:
            self._block = next(self._blocks)
            self._boxes.append(chunk_boxes(self._block, self._rows)[0])
            self._count += 1
        if start != self._rows * (self._count - 1):
            raise ValueError(f"rows from {start} on were read out of order")
        if name in ("sh0", "sh_rest"):
            return self._block.sh[:, :1] if name == "sh0" else self._block.sh[:, 1:]
        column: np.ndarray = getattr(self._block, name)
        return column


@dataclass(frozen=True, eq=False)
class StoredGaussians:
    """The stored Gaussians of a scene, a `GaussianSource`.

    Args:
        num_gaussians, sh_degree: as in its row.
        read: reads a range of rows.
        column: reads a range of rows of one field.
    """

    num_gaussians: int
    sh_degree: int
    read: Callable[[int, int], Gaussians]
    column: Callable[[str, int, int], np.ndarray]

    def chunks(self) -> Iterator[Gaussians]:
        for start in range(0, self.num_gaussians, ROWS_AT_ONCE):
            yield self.read(start, min(start + ROWS_AT_ONCE, self.num_gaussians))

    def columns(self, name: str) -> Iterator[np.ndarray]:
        for start in range(0, self.num_gaussians, ROWS_AT_ONCE):
            yield self.column(name, start, min(start + ROWS_AT_ONCE, self.num_gaussians))

    def load(self) -> Gaussians:
        return self.read(0, self.num_gaussians)


class UnreadGaussians(Gaussians):
    """The stored Gaussians of a scene, of which each field is read whenever it is used, and none is kept.

    `load` reads them all at once, ``degree_0`` no higher coefficients.
    """

    @classmethod
    def of(cls, count: int, sh_degree: int, read: Callable[[Sequence[str]], dict[str, np.ndarray]]) -> UnreadGaussians:
        """Return Gaussians that are read by ``read(names)``, where ``sh0`` names the coefficients of degree 0."""
        out: UnreadGaussians = object.__new__(cls)
        out.__dict__.update(origin=np.zeros(3), _count=count, _degree=sh_degree, _read=read)
        return out

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in FIELDS or "_read" not in self.__dict__:
            raise AttributeError(name)
        found: np.ndarray = self.__dict__["_read"]([name])[name]
        return found

    def __len__(self) -> int:
        return int(self.__dict__["_count"])

    @property
    def num_gaussians(self) -> int:
        return len(self)

    @property
    def sh_degree(self) -> int:
        return int(self.__dict__["_degree"])

    def load(self) -> Gaussians:
        return Gaussians(**self.__dict__["_read"](FIELDS))

    def degree_0(self, mask: np.ndarray | None = None) -> Gaussians:
        rows = None if mask is None else np.flatnonzero(mask)
        parts = []
        for name in (*FIELDS[:-1], "sh0"):  # one by one: memory for one field of the whole scene at a time
            column = self.__dict__["_read"]([name])[name]
            parts.append(column if rows is None else column.take(rows, axis=0))
        return Gaussians(*parts)


def camera_arrays(cameras: Cameras) -> dict[str, np.ndarray]:
    """Return the arrays of a scene's cameras by name."""
    for name in cameras.names:
        if "\n" in name:
            raise InputError(f"camera name {name!r} has a line break", code="invalid_name")
    arrays = {
        "cameras.T_frame_camera": cameras.T_frame_camera,
        "cameras.intrinsics_px": cameras.intrinsics_px,
        "cameras.sizes_px": cameras.sizes_px,
        "cameras.names": np.frombuffer("\n".join(cameras.names).encode(), np.uint8),
    }
    return arrays | ({LENSES: lens_array(cameras)} if any(cameras.lenses) else {})


def lens_array(cameras: Cameras) -> np.ndarray:
    """Return the lenses of cameras as the bytes of a JSON list, an object or null for each camera."""
    lenses = [
        None
        if lens is None
        else {
            "photo": lens.photo,
            "model": lens.model.name,
            "size_px": lens.model.size_px,
            "params": lens.model.params,
            "R_photo_camera": lens.R_photo_camera.tolist(),
        }
        for lens in cameras.lenses
    ]
    return np.frombuffer(json.dumps(lenses, separators=(",", ":")).encode(), np.uint8)


def lenses_of(array: np.ndarray, count: int) -> tuple[PhotoLens | None, ...]:
    """Parse the lenses of ``count`` cameras; see `lens_array`.

    Raises:
        ValueError, TypeError, KeyError, RuntimeError: it is no such list.
    """
    listed = json.loads(array.tobytes())
    if not isinstance(listed, list) or len(listed) != count:
        raise ValueError(f"they are no list of {count} lenses")
    return tuple(None if one is None else _lens(one) for one in listed)


def _lens(about: dict[str, Any]) -> PhotoLens:
    from gsmap.geometry.camera_models import camera_model  # few scenes have lenses

    width, height = (int(side) for side in about["size_px"])
    turn = np.array(about["R_photo_camera"], np.float64)
    if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or min(width, height) < 1:
        raise ValueError("a lens has no rotation, or no size")
    model = camera_model(str(about["model"]), width, height, tuple(float(value) for value in about["params"]))
    return PhotoLens(str(about["photo"]), model, turn)
