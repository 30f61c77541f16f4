"""Report exports, models, settings and maintenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.map.reports.common import names, refs
from gsmap.map.snapshot_read import snapshot_read
from gsmap.settings import leaves
from gsmap.store import Store
from gsmap.types import Tile
from gsmap.types.rows.exports import ExportReport, TileRow
from gsmap.types.rows.maps import ModelRow, SettingRow

if TYPE_CHECKING:
    from gsmap.export import ExportResult
    from gsmap.map.settings import Settings


@snapshot_read
def tile_rows(store: Store) -> list[TileRow]:
    """List every exported tile."""
    name_of = names(store)
    return [
        _tile_row(Path(target), tile, name_of)
        for target in store.exports.targets()
        for tile in store.exports.tiles(target)
    ]


@snapshot_read
def export_report(store: Store, out: Path, made: ExportResult, notes: Sequence[str] = ()) -> ExportReport:
    """Return the result of an export."""
    name_of = names(store)
    return ExportReport(
        out=str(out),
        tiles=tuple(_tile_row(out, tile, name_of) for tile in made.tiles if tile.path),
        recomputed=made.recomputed,
        reused=made.reused,
        removed=made.removed,
        notes=tuple(notes),
        up=next((tile.up for tile in made.tiles if tile.path), "z"),
    )


def _tile_row(out: Path, tile: Tile, name_of: Mapping[str, str]) -> TileRow:
    return TileRow(
        out=str(out),
        path=tile.path,
        component=tile.component,
        bounds=tile.bounds,
        num_gaussians=tile.num_gaussians,
        scenes=refs(tile.poses, name_of),
        merge=str(tile.recipe.get("method", "")).partition(" ")[0],
        recipe=tile.recipe,
        truncated=tile.truncated,
        sha256=tile.sha256,
        notes=tile.notes,
    )


def model_rows(store: Store) -> list[ModelRow]:
    """List the ONNX models of a map."""
    return [
        ModelRow(
            kind=model.kind,
            name=model.name,
            sha256=model.sha256,
            preset=model.options.get("preset"),
            path=str(model.path),
        )
        for model in store.models.list()
    ]


def setting_rows(settings: Settings) -> list[SettingRow]:
    """List every setting with its default, unit and meaning."""
    defaults = {leaf.name: leaf.value for leaf in leaves(type(settings)())}
    return [
        SettingRow(name=leaf.name, value=leaf.value, default=defaults.get(leaf.name), unit=leaf.unit, doc=leaf.meaning)
        for leaf in leaves(settings)
    ]
