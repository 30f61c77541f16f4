"""Every number among the settings is refused outside of the range that its meaning states."""

from __future__ import annotations

import math
import re

import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.map.settings import Settings, settings_of
from gsmap.settings.tree import Leaf, leaves

WITHOUT_RANGE = {"localize.extractors.onnx.min_score", "thin.min_fidelity_db"}
NUMBERS = [one for one in leaves(Settings()) if type(one.value) in (int, float)]


def values_outside(leaf: Leaf) -> list[float]:
    """Return values just outside of the range that the setting's meaning states."""
    if found := re.search(r"in ([\[(])(-?[\d.]+), (-?[\d.]+)([\])])", leaf.meaning):
        low, high = float(found[2]), float(found[3])
        ends = [low] * (found[1] == "(") + [high] * (found[4] == ")")
        return [low - 1, high + 1, *ends]
    if found := re.search(r"at least (-?\d+)", leaf.meaning):
        return [float(found[1]) - 1]
    if found := re.search(r"at most (-?\d+)", leaf.meaning):
        return [float(found[1]) + 1]
    return [0.0, -1.0] if re.search(r"\bpositive\b", leaf.meaning) else []


@pytest.mark.parametrize("leaf", [pytest.param(one, id=one.name) for one in NUMBERS])
def test_a_number_outside_of_its_stated_range_is_refused_by_its_whole_name(leaf: Leaf) -> None:
    outside = values_outside(leaf)
    assert bool(outside) != (leaf.name in WITHOUT_RANGE), "its meaning must state a range"
    for value in outside:
        with raises(ConfigError, code="out_of_range", match=re.escape(leaf.name)):
            settings_of({leaf.name: type(leaf.value)(value)})
    if isinstance(leaf.value, float):
        with raises(ConfigError, code="invalid_setting_value", match=re.escape(leaf.name)):
            settings_of({leaf.name: math.nan})
