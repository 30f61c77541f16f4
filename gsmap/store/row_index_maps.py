"""Map between rows of a capture's Gaussians as they were ingested and as they are stored now.

Row sets that a map stores (of changes, of segments) refer to the Gaussians of the capture as ingested, so that neither
thinning nor another ingest renumbers them. All readers and writers of stored row sets use `RowIndexMap`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import CorruptError, InputError
from gsmap.store import compact
from gsmap.store.array_groups import manifest, unless_pruned
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog
from gsmap.store.scene_content import thinning_of
from gsmap.store.scene_refs import find
from gsmap.store.scenes import KIND

_GONE = -1


@dataclass(frozen=True, eq=False)
class RowIndexMap:
    """A mapping between rows of a capture as ingested (``whole``) and as stored now (``kept``).

    Args:
        num_whole: number of Gaussians as ingested.
        num_kept: number of Gaussians stored now.
        rows: (num_kept,) whole row of each kept one, ascending; None if all are kept, or once the arrays are pruned.
    """

    num_whole: int
    num_kept: int
    rows: np.ndarray | None = None

    @property
    def is_known(self) -> bool:
        """Return True if the mapping is known, so that rows can be converted."""
        return self.rows is not None or self.num_whole == self.num_kept

    def kept(self, whole: np.ndarray) -> np.ndarray:
        """Convert whole rows to kept rows, in order, without rows that are no longer stored.

        Empty if the mapping is unknown.
        """
        if self.rows is None:
            return whole if self.is_known else _empty(whole)
        place = np.full(self.num_whole, _GONE, whole.dtype)
        place[self.rows] = np.arange(self.num_kept, dtype=whole.dtype)
        found: np.ndarray = place[whole]
        found = found[found != _GONE]
        return found

    def whole(self, rows: np.ndarray, counted: int | None = None) -> np.ndarray:
        """Convert kept (or whole) rows to whole rows; return no rows if the mapping is unknown.

        Args:
            counted: number of Gaussians of the capture that the rows refer to; default: as many as are kept.

        Raises:
            InputError: the capture was thinned or ingested again since.
        """
        counted = self.num_kept if counted is None else counted
        if counted == self.num_whole:
            return rows
        if counted != self.num_kept:
            raise InputError(
                "the capture was thinned or ingested again meanwhile: run the same command again",
                code="changed_meanwhile",
            )
        if self.rows is None:
            return _empty(rows)
        out: np.ndarray = self.rows[rows].astype(rows.dtype)
        return out

    def values_of_kept(self, values: np.ndarray) -> np.ndarray | None:
        """Return the values of kept rows, from values of kept or of whole rows; None if the length fits neither."""
        if len(values) == self.num_kept:
            return values
        if len(values) != self.num_whole or self.rows is None:
            return None
        found: np.ndarray = values[self.rows]
        return found

    def values_of_whole(self, values: np.ndarray, missing: int) -> np.ndarray:
        """Expand values of kept rows to whole rows, with ``missing`` elsewhere; unchanged if the mapping is unknown."""
        if self.rows is None or len(values) != self.num_kept:
            return values
        out = np.full(self.num_whole, missing, values.dtype)
        out[self.rows] = values
        return out


def _empty(rows: np.ndarray) -> np.ndarray:
    return np.zeros(0, rows.dtype)


class RowIndexMaps:
    """The row mappings of a map's scenes."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def of(self, scene: str) -> RowIndexMap:
        """Return the row mapping of a scene by its id; reads arrays only for a thinned scene.

        Raises:
            NotFoundError: no such scene.
            CorruptError: bytes on disk are missing or differ.
        """
        with self._catalog.read() as connection:
            row = find(connection, scene)
            files = manifest(connection, row.group_id or "")
        thinning = thinning_of(row.thinned)
        if thinning is None:
            return RowIndexMap(row.num_gaussians, row.num_gaussians)
        if not files:
            return RowIndexMap(thinning.num_gaussians, row.num_gaussians)
        shapes = {compact.KEPT: compact.kept_shape(thinning.num_gaussians)}
        with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
            read = self._arrays.read(KIND, row.group_id, files, only=(compact.KEPT,), shapes=shapes)
        rows = compact.unpack_kept(read[compact.KEPT], thinning.num_gaussians)
        if len(rows) != row.num_gaussians:
            raise CorruptError(
                f"scene {row.name}: its row index map has {len(rows)} Gaussians, but the catalog records "
                f"{row.num_gaussians}: ingest its capture again",
                code="catalog_invalid",
            )
        return RowIndexMap(thinning.num_gaussians, row.num_gaussians, rows)
