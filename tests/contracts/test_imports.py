"""Which way imports run, that they never run in a circle, the public surface, and how little `import gsmap` loads."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

import gsmap
import gsmap.map

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {"gsmap": ROOT / "gsmap", "gsmap_synthetic": ROOT / "synthetic" / "gsmap_synthetic"}

LAYERS = [
    {"version", "platform"},
    {"reason_codes", "errors", "texts"},
    {"durable", "markup"},
    {"types"},
    {"geometry", "geodesy"},
    {"methods"},
    {"settings", "stream"},
    {"formats", "render", "networks"},
    {"compare"},
    {
        "store",
        "retrieve",
        "ingest",
        "localize",
        "describe",
        "register",
        "optimize",
        "merge",
        "change",
        "find",
        "objects",
        "thin",
        "world",
        "export",
        "evaluate",
        "view",
        "report",
        "engine",
    },
    {"map"},
    {"gsmap_synthetic"},
    {"cli"},
    {"__init__", "__main__"},
]
"""Rooms from the bottom up. A room imports from layers below its own, and from no other room of its own layer."""

RANK = {room: rank for rank, layer in enumerate(LAYERS) for room in layer}

FEATURES: dict[str, set[str]] = {
    "changes": {"change"},
    "evaluation": {"evaluate"},
    "find": {"find", "map.objects", "map.pictures", "map.thinning"},
    "localization": {"localize", "map.objects"},
    "objects": {"objects", "map.changes"},
    "page": {"view", "report", "map.changes", "map.localization", "map.objects", "map.pictures", "map.report"},
    "pictures": {"view", "report", "map.changes", "map.objects"},
    "report": {"report", "map.changes", "map.objects", "map.pictures"},
    "small_map": {"localize", "map.changes", "map.localization", "map.objects"},
    "thinning": {"thin"},
    "world": {"world", "report", "map.localization", "map.pictures"},
}
"""The features, folders of ``gsmap/map``, with the rooms of features and the other features that each may import."""

OF_FEATURES = {f"map.{name}" for name in FEATURES}.union(*FEATURES.values())

LAYERS_OF_MAP = [
    {
        "backups",
        "catalog_trust",
        "date_filter",
        "georeferenced_components",
        "map_operations",
        "merged_tiles",
        "metric_scales",
        "models",
        "outputs",
        "progress_logging",
        "scene_index",
        "settings",
        "shared_jobs",
        "snapshot_read",
        "undated_overlaps",
    },
    {"jobs", "rejected_changes", "reports", "scene_lookup"},
    {"poses", "stages"},
    {"pair_explanation", "status"},
    set(FEATURES),
    {"map"},
    {"__init__"},
]
"""Modules and folders of ``gsmap/map`` from the bottom up, as `LAYERS`; those below the features are the core."""

RANK_IN_MAP = {part: rank for rank, layer in enumerate(LAYERS_OF_MAP) for part in layer}

ROOTS = {"__init__", "map", "settings"}
"""The modules of ``gsmap/map`` that compose the core and its features."""

NATIVE = "gsmap._native"

HOMES = {
    "sqlalchemy": {"store"},
    "alembic": {"store"},
    "zarr": {"store"},
    "gtsam": {"localize", "optimize"},
    "networkx": {"optimize", "objects"},
    "onnxruntime": {"networks"},
    "small_gicp": {"register"},
    "kiss_matcher": {"register"},
    "open3d": {"formats"},
    "av": {"localize"},
    "pycolmap": {"formats", "geometry", "localize"},
    "torch": {"formats", "render", "types"},  # types: conversion only
    "pandas": {"types"},
    "pxr": {"formats"},
    "tomlkit": {"settings"},
    "pyproj": {"geodesy"},
    "typer": {"cli"},
    "rich": {"cli"},
}
"""The rooms that may import a library that is slow to load."""


def modules() -> dict[str, Path]:
    """Every module of the tree by its dotted name; a package goes by its own name."""
    found = {}
    for package, folder in SOURCES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name: str, path: Path, known: Mapping[str, Path]) -> Iterator[str]:
    """What a module imports, anywhere in it, for type checkers alone and inside functions included.

    ``from package import name`` imports the module ``package.name`` where there is one, and otherwise whatever
    ``package/__init__.py`` imports.
    """
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} has a relative import"
            assert node.module is not None
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in known or inner == NATIVE else node.module


def import_graph() -> nx.DiGraph:
    """An edge from each module to each that it imports; libraries are nodes, too."""
    known = modules()
    graph = nx.DiGraph()
    graph.add_nodes_from(known)
    graph.add_edges_from((name, other) for name, path in known.items() for other in imported(name, path, known))
    return graph


GRAPH = import_graph()
OURS = sorted(modules())


def room_of(module: str) -> str:
    """The room a module lies in; its package, for what lies outside gsmap."""
    package, *rest = module.split(".")
    if package != "gsmap":
        return package
    return rest[0] if rest else "__init__"


def part_of(module: str) -> str:
    """The module or folder of ``gsmap/map`` that a module of this room lies in."""
    parts = module.split(".")
    return parts[2] if len(parts) > 2 else "__init__"


def is_ours(module: str) -> bool:
    return module.split(".")[0] in SOURCES and module != NATIVE


def test_one_module_escapes_text_for_html() -> None:
    assert [name for name in OURS if room_of(name) != "gsmap_synthetic" and GRAPH.has_edge(name, "html")] == [
        "gsmap.markup"
    ]


def test_no_import_runs_in_a_circle() -> None:
    ours = GRAPH.subgraph(OURS)
    circles = [sorted(part) for part in nx.strongly_connected_components(ours) if len(part) > 1]
    assert circles == []
    assert list(nx.selfloop_edges(ours)) == []


def test_every_room_has_its_layer() -> None:
    assert {room_of(module) for module in OURS} <= set(RANK)


@pytest.mark.parametrize("module", OURS)
def test_import_direction(module: str) -> None:
    room = room_of(module)
    for other in GRAPH.successors(module):
        if is_ours(other):
            below = room_of(other)
            assert below == room or RANK[below] < RANK[room], f"{module} must not import {other}"
        top = other.split(".")[0]
        assert top not in HOMES or room in HOMES[top], f"{top} has its home in {HOMES[top]}, not in {room}"


@pytest.mark.parametrize("module", [one for one in OURS if room_of(one) == "map" and part_of(one) not in ROOTS])
def test_imports_within_map(module: str) -> None:
    """The core imports no feature and no room of one, a feature only those of its row, and no import runs upward."""
    part = part_of(module)
    for other in filter(is_ours, GRAPH.successors(module)):
        name = f"map.{part_of(other)}" if room_of(other) == "map" else room_of(other)
        if name == f"map.{part}":
            continue
        if name in OF_FEATURES:
            assert name in FEATURES.get(part, ()), f"{module} must not import {other}"
        elif name.startswith("map."):
            assert RANK_IN_MAP[name[4:]] < RANK_IN_MAP[part], f"{module} must not import {other}"


def test_features_import_each_other_one_way() -> None:
    between = {(name, one[4:]) for name, allowed in FEATURES.items() for one in allowed if one.startswith("map.")}
    assert nx.is_directed_acyclic_graph(nx.DiGraph(between))
    used = {(part_of(a), part_of(b)) for a, b in GRAPH.edges if room_of(a) == room_of(b) == "map"}
    assert between <= used, "remove what is not used"


def test_only_the_demo_imports_synthetic_scenes() -> None:
    users = {a for a, b in GRAPH.edges if b.split(".")[0] == "gsmap_synthetic" and a.split(".")[0] == "gsmap"}
    assert users <= {"gsmap.cli.demo"}


def test_public_surface() -> None:
    """What is imported on first use is what type checkers are told of, and everything is there."""
    tree = ast.parse((SOURCES["gsmap"] / "__init__.py").read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    told = {
        (alias.asname, node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name  # what makes it public to a strict type checker
    }
    listed = {(name, home) for home, names in gsmap._HOME.items() for name in names}
    assert told == listed | {(room, "gsmap") for room in gsmap._ROOMS}
    assert {"Map", "Gaussians", "open", "read", "write", "__version__"} <= set(gsmap.__all__)
    assert set(dir(gsmap)) == set(gsmap.__all__) | set(gsmap._ROOMS)
    for name in dir(gsmap):
        assert getattr(gsmap, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gsmap.nothing


def test_names_in_documents_are_there() -> None:
    """Every dotted name in the documents is there after ``import gsmap``."""
    root = SOURCES["gsmap"].parent
    pages = [*root.glob("*.md"), *(root / "docs").rglob("*.md")]
    named = {name for page in pages for name in re.findall(r"`gsmap\.((?:\w+\.)*\w+)(?:\(\))?`", page.read_text())}
    assert named
    names = ", ".join(sorted(f"gsmap.{name}" for name in named))
    subprocess.run(
        [sys.executable, "-c", f"import gsmap, gsmap._native, gsmap.durable; {names}"], check=True, timeout=120
    )


@pytest.mark.parametrize("arguments", [["-P", "-c", "import gsmap"], ["-P", "-m", "gsmap", "--help"]])
def test_light_start(arguments: list[str]) -> None:
    """Neither importing gsmap nor its help loads a heavy library: that is what keeps --help quick."""
    heavy = sorted({*HOMES, "scipy", "pandas", "matplotlib"} - {"typer", "rich"})
    report = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments], capture_output=True, text=True, check=True, timeout=60
    ).stderr
    assert not {name.split(".")[0] for name in imported_by(report)} & set(heavy)


def imported_by(report: str) -> set[str]:
    """The modules that a run with ``-X importtime`` imported, by what it wrote to stderr."""
    return {line.split("|")[-1].strip() for line in report.splitlines() if line.startswith("import time:")}


@pytest.fixture(scope="module")
def one_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of one small scene, which has a pose."""
    path = tmp_path_factory.mktemp("maps") / "site.gsmap"
    means = np.random.default_rng(0).uniform(size=(50, 3)).astype(np.float32)
    count = len(means)
    gaussians = gsmap.Gaussians(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), -4, np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    with gsmap.map.create(path) as m:
        m.ingest(gaussians, name="hall", scale="known")
        m.optimize()
    return path


@pytest.mark.parametrize(
    ("verb", "most"),
    [
        ("list MAP scenes", 150),
        ("list MAP edges", 150),
        ("poses MAP", 150),
        ("show MAP hall", 195),
        ("edit MAP hall --note wet", 165),
        ("status MAP", 270),
    ],
)
def test_verbs_that_only_read_start_quickly(one_scene: Path, verb: str, most: int) -> None:
    """They import neither solvers, renderers and picture readers nor most of gsmap: importing is what they cost."""
    arguments = [str(one_scene) if word == "MAP" else word for word in verb.split()]
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "gsmap", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-300:]
    loaded = imported_by(done.stderr)
    allowed = {"typer", "rich", "sqlalchemy"} | ({"PIL"} if verb.startswith("edit") else set())
    assert not {name.split(".")[0] for name in loaded} & ({*HOMES, "scipy", "pandas", "matplotlib", "PIL"} - allowed)
    assert len({name for name in loaded if name.split(".")[0] == "gsmap"}) <= most
