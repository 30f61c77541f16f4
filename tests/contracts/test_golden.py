"""A method whose output changes raises its VERSION: results that are kept are told apart by nothing else."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from sketches import STORED, cases, differences, made, sketch

CASES = cases()
KEPT = json.loads(STORED.read_text()) if STORED.exists() else {}


@pytest.fixture(scope="module")
def outputs() -> dict[str, dict[str, Any]]:
    return made()


@pytest.mark.parametrize("name", sorted(CASES))
def test_output_is_that_of_its_version(name: str, outputs: dict[str, dict[str, Any]]) -> None:
    assert name in KEPT, f"{name} has no stored output: run tools/make/golden.py"
    now, kept = outputs[name], KEPT[name]
    if "missing" in now:
        pytest.skip(now["missing"])
    changed = differences(kept, now)
    if now["version"] == kept["version"]:
        assert not changed, f"{name} gives other {', '.join(changed)} than before: raise VERSION or restore the output"
    else:
        assert not changed or now["version"] > kept["version"]
        pytest.fail(f"{name} has VERSION {now['version']}, stored is {kept['version']}: run tools/make/golden.py")


def test_nothing_stored_is_without_its_case() -> None:
    assert set(KEPT) == set(CASES)


def test_sketches_notice_what_matters() -> None:
    rng = np.random.default_rng(0)
    array = rng.normal(size=(50, 3))

    def same(a: np.ndarray, b: np.ndarray) -> bool:
        return not differences({"arrays": {"x": sketch(a)}}, {"arrays": {"x": sketch(b)}})

    assert same(array, array * (1 + 1e-9))
    other = array.copy()
    other[17, 1] += 1e-3
    assert not same(array, other)
    assert not same(array, array[::-1])
    assert not same(array, array.T)
    assert not same(array, array.astype(np.float32).astype(int))
    with_nan = array.copy()
    with_nan[3] = np.nan
    assert same(with_nan, with_nan.copy())
    assert not same(with_nan, np.nan_to_num(with_nan))
    assert not same(with_nan, np.where(np.isnan(with_nan), np.inf, with_nan))
    assert not same(np.array(["a", "b"]), np.array(["a", "c"]))
