"""What the tests of this room share: the good map, made once, and the count of what was tried."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hostile_world
import pytest

_counts = {"tried": 0, "held": 0}


@pytest.fixture(scope="session")
def good_world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("good")
    hostile_world.make_world(root)
    return root


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    outcome = yield
    report = outcome.get_result()
    if report.when == "call" and "hostile_case" in getattr(item, "fixturenames", ()):
        _counts["tried"] += 1
        _counts["held"] += report.passed


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if _counts["tried"]:
        terminalreporter.write_line(
            f"hostile: {_counts['held']} of {_counts['tried']} crafted maps, tiles and captures held; nothing outside "
            "the map and OUT was touched"
        )
