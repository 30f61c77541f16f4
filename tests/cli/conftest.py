"""One small map for the tests of this room, and the command line run in this process."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from cli_rooms import write_captures

import gsmap.map
from gsmap.cli.app import run


@dataclass(frozen=True)
class Done:
    """What a run of the command line left: its exit code, and what it wrote where."""

    code: int
    stdout: str
    stderr: str

    @property
    def json(self) -> Any:
        return json.loads(self.stdout)


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Done]:
    """Runs ``gsmap ARGUMENTS...`` in this process."""

    def call(*arguments: object) -> Done:
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit:
            run([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return Done(exit.value.code or 0, out, err)

    return call


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures")
    write_captures(folder)
    return folder


@pytest.fixture(scope="session")
def made_site(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three described scenes: two that overlap, and one of another room; two revisions and an export."""
    root = tmp_path_factory.mktemp("maps")
    with gsmap.map.create(root / "site.gsmap") as m:
        m.ingest(captures, scale="known")
        m.update()
        m.optimize()
        m.export(root / "tiles", format="ply", tile_size_m=0, merge="union")
    return root / "site.gsmap"


@pytest.fixture
def site(made_site: Path, tmp_path: Path) -> Path:
    """A copy to change. Arrays are never written again, so a link to them will do."""

    def copy(source: str, target: str) -> None:
        if "/arrays/" in source:
            os.link(source, target)
        else:
            shutil.copy2(source, target)

    return Path(shutil.copytree(made_site, tmp_path / "site.gsmap", copy_function=copy))
