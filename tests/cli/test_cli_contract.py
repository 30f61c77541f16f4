"""The command line is a contract: every verb explains itself, errors are one line, exit codes are 0, 1 and 2."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gsmap.cli.app import PANELS, verbs


def gsmap(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-m", "gsmap", *arguments], capture_output=True, text=True, timeout=120
    )


def test_help_lists_every_verb_once_in_a_panel() -> None:
    listed: dict[str, list[str]] = {}
    for line in gsmap("-h").stdout.splitlines():
        if line.startswith("╭─"):
            panel = listed.setdefault(line.strip("╭─╮ "), [])
        elif line.startswith("│ ") and line[2] not in " -":
            panel.append(line[2:].split()[0])
    assert listed.pop("Options") == []
    assert list(listed) == list(PANELS)
    assert [verb for panel in listed.values() for verb in panel] == list(verbs())
    assert all(verbs()[verb].PANEL[0] == panel for panel, members in listed.items() for verb in members)


@pytest.mark.parametrize("arguments", [["nonsense"], ["export"], ["list", "a.gsmap", "nonsense"], ["init"]])
def test_wrong_usage_is_2(arguments: list[str]) -> None:
    done = gsmap(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr


def test_failures_are_one_line_and_1(tmp_path: Path) -> None:
    for arguments in (
        ["list", str(tmp_path / "missing.gsmap"), "scenes"],
        ["list", str(tmp_path), "scenes"],
        ["ingest", str(tmp_path / "missing.gsmap"), str(tmp_path / "a.ply")],
        ["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.spz")],
    ):
        done = gsmap(*arguments)
        assert done.returncode == 1, (arguments, done.stderr)
        assert done.stdout == ""
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert str(tmp_path) in done.stderr
