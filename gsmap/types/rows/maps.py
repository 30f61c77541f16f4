"""Rows about a whole map: open tasks, settings, models, maintenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.rows.leases import LeaseRow

TodoKind = Literal[
    "undescribed",
    "stale_graphs",
    "unregistered",
    "stale_edges",
    "unsolved",
    "stale_poses",
    "dirty_tiles",
    "tentative",
    "one_pair",
    "undecided",
    "changes",
    "contradicted_priors",
    "world_outliers",
    "untied",
    "duplicates",
    "isolated",
    "set_aside",
]


_FOR_A_PERSON: tuple[TodoKind, ...] = (
    "tentative",
    "one_pair",
    "undecided",
    "changes",
    "contradicted_priors",
    "world_outliers",
    "untied",
    "duplicates",
    "isolated",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class TodoRow(Row):
    """An open task: a stale or missing result, or an open decision.

    Args:
        what: ``undescribed`` scenes; ``stale_graphs`` of other settings or versions; ``unregistered`` scenes;
            ``stale_edges``; ``unsolved`` (inputs newer than the poses); ``stale_poses``; ``dirty_tiles`` of an export;
            ``tentative`` scenes in doubt; scenes that ``one_pair`` places, which nothing contradicts; ``undecided``
            edges; unreviewed ``changes``; ``contradicted_priors``; ``world_outliers`` (contradicting observations of
            the world); ``untied`` components without a place in the world; ``duplicates`` (pairs of the same capture);
            ``isolated`` scenes; ``set_aside`` (quarantined jobs, retried by name, and unreadable captures, retried when
            given again).
        count: number of items; 1 for ``unsolved``, ``stale_poses`` and ``set_aside``.
        verb: command that resolves it.
        meaning: description.
    """

    columns: ClassVar[Mapping[str, str]] = {"count": "count", "meaning": "what", "verb": "helps"}

    what: TodoKind
    count: int
    verb: str
    meaning: str

    @property
    def wants_person(self) -> bool:
        """True if a person has to decide; false if running the command suffices."""
        return self.what in _FOR_A_PERSON


@dataclass(frozen=True, eq=False, kw_only=True)
class MetricScaleRow(Row):
    """The metric scale of a component.

    Args:
        component: component index.
        metres_per_unit: metres per unit of its frame, which poses and tiles use.
        metre_sigma: standard deviation of its logarithm (0.01 is one percent); null if unknown.
        metre_known_by: ``surveyed`` (control points, positions or scale bars), ``measured`` (captures specified to be
            in metres), ``told`` (metres per unit specified by the user), ``assumed`` (the captures' unit may be the
            metre), ``guessed`` (from distances between cameras and surfaces), ``unknown`` (1 is used).
        metre_note: remark, or empty.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "metres_per_unit": "m per unit",
        "metre_known_by": "known by",
        "metre_sigma": "sigma",
        "metre_note": "note",
    }

    component: int
    metres_per_unit: float
    metre_sigma: float | None
    metre_known_by: str
    metre_note: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class MapStatus(Row):
    """The status of a map with its open tasks, most urgent first.

    Args:
        todo: open tasks; empty if there are none.
        scenes: number of scenes.
        components: number of connected components of the newest poses.
        islands: the number of components under an older name.
        tentative: number of scenes placed by edges without an agreeing cycle.
        one_pair: number of these that single pairs place, which nothing contradicts.
        revision: number of the newest revision; null before the first.
        metres_per_unit: metres per unit of the largest component; null if unknown.
        metres: metric scale of every component.
        at_work: work of the other running processes.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scenes": "scenes",
        "components": "components",
        "tentative": "tentative",
        "revision": "revision",
        "metres_per_unit": "metres per unit",
    }

    todo: tuple[TodoRow, ...]
    scenes: int
    components: int
    islands: int
    tentative: int
    one_pair: int = 0
    revision: int | None
    metres_per_unit: float | None
    metres: tuple[MetricScaleRow, ...] = ()
    at_work: tuple[LeaseRow, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class SettingRow(Row):
    """A setting.

    Args:
        name: dotted name for ``--set``.
        value: value in this map.
        default: default value.
        unit: unit of the value, or empty.
        doc: meaning.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "name": "setting",
        "value": "value",
        "default": "default",
        "unit": "unit",
        "doc": "meaning",
    }

    name: str
    value: Any
    default: Any
    unit: str
    doc: str


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelRow(Row):
    """An ONNX model of the map.

    Args:
        kind: ``sam-encoder``, ``sam-decoder`` or ``clip``.
        name: name in the map.
        sha256: digest of the file.
        preset: pixel normalization.
        path: path of the file.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "kind": "kind",
        "name": "name",
        "preset": "preset",
        "sha256": "sha256",
        "path": "file",
    }

    kind: str
    name: str
    sha256: str
    preset: str | None
    path: str


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckReport(Row):
    """The result of checking every byte of the map.

    Args:
        ok: true if there are no problems.
        problems: problems, one line each.
        orphans: harmless folders left by interrupted work, which `gsmap prune` removes.
        num_groups: number of array groups read.
        num_bytes: number of bytes read.
        unverified: data without a stored digest, with the reason.
    """

    columns: ClassVar[Mapping[str, str]] = {"num_groups": "groups", "num_bytes": "bytes", "ok": "ok"}

    ok: bool
    problems: tuple[str, ...]
    orphans: tuple[str, ...] = ()
    num_groups: int = 0
    num_bytes: int = 0
    unverified: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class PruneReport(Row):
    """The result of a prune, or its preview.

    Args:
        dry_run: true if nothing was deleted.
        scene_names: names of removed scenes whose arrays are deleted.
        revisions: numbers of the revisions that are deleted.
        num_graphs: number of deleted graphs.
        num_orphans: number of deleted folders of interrupted work.
        num_models: number of deleted copies of removed models.
        num_bytes: bytes freed on disk; a dry run does not count the catalog.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "num_graphs": "graphs",
        "num_orphans": "left over",
        "num_bytes": "bytes",
    }

    dry_run: bool = False
    scene_names: tuple[str, ...] = ()
    revisions: tuple[int, ...] = ()
    num_graphs: int = 0
    num_orphans: int = 0
    num_models: int = 0
    num_bytes: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class InitReport(Row):
    """A new map.

    Args:
        map: folder of the map.
        catalog: URL of the database that holds its catalog, without a password; null where the folder holds it.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "catalog": "catalog"}

    map: str
    catalog: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class MigrateReport(Row):
    """The schema of a map before and after a migration.

    Args:
        map: folder of the map.
        before: schema before; null if it had none.
        after: schema after.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "before": "before", "after": "after"}

    map: str
    before: str | None
    after: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ConvertReport(Row):
    """A converted file.

    Args:
        input: input file.
        output: output file.
        num_gaussians: number of Gaussians it holds.
        sh_degree: degree of the spherical harmonics of the input.
        offset: (3,) offset subtracted from the coordinates (``--local``); else zeros.
    """

    columns: ClassVar[Mapping[str, str]] = {"output": "file", "num_gaussians": "Gaussians", "sh_degree": "SH degree"}

    input: str
    output: str
    num_gaussians: int
    sh_degree: int
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False, kw_only=True)
class CleanReport(Row):
    """A cleaned file.

    Args:
        input: input file.
        output: output file.
        num_gaussians: number of Gaussians it holds.
        num_invalid: number of removed Gaussians with NaN, an infinity that is no value, or a rotation of zero.
        num_oversized: number of removed Gaussians with an impossible scale.
        num_outside: number of removed Gaussians outside the box.
        num_background: number of removed Gaussians in a shell far around all surfaces.
        num_floaters: number of removed Gaussians that belong to no surface.
        is_judged: false if the Gaussians do not overlap into surfaces, so that floaters and background cannot be told.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "num_gaussians": "Gaussians",
        "num_invalid": "invalid",
        "num_oversized": "oversized",
        "num_outside": "outside",
        "num_background": "background",
        "num_floaters": "floaters",
    }

    input: str
    output: str
    num_gaussians: int
    num_invalid: int
    num_oversized: int
    num_outside: int
    num_background: int
    num_floaters: int
    is_judged: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewReport(Row):
    """An interactive page that is served or was written.

    Args:
        url: local address with the token that opens the page; null if it was written.
        path: folder or file of the page; null if it is served.
        num_bytes: size of the written page; null if it is served.
        num_scenes: number of scenes with levels of detail in the written page; null if it is served.
        notes: remarks, such as scenes that could not be read.
    """

    columns: ClassVar[Mapping[str, str]] = {"url": "page", "path": "written to"}

    url: str | None = None
    path: str | None = None
    num_bytes: int | None = None
    num_scenes: int | None = None
    notes: tuple[str, ...] = ()
