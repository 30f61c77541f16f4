"""Mutation testing runs the tests that reach a mutant, with the code of the mutant."""

from __future__ import annotations

import pytest

from tools.check import mutation

SOURCE = """\
LIMIT = 3

def clipped(values):
    if (
        len(values)
        > LIMIT
    ):
        return [value + 1 for value in values[:LIMIT]]
    return values
"""


def test_the_code_of_functions_is_changed_in_place() -> None:
    space: dict[str, object] = {}
    exec(compile(SOURCE, "made.py", "exec"), space)
    clipped = space["clipped"]
    changed = mutation._changed_functions(SOURCE, SOURCE.replace("value + 1", "value - 1"), "made.py")
    assert changed is not None
    assert clipped([1, 2, 3, 4]) == [2, 3, 4]  # type: ignore[operator]
    clipped.__code__ = changed[clipped.__code__]  # type: ignore[attr-defined]
    assert clipped([1, 2, 3, 4]) == [0, 1, 2]  # type: ignore[operator]
    assert mutation._changed_functions(SOURCE, SOURCE.replace("LIMIT = 3", "LIMIT = 4"), "made.py") is None


@pytest.mark.parametrize(("line", "lines"), [(1, range(1, 2)), (6, range(4, 8)), (8, range(8, 9)), (9, range(9, 10))])
def test_a_statement_has_the_lines_before_its_body(line: int, lines: range) -> None:
    assert mutation._statement(SOURCE, line) == lines
