"""A map as a whole: what is to do, settings, models, upkeep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.rows.exports import TileRow
from gsmap.types.rows.leases import AtWorkRow
from gsmap.types.rows.pairs import EdgeRow
from gsmap.types.rows.scenes import SceneRow
from gsmap.types.rows.truth import EvaluationReport

TodoKind = Literal[
    "undescribed",
    "stale_graphs",
    "unregistered",
    "stale_edges",
    "unsolved",
    "stale_poses",
    "dirty_tiles",
    "tentative",
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
    """Something that is stale or wants a person.

    Args:
        what: ``undescribed`` scenes; ``stale_graphs``, made by other settings or another version; ``unregistered``
            scenes, never tried with another one; ``stale_edges``; ``unsolved`` (scenes, edges, reviews, priors or
            observations are newer than the poses); ``stale_poses``; ``dirty_tiles`` of an export; ``tentative`` scenes;
            ``undecided`` edges; ``changes`` that nobody confirmed or rejected; ``contradicted_priors``;
            ``world_outliers``, observations of the world that contradict the others; ``untied`` components, whose place
            in the world is not determined; ``duplicates``, pairs that are one capture twice; ``isolated`` scenes;
            ``set_aside``, work that twice ended the process it ran in and is left out until it is asked for by name, or
            a capture that could not be read and is tried again whenever it is given.
        count: how many; 1 for ``unsolved``, ``stale_poses`` and ``set_aside``.
        verb: the command that helps.
        meaning: the same in words.
    """

    columns: ClassVar[Mapping[str, str]] = {"count": "count", "meaning": "what", "verb": "helps"}

    what: TodoKind
    count: int
    verb: str
    meaning: str

    @property
    def wants_person(self) -> bool:
        """Whether a person has to judge or decide; the rest is work that the command does."""
        return self.what in _FOR_A_PERSON


@dataclass(frozen=True, eq=False, kw_only=True)
class MetreRow(Row):
    """How long a metre is in the frame of a component, how that is known, and how well.

    Args:
        component: its index.
        metres_per_unit: metres in a unit of its frame: of its poses and of its tiles.
        metre_sigma: standard deviation of its logarithm (0.01 is one percent); null where it is unknown.
        metre_known_by: ``surveyed`` (by control points, positions or scale bars), ``measured`` (by captures
            that are said to be in metres), ``told`` (a person gave metres per unit of a capture), ``assumed``
            (nobody said so, but the captures' own unit may well be the metre), ``guessed`` (from how far
            cameras stand from what they see), ``unknown`` (1 is taken).
        metre_note: what a person should know of it; empty where nothing.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "metres_per_unit": "m a unit",
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
    """What is stale or wants a person, most urgent first.

    Args:
        todo: what is to be done; empty where all is well.
        scenes: how many scenes the map has.
        components: connected components of the newest poses.
        islands: the same number under an older name.
        tentative: scenes that rest on edges which no cycle confirms.
        revision: number of the newest revision; null before the first.
        metres_per_unit: metres in a unit of the largest component; null where nothing tells.
        metres: the same of every component, with how it is known and how well.
        at_work: what processes are at work on now, this one left out; what one that died was at work on is no more.
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
    revision: int | None
    metres_per_unit: float | None
    metres: tuple[MetreRow, ...] = ()
    at_work: tuple[AtWorkRow, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class SettingRow(Row):
    """One setting.

    Args:
        name: dotted, as ``--set`` takes it.
        value: what it is in this map.
        default: what it is where nobody changes it.
        unit: of the value; empty where it has none.
        doc: what it means.
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
    """One ONNX model of the map.

    Args:
        kind: ``sam-encoder``, ``sam-decoder`` or ``clip``.
        name: what the map calls it.
        sha256: of the file.
        preset: how pixels are scaled for it.
        path: where the file is.
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
    """What reading every byte of the map found.

    Args:
        ok: whether nothing is wrong.
        problems: one line each.
        orphans: folders that an interrupted step left; no harm, `gsmap prune` removes them.
        num_groups: how many groups of arrays were read.
        num_bytes: how many bytes were read.
        unverified: what could not be compared with what was written, and why.
    """

    columns: ClassVar[Mapping[str, str]] = {"num_groups": "groups", "num_bytes": "bytes", "ok": "ok"}

    ok: bool
    problems: tuple[str, ...]
    orphans: tuple[str, ...]
    num_groups: int
    num_bytes: int
    unverified: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class PruneReport(Row):
    """What was reclaimed, or would be.

    Args:
        dry_run: whether nothing was deleted.
        scene_names: names of removed scenes whose arrays go.
        revisions: numbers of revisions that can no longer be exported.
        num_graphs: graphs that go.
        num_orphans: folders left by interrupted work that go.
        num_bytes: bytes on disk that this frees; a dry run does not know by how much the catalog would shrink.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "num_graphs": "graphs",
        "num_orphans": "left over",
        "num_bytes": "bytes",
    }

    dry_run: bool
    scene_names: tuple[str, ...]
    revisions: tuple[int, ...]
    num_graphs: int
    num_orphans: int
    num_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class InitReport(Row):
    """The map that was made.

    Args:
        map: its folder.
        catalog: URL of the database that holds its catalog, without a password; null where the folder holds it.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "catalog": "catalog"}

    map: str
    catalog: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class MigrateReport(Row):
    """The schema of a map.

    Args:
        map: its folder.
        before: the schema it had; null where it had none.
        after: the schema it has now.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "before": "before", "after": "after"}

    map: str
    before: str | None
    after: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ConvertReport(Row):
    """The file that was written.

    Args:
        input: the file read.
        output: the file written.
        num_gaussians: how many Gaussians it holds.
        sh_degree: degree of their spherical harmonics as they were read.
        offset: (3,) what was taken off the coordinates (``--local``); else zeros.
    """

    columns: ClassVar[Mapping[str, str]] = {"output": "file", "num_gaussians": "Gaussians", "sh_degree": "SH degree"}

    input: str
    output: str
    num_gaussians: int
    sh_degree: int
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewReport(Row):
    """The page that is being served, or that was written.

    Args:
        url: where it is, on this machine only, with the token that opens it; null where it was written.
        path: the folder or file that it was written to; null where it is served.
        num_bytes: of what was written; null as above.
        num_scenes: that have their levels of detail in it; null as above.
        notes: what a person should know, such as scenes that could not be read.
    """

    columns: ClassVar[Mapping[str, str]] = {"url": "page", "path": "written to"}

    url: str | None = None
    path: str | None = None
    num_bytes: int | None = None
    num_scenes: int | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class DemoReport(Row):
    """What the demo made.

    Args:
        map: the map's folder.
        picture: a picture of the map.
        scenes: the captures.
        edges: what ties them.
        tiles: the merged tiles.
        truth: how close the map comes to the truth.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "picture": "picture"}

    map: str
    picture: str
    scenes: tuple[SceneRow, ...]
    edges: tuple[EdgeRow, ...]
    tiles: tuple[TileRow, ...]
    truth: EvaluationReport
