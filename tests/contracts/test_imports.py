"""The house's import direction, the public surface, and how little `import gsmap` loads."""

from __future__ import annotations

import ast
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
    assert gsmap.__all__ == sorted(
        [
            "Cameras",
            "Edge",
            "Gaussians",
            "Map",
            "NodeLayer",
            "PoseGraph",
            "Prior",
            "Registration",
            "Scene",
            "SceneGraph",
            "ScenePose",
            "Sim3",
            "Tile",
            "__version__",
            "errors",
            "map",
            "open",
            "read",
            "render",
            "write",
        ]
    )
    for name in gsmap.__all__:
        assert getattr(gsmap, name) is not None


@pytest.mark.parametrize("arguments", [["-P", "-c", "import gsmap"], ["-P", "-m", "gsmap", "--help"]])
def test_light_start(arguments: list[str]) -> None:
    """Neither importing gsmap nor its help loads a heavy library: that is what keeps --help quick."""
    heavy = sorted({*HOMES, "scipy", "pandas", "matplotlib"} - {"typer", "rich"})
    report = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments], capture_output=True, text=True, check=True, timeout=60
    ).stderr
    loaded = {line.split("|")[-1].strip().split(".")[0] for line in report.splitlines() if "|" in line}
    assert not loaded & set(heavy)
