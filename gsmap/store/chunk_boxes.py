"""Bounding boxes of chunks of Gaussians, by which chunks that touch a region are found without reading them."""

from __future__ import annotations

import numpy as np
from sqlalchemy import Connection, text

from gsmap.errors import InputError, StoreError
from gsmap.geometry.voxels import reached_box
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.schema import CHUNK_BOXES
from gsmap.types import Gaussians


def chunk_boxes(gaussians: Gaussians, rows: int, *, sigmas: float = 3.0) -> np.ndarray:
    """Compute boxes (C, 2, 3) float64 around all chunks of ``rows`` Gaussians, extended by ``sigmas`` deviations."""
    parts = (gaussians[start : start + rows] for start in range(0, len(gaussians), rows))
    return np.array([reached_box(part, sigmas) for part in parts]).reshape(-1, 2, 3)


def put_boxes(connection: Connection, number: int, boxes: np.ndarray) -> None:
    """Store the boxes (C, 2, 3) of a scene's chunks in place of the previous boxes."""
    if number >= 1 << 24:  # float32 coordinates of the R*Tree represent integers exactly up to 2**24
        raise StoreError("a map can have at most 16 million scenes", code="too_many_scenes")
    connection.execute(text(f"DELETE FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s"), {"s": number})
    rows = [
        {"s": number, "chunk": i}
        | {f"{axis}{side}": float(box[side, k]) for side in (0, 1) for k, axis in enumerate("xyz")}
        for i, box in enumerate(boxes)
    ]
    connection.execute(
        text(
            f"INSERT INTO {CHUNK_BOXES} (s0, s1, x0, x1, y0, y1, z0, z1, chunk) "
            "VALUES (:s, :s, :x0, :x1, :y0, :y1, :z0, :z1, :chunk)"
        ),
        rows,
    )


def get_boxes(connection: Connection, number: int) -> np.ndarray:
    """Return the boxes (C, 2, 3) of a scene's chunks."""
    query = text(f"SELECT x0, y0, z0, x1, y1, z1 FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s ORDER BY chunk")
    rows = [list(row) for row in connection.execute(query, {"s": number})]
    return np.array(rows, dtype=np.float64).reshape(-1, 2, 3)


def chunks_touching(connection: Connection, number: int, bounds: np.ndarray) -> list[int]:
    """Return the numbers of the chunks whose boxes intersect a (2, 3) box in the scene frame."""
    if bounds.shape != (2, 3):
        raise InputError(
            f"bounds must be (2, 3): lowest and highest corner, got shape {bounds.shape}", code="invalid_box"
        )
    query = text(
        f"SELECT chunk FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s AND x1 >= :x0 AND x0 <= :x1 "
        "AND y1 >= :y0 AND y0 <= :y1 AND z1 >= :z0 AND z0 <= :z1 ORDER BY chunk"
    )
    box = {f"{axis}{side}": float(bounds[side, k]) for side in (0, 1) for k, axis in enumerate("xyz")}
    return list(connection.execute(query, {"s": number, **box}).scalars())


def row_ranges(chunks: list[int], count: int) -> list[tuple[int, int]]:
    """Return the row ranges of chunks, merging adjacent ones."""
    out: list[tuple[int, int]] = []
    for chunk in chunks:
        start, stop = chunk * CHUNK_ROWS, min(count, (chunk + 1) * CHUNK_ROWS)
        if out and out[-1][1] == start:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out
