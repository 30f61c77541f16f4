"""Row maps: the rows of a capture's Gaussians as it was ingested, and as they are kept now.

Row sets that the map keeps (of changes, of things) count the Gaussians of the capture as it was ingested: thinning
does not renumber them, and ingesting the capture again does not. Each reader and writer of kept row sets goes through
`RowMap`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import CorruptError, InputError
from gsmap.store import compact
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog
from gsmap.store.groups import manifest, unless_pruned
from gsmap.store.scene_content import thinning_of
from gsmap.store.scene_refs import find
from gsmap.store.scenes import KIND

_GONE = -1


@dataclass(frozen=True, eq=False)
class RowMap:
    """Rows of a capture as it was ingested (``whole``) and as it is kept now (``kept``).

    Args:
        num_whole: Gaussians that it was ingested with.
        num_kept: Gaussians that are kept now.
        rows: (num_kept,) whole row of each kept one, rising; None where all are kept, and where they are not known:
            an older gsmap thinned the capture and kept no row map.
    """

    num_whole: int
    num_kept: int
    rows: np.ndarray | None = None

    @property
    def is_known(self) -> bool:
        """Whether a whole row can be told from a kept one."""
        return self.rows is not None or self.num_whole == self.num_kept

    def kept(self, whole: np.ndarray) -> np.ndarray:
        """Kept rows of some whole rows, in their order; rows that are kept no longer are left out.

        None at all where the row map is not known.
        """
        if self.rows is None:
            return whole if self.is_known else _none(whole)
        place = np.full(self.num_whole, _GONE, whole.dtype)
        place[self.rows] = np.arange(self.num_kept, dtype=whole.dtype)
        found: np.ndarray = place[whole]
        found = found[found != _GONE]
        return found

    def whole(self, rows: np.ndarray, counted: int | None = None) -> np.ndarray:
        """Whole rows of some rows; none at all where the row map is not known.

        Args:
            counted: how many Gaussians the capture had when the rows were counted; default: as many as are kept.

        Raises:
            InputError: it was thinned, or ingested again, since they were counted.
        """
        counted = self.num_kept if counted is None else counted
        if counted == self.num_whole:
            return rows
        if counted != self.num_kept:
            raise InputError(
                "the capture was thinned or ingested again meanwhile: run the same again", code="changed_meanwhile"
            )
        if self.rows is None:
            return _none(rows)
        out: np.ndarray = self.rows[rows].astype(rows.dtype)
        return out

    def values_of_kept(self, values: np.ndarray) -> np.ndarray | None:
        """Values of the kept Gaussians, of values of the whole or of the kept ones; None of any other capture."""
        if len(values) == self.num_kept:
            return values
        if len(values) != self.num_whole or self.rows is None:
            return None
        found: np.ndarray = values[self.rows]
        return found

    def values_of_whole(self, values: np.ndarray, missing: int) -> np.ndarray:
        """Values of the whole capture, ``missing`` where a Gaussian is kept no longer; as they are where not known."""
        if self.rows is None or len(values) != self.num_kept:
            return values
        out = np.full(self.num_whole, missing, values.dtype)
        out[self.rows] = values
        return out


def _none(rows: np.ndarray) -> np.ndarray:
    return np.zeros(0, rows.dtype)


class RowMaps:
    """The row maps of a map's scenes."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def of(self, scene: str) -> RowMap:
        """The row map of a scene by its id; arrays are read of a thinned one alone.

        Raises:
            NotFoundError: no such scene.
            CorruptError: its bytes on disk are missing or differ.
        """
        with self._catalog.read() as connection:
            row = find(connection, scene)
            files = manifest(connection, row.group_id or "")
        thinning = thinning_of(row.thinned)
        if thinning is None:
            return RowMap(row.num_gaussians, row.num_gaussians)
        if not thinning.has_row_map or not files:
            return RowMap(thinning.num_gaussians, row.num_gaussians)
        shapes = {compact.KEPT: compact.kept_shape(thinning.num_gaussians)}
        with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
            read = self._arrays.read(KIND, row.group_id, files, only=(compact.KEPT,), shapes=shapes)
        rows = compact.unpack_kept(read[compact.KEPT], thinning.num_gaussians)
        if len(rows) != row.num_gaussians:
            raise CorruptError(
                f"scene {row.name}: its row map keeps {len(rows)} Gaussians, the catalog {row.num_gaussians}: ingest "
                "its capture again",
                code="catalog_invalid",
            )
        return RowMap(thinning.num_gaussians, row.num_gaussians, rows)
