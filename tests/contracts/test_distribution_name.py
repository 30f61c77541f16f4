"""Check that every text names the distribution that gsmap is installed by, and only extras that it has."""

import ast
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from gsmap.errors import MissingDependencyError
from gsmap.version import DISTRIBUTION

ROOT = Path(__file__).resolve().parents[2]
STRANGERS = r"gsmap(?:3d)?"  # names that belong to other projects on the Python Package Index
INSTALLED = re.compile(
    rf"\b(?:pip3?|uv|pipx|poetry) (?:tool )?(?:install|add)\s+(?:[^\s`;|&]+ ){{0,8}}?['\"]?{STRANGERS}(?![\w/.-])"
    rf"|(?<![\w/.-]){STRANGERS}\[[a-z]+(?:,[a-z]+)*\]"
)


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """All text files of the checkout except this one, by path."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False).stdout.decode()
    found = {}
    for name in filter(None, listed.split("\0")):
        if ROOT / name != Path(__file__) and (ROOT / name).is_file():
            try:
                found[name] = (ROOT / name).read_text()
            except UnicodeDecodeError:
                continue
    return found or pytest.skip("needs a checkout")


def test_no_text_installs_the_distribution_of_another_project(texts: dict[str, str]) -> None:
    assert {name: found[0] for name, text in texts.items() if (found := INSTALLED.search(text))} == {}


@pytest.mark.parametrize(
    ("text", "is_wrong"),
    [
        ("pip install gsmap", True),
        ("pip install -U 'gsmap[cloud]'", True),
        ("uv add numpy gsmap3d", True),
        ("the extra gsmap[las]", True),
        ("pip install gsmapdb", False),
        ("pip install 'gsmapdb[cloud,postgres]'", False),
        ("pip install ./gsmap/dist/x.whl", False),
        ("found[gsmap.Map]", False),
    ],
)
def test_wrong_commands_are_found(text: str, is_wrong: bool) -> None:
    assert bool(INSTALLED.search(text)) == is_wrong


def test_no_package_requires_the_distribution_of_another_project() -> None:
    for path in [ROOT / "pyproject.toml", *(ROOT / "tests").rglob("pyproject.toml")]:
        project = tomllib.loads(path.read_text())["project"]
        extras = project.get("optional-dependencies", {}).values()
        required = [*project["dependencies"], *(name for extra in extras for name in extra)]
        assert not [name for name in required if re.match(rf"{STRANGERS}\b(?!-)", name)], path


def test_extras_that_are_named_exist(texts: dict[str, str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == DISTRIBUTION
    named = {extra for text in texts.values() for found in re.findall(rf"{DISTRIBUTION}\[([a-z,]+)\]", text)
             for extra in found.split(",")}  # fmt: skip
    for path in (ROOT / "gsmap").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id == "MissingDependencyError"
            ):
                named |= {word.value.value for word in node.keywords if word.arg == "extra"}  # type: ignore[attr-defined]
    assert {"las", "cloud"} <= named <= set(project["optional-dependencies"])


def test_an_error_ends_with_the_command_that_installs_the_extra() -> None:
    error = MissingDependencyError("reading .las needs laspy", extra="las")
    assert str(error) == f"reading .las needs laspy: pip install '{DISTRIBUTION}[las]'"
    assert error.code == "missing_dependency"
