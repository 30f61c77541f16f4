"""Fixtures shared by all rooms; and that what is tested is this checkout as it lies."""

from __future__ import annotations

import atexit
import fcntl
import importlib.util
import logging
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure() -> None:
    """Build the native module and the page of `gsmap view` when a source is newer, before anything imports them.

    GSMAP_TEST_INSTALLED=1 tests the package as it is installed instead: a wheel, say.
    """
    # What the person trusts is none of the tests' business, and what they trust is none of the person's.
    os.environ["XDG_CONFIG_HOME"] = tempfile.mkdtemp(prefix="gsmap-test-config-")
    atexit.register(shutil.rmtree, os.environ["XDG_CONFIG_HOME"], ignore_errors=True)
    # Nor do results of other versions of gsmap decide what a test finds.
    os.environ["GSMAP_CACHE"] = tempfile.mkdtemp(prefix="gsmap-test-cache-")
    atexit.register(shutil.rmtree, os.environ["GSMAP_CACHE"], ignore_errors=True)
    os.environ.pop("GSMAP_CATALOG", None)
    if os.environ.get("GSMAP_TEST_INSTALLED"):
        return
    found = importlib.util.find_spec("gsmap")
    if found is None or found.origin is None or Path(found.origin).resolve() != ROOT / "gsmap" / "__init__.py":
        raise pytest.UsageError(
            f"these tests would test {found.origin if found else 'nothing'}, not this checkout: run tools/setup.sh "
            "test, or say GSMAP_TEST_INSTALLED=1 if that is what you want"
        )
    if _native_is_old():
        _build(_native_is_old, "build_native.sh", "the native module")
    if _page_is_old() and shutil.which("npm"):  # without it the page's tests are skipped, and say why
        _build(_page_is_old, "build_page.sh", "the page of gsmap view")


def _native_is_old() -> bool:
    module = ROOT / "gsmap" / f"_native{sysconfig.get_config_var('EXT_SUFFIX')}"
    sources = [ROOT / "CMakeLists.txt", *(ROOT / "gsmap" / "native").iterdir()]
    return not module.exists() or max(s.stat().st_mtime_ns for s in sources) > module.stat().st_mtime_ns


def _page_is_old() -> bool:
    built, page = ROOT / "gsmap" / "view" / "built" / "page.js", ROOT / "gsmap" / "view" / "page"
    sources = [*(p for p in page.iterdir() if p.is_file()), *(p for p in (page / "src").rglob("*") if p.is_file())]
    return not built.exists() or max(s.stat().st_mtime_ns for s in sources) > built.stat().st_mtime_ns


def _build(is_old: Callable[[], bool], tool: str, what: str) -> None:
    (ROOT / "build").mkdir(exist_ok=True)
    with (ROOT / "build" / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # Of several test runs that start at once, one builds.
        if not is_old():
            return
        done = subprocess.run(
            [ROOT / "tools" / tool],
            env=os.environ | {"PYTHON": sys.executable},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    if done.returncode:
        raise pytest.UsageError(
            f"{done.stdout}\n{what} does not build (above): mend it, or run tools/setup.sh test if a tool is missing"
        )


def _shared_data() -> Path | None:
    """Real captures beside the checkout (or at GSMAP_SHARED_DATA); never part of the project."""
    named = os.environ.get("GSMAP_SHARED_DATA")
    root = Path(named) if named else ROOT.parent / "shared" / "data"
    return root if (root / "house").is_dir() else None


@pytest.fixture(autouse=True)
def untouched_logger() -> None:
    """The command line, run in this process by the test before, sent the library's warnings to stderr and kept them."""
    logger = logging.getLogger("gsmap")
    logger.setLevel(logging.NOTSET)
    logger.handlers, logger.propagate = [], True


@pytest.fixture(scope="session")
def shared_data() -> Path:
    root = _shared_data()
    if root is None:
        pytest.skip("needs real captures: set GSMAP_SHARED_DATA to a folder holding house/, kitchen_splats/, formats/")
    return root


@pytest.fixture(params=["baseline", "avx2", "avx512"])
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Every set of kernels that this machine can run: a map may be opened by another one, which runs fewer."""
    from gsmap import _native

    if _native.use_instruction_set(request.param) != request.param:
        pytest.skip(f"this machine cannot run {request.param}")
    yield request.param
    _native.use_instruction_set("best")
