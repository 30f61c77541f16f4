"""Every setting by its dotted name: read, changed, refused."""

from dataclasses import replace

import pytest
from raising import raises
from settings_tree import Tree

from gsmap.errors import ConfigError
from gsmap.settings import changed, contains, differences, leaves, parse


def test_leaves_are_all_settings_with_meaning_and_unit(tree):
    found = {leaf.name: leaf for leaf in leaves(tree)}
    methods = [f"toys.{name}.{field}" for name in ("glass", "stone", "wood") for field in ("size_m", "label")]
    assert list(found) == [
        *("bars.near_m", "bars.far_m", "bars.turn_deg", "toy", *methods),
        *("count", "budget_s", "loud", "mode", "weights", "names"),
    ]
    assert (found["bars.far_m"].value, found["bars.far_m"].unit) == (5.0, "m")
    assert found["bars.far_m"].meaning == "how close and how far a thing may be."
    assert (found["bars.turn_deg"].unit, found["budget_s"].unit, found["count"].unit) == ("deg", "s", "")
    assert (found["toys.glass.size_m"].value, found["toys.glass.size_m"].meaning) == (7.0, "side of a block.")


@pytest.mark.parametrize(
    ("name", "value", "kept"),
    [
        ("bars.near_m", 1, 1.0),
        ("toys.stone.size_m", 0.25, 0.25),
        ("toys.stone.label", "a", "a"),
        ("count", 5, 5),
        ("budget_s", 2, 2.0),
        ("budget_s", None, None),
        ("loud", True, True),
        ("mode", "fast", "fast"),
        ("weights", [3, 4], (3.0, 4.0)),
        ("names", ["x", "y"], ("x", "y")),
    ],
)
def test_a_setting_is_changed_and_nothing_else(tree, name, value, kept):
    new = changed(tree, {name: value})
    values = {leaf.name: leaf.value for leaf in leaves(new)}
    assert values[name] == kept
    assert type(values[name]) is type(kept)
    assert values == {leaf.name: leaf.value for leaf in leaves(tree)} | {name: kept}
    before = {leaf.name: leaf.value for leaf in leaves(tree)}
    assert differences(new, tree) == ({} if before[name] == kept else {name: kept})


def test_a_method_that_cannot_be_loaded_does_not_hinder_the_settings_of_another(toys):
    new = changed(Tree(), {"toys.stone.size_m": 3.0})
    assert new.toys["stone"].size_m == 3.0
    with raises(ConfigError, code="method_not_loadable", match="torn"):
        changed(Tree(), {"toys.torn.size_m": 3.0})


@pytest.mark.parametrize(
    ("name", "value", "code", "match"),
    [
        ("bars.neer_m", 1.0, "unknown_setting", "'bars.neer_m': did you mean bars.near_m"),
        ("near_m", 1.0, "unknown_setting", "'near_m': did you mean bars.near_m"),
        ("toys.wood.size", 1.0, "unknown_setting", "'toys.wood.size': did you mean toys.wood.size_m"),
        ("count.more", 1, "unknown_setting", "'count.more'"),
        ("qqq", 1, "unknown_setting", "'qqq': gsmap settings MAP"),
        ("bars", 1, "setting_not_a_leaf", "such as bars.near_m"),
        ("toys.wood", 1, "setting_not_a_leaf", "such as toys.wood.size_m"),
        ("count", 1.5, "invalid_setting_value", "count takes int, got 1.5"),
        ("count", True, "invalid_setting_value", "count takes int, got True"),
        ("loud", 1, "invalid_setting_value", "loud takes bool, got 1"),
        ("bars.near_m", "wide", "invalid_setting_value", "bars.near_m takes float, got 'wide'"),
        ("bars.near_m", None, "invalid_setting_value", "bars.near_m takes float, got None"),
        ("bars.near_m", float("nan"), "invalid_setting_value", "bars.near_m takes float, got nan"),
        ("budget_s", "long", "invalid_setting_value", r"budget_s takes float \| None, got 'long'"),
        ("mode", "quick", "invalid_choice", "mode must be one of slow, fast, got 'quick'"),
        ("weights", [1.0], "invalid_setting_value", r"weights takes .*got \[1\.0\]"),
        ("weights", [1.0, "a"], "invalid_setting_value", "weights takes float, got 'a'"),
        ("names", "xy", "invalid_setting_value", "names takes .*got 'xy'"),
    ],
)
def test_what_is_wrong_is_refused_with_its_name(tree, name, value, code, match):
    with raises(ConfigError, code=code, match=match):
        changed(tree, {name: value})


def test_differences_make_one_tree_from_another(tree):
    new = replace(tree, count=9, bars=replace(tree.bars, far_m=1.0))
    new = changed(new, {"toys.wood.label": "x"})
    found = differences(new, tree)
    assert found == {"count": 9, "bars.far_m": 1.0, "toys.wood.label": "x"}
    assert changed(tree, found) == new


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("a.b=-6", "a.b", -6),
        (" a.b = 1e-3 ", "a.b", 1e-3),
        ("a=.3", "a", 0.3),
        ("a=-.3e2", "a", -30.0),
        ("a=[.1, -.2]", "a", [0.1, -0.2]),
        ("a='.3'", "a", ".3"),
        ("a=./x.3", "a", "./x.3"),
        ("a=true", "a", True),
        ("a=[1, 2]", "a", [1, 2]),
        ("a='1'", "a", "1"),
        ("a=fast", "a", "fast"),
        ("a=None", "a", None),
        ("a=b=c", "a", "b=c"),
    ],
)
def test_settings_on_the_command_line(text, name, value):
    assert parse(text) == (name, value)
    assert type(parse(text)[1]) is type(value)


@pytest.mark.parametrize("text", ["a.b", "=3", ""])
def test_what_sets_nothing_is_refused(text):
    with raises(ConfigError, code="invalid_assignment"):
        parse(text)


def test_a_tree_contains_settings_and_groups_and_nothing_below_a_value(tree):
    assert contains(tree, "bars.far_m")
    assert contains(tree, "bars")
    assert contains(tree, "toys.wood.label")
    for name in ("bars.near", "bars.far_m.more", "toys.steel.label", ""):
        assert not contains(tree, name)
