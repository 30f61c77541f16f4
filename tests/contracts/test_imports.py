"""The house's import direction, the public surface, and how little `import gsmap` loads."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gsmap

PACKAGE = Path(__file__).resolve().parents[2] / "gsmap"
STAGES = {"ingest", "describe", "register", "optimize", "merge", "export", "evaluate"}
BASE = {"errors", "types", "geometry"}
TOOLS = {"formats", "render"}
MAY_IMPORT = {
    "errors": set(),
    "types": {"errors"},
    "geometry": {"errors", "types"},
    "formats": BASE,
    "render": BASE,
    "store": BASE,
    **dict.fromkeys(STAGES, BASE | TOOLS),
    "demo": BASE | TOOLS,
    "view": BASE | TOOLS,
    "__main__": {"cli"},
    "engine": BASE,
    "map": BASE | TOOLS | STAGES | {"store", "view", "engine"},
    "cli": BASE | TOOLS | STAGES | {"store", "view", "map", "demo"},
}
HOMES = {
    "sqlalchemy": {"store"},
    "alembic": {"store"},
    "zarr": {"store"},
    "gtsam": {"optimize"},
    "networkx": {"optimize"},
    "onnxruntime": {"describe", "evaluate"},
    "small_gicp": {"register"},
    "kiss_matcher": {"register"},
    "open3d": {"register", "demo", "formats", "describe"},
    "pycolmap": {"formats"},
    "torch": {"render", "merge", "demo", "register"},
    "typer": {"cli"},
    "rich": {"cli"},
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Full dotted names a module imports, anywhere in it, for type checkers alone included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def room_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_import_direction(path: Path) -> None:
    room = room_of(path)
    if room == "__init__":
        return
    for name in imported(path):
        if name.startswith("gsmap.") and name.split(".")[1] not in {"_native", "__version__"}:
            other = name.split(".")[1]
            assert other == room or other in MAY_IMPORT[room], f"{room} must not import {name}"
        top = name.split(".")[0]
        assert top not in HOMES or room in HOMES[top], f"{top} has its home in {HOMES[top]}, not in {room}"


def test_public_surface() -> None:
    """What is imported on first use is what type checkers are told of, and everything is there."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
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


def test_names_in_the_readme_are_there() -> None:
    """Every dotted name that the README says is there after ``import gsmap``."""
    named = set(re.findall(r"`gsmap\.((?:\w+\.)*\w+)`", (PACKAGE.parent / "README.md").read_text()))
    assert named
    names = ", ".join(sorted(f"gsmap.{name}" for name in named))
    subprocess.run([sys.executable, "-c", f"import gsmap; {names}"], check=True, timeout=120)


@pytest.mark.parametrize("arguments", [["-P", "-c", "import gsmap"], ["-P", "-m", "gsmap", "--help"]])
def test_light_start(arguments: list[str]) -> None:
    """Neither importing gsmap nor its help loads a heavy library: that is what keeps --help quick."""
    heavy = sorted({*HOMES, "scipy", "pandas", "matplotlib"} - {"typer", "rich"})
    report = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments], capture_output=True, text=True, check=True, timeout=60
    ).stderr
    loaded = {line.split("|")[-1].strip().split(".")[0] for line in report.splitlines() if "|" in line}
    assert not loaded & set(heavy)
