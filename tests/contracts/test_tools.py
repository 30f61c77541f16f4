"""Tools name modules and tests that exist."""

from pathlib import Path

import pytest

from tools.check.mutation import TESTS

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("room", "module"), [(room, module) for room, tests in TESTS.items() for module in tests])
def test_mutation_testing_names_modules_and_their_tests(room: str, module: str) -> None:
    assert (ROOT / "gsmap" / room / f"{module}.py").is_file()
    for name in TESTS[room][module].split():
        assert (ROOT / "tests" / room / name).is_file()
