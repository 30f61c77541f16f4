"""What goes into the packages: the sources of the page into the source archive, the page itself into the wheel."""

from __future__ import annotations

import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILT = {"index.html", "page.js", "style.css", "LICENCES.txt"}


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """The files of git in a folder of their own, as a clean clone has them."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs a checkout")
    target = tmp_path_factory.mktemp("sources") / "gsmap"
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
    return target


def test_the_source_archive_holds_the_page_and_its_sources(sources, tmp_path, monkeypatch):
    build = pytest.importorskip("scikit_build_core.build")
    (sources / "gsmap" / "view" / "built").mkdir(exist_ok=True)
    (sources / "gsmap" / "view" / "built" / "page.js").write_text("of this checkout")
    (sources / "gsmap" / "view" / "page" / "node_modules").mkdir(exist_ok=True)
    (sources / "gsmap" / "view" / "page" / "node_modules" / "x.js").write_text("of this checkout")
    monkeypatch.chdir(sources)
    with tarfile.open(tmp_path / build.build_sdist(str(tmp_path))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    page = "gsmap/view/page"
    needed = ("package.json", "package-lock.json", "build.mjs", "index.html", "style.css", "src/main.ts")
    assert {f"{page}/{name}" for name in needed} <= names
    assert {"tools/build_page.sh", "CMakeLists.txt", "gsmap/native/module.cpp", "migrations/env.py"} <= names
    assert "gsmap/view/built/page.js" in names, "a source archive builds without Node.js"
    assert not [name for name in names if "node_modules" in name or name.startswith(".ci")]


def test_an_editable_install_names_both_packages(sources, tmp_path, monkeypatch):
    build = pytest.importorskip("scikit_build_core.build")
    monkeypatch.chdir(sources)
    with zipfile.ZipFile(tmp_path / build.build_editable(str(tmp_path))) as archive:
        paths = "".join(archive.read(name).decode() for name in archive.namelist() if name.endswith(".pth"))
    assert {str(sources), str(sources / "synthetic")} <= set(paths.splitlines())


def test_a_package_is_built_with_the_page_and_without_its_sources():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["scikit-build"]
    assert settings["cmake"]["define"]["GSMAP_PAGE"] == "ON"
    assert "gsmap/view/page/**" in settings["wheel"]["exclude"]
    assert "GSMAP_PAGE=REQUIRED" in (ROOT / "tools" / "build_wheels.sh").read_text()


def test_everything_of_others_in_the_page_is_named_by_the_lock_file_with_a_digest():
    import json

    locked = json.loads((ROOT / "gsmap" / "view" / "page" / "package-lock.json").read_text())["packages"]
    others = {name: one for name, one in locked.items() if name}
    assert len(others) > 20
    for name, one in others.items():
        assert re.fullmatch(r"sha512-[A-Za-z0-9+/=]+", one["integrity"]), name
        assert one.get("resolved", "https://registry.npmjs.org/").startswith("https://registry.npmjs.org/"), name


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node.js with npm")
def test_the_wheel_has_the_page(sources, tmp_path, monkeypatch):
    """The native module is compiled for it: minutes."""
    build = pytest.importorskip("scikit_build_core.build")
    monkeypatch.chdir(sources)
    monkeypatch.setenv("GSMAP_PAGE", "REQUIRED")
    with zipfile.ZipFile(tmp_path / build.build_wheel(str(tmp_path))) as archive:
        names = set(archive.namelist())
    assert {f"gsmap/view/built/{name}" for name in BUILT} <= names
    assert not [name for name in names if name.startswith(("gsmap/view/page", "gsmap/native"))]
    assert [name for name in names if name.startswith("gsmap/_native")]
    assert "gsmap/migrations/env.py" in names
