"""Methods are found in a folder and in installed packages, and are held to their contract."""

import logging
import sys

import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.methods import Family, MethodParams, families


def test_a_new_file_is_a_new_method_and_so_is_an_entry_point(toys):
    assert toys.names() == ("bare", "glass", "loose", "stone", "torn", "wood")
    assert toys.get("stone").build(3, toys.params_type("stone")()) == 6
    assert toys.get("glass").VERSION == 12


def test_a_built_in_method_goes_before_another_packages_of_its_name(toys):
    assert toys.version("wood") == {"toy.wood": 3}


def test_nothing_is_imported_before_it_is_asked_for(toys):
    toys.names()
    assert not {"toy_blocks.wood", "toy_added"} & set(sys.modules)
    toys.get("wood")
    assert "toy_blocks.wood" in sys.modules
    assert "toy_blocks.stone" not in sys.modules


@pytest.mark.parametrize(
    ("name", "code", "match"),
    [
        ("wod", "unknown_method", "'wod' .did you mean 'wood'.*bare, glass"),
        ("bare", "invalid_method", "'bare' lacks Params, build"),
        ("loose", "invalid_method", "'loose': its Params"),
        ("torn", "method_not_loadable", "'torn' of the package toys"),
    ],
)
def test_what_does_not_keep_the_contract_is_named(toys, name, code, match):
    with raises(ConfigError, code=code, match=match):
        toys.get(name)


def test_methods_that_do_not_load_are_left_out_with_one_warning_each(toys, caplog):
    with caplog.at_level(logging.WARNING, "gsmap.methods"):
        assert toys.usable() == ("glass", "stone", "wood")
        assert toys.usable() == ("glass", "stone", "wood")
    warned = [record.getMessage() for record in caplog.records]
    assert len(warned) == 3
    assert [name for name in ("bare", "loose", "torn") if sum(f"toy '{name}'" in line for line in warned) == 1] == [
        "bare",
        "loose",
        "torn",
    ]
    params = MethodParams("toy")
    assert len(params) == 3
    assert "torn" in params  # it exists, so naming it says why it does not load
    assert "rubble" not in params


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("size_m: float = 7.0", "size_m: float"),  # no default
        ("size_m: float = 7.0", "size_m: Length = 7.0"),  # a type that does not exist
        ("VERSION = 12", "raise SystemExit(3)"),
    ],
)
def test_any_way_to_fail_of_another_package_is_a_clear_error(toys, tmp_path, old, new):
    added = tmp_path / "site" / "toy_added.py"
    text = added.read_text()
    assert old in text
    added.write_text("from __future__ import annotations\n" + text.replace(old, new))
    with raises(ConfigError, code=("invalid_method", "method_not_loadable"), match="toy 'glass'"):
        toys.get("glass")
    assert toys.usable() == ("stone", "wood")


def test_a_method_without_a_version_is_refused(toys, tmp_path):
    wood = tmp_path / "site" / "toy_blocks" / "wood.py"
    (wood.parent / "clay.py").write_text(wood.read_text().replace("VERSION = 3", ""))
    with raises(ConfigError, code="invalid_method", match="'clay' lacks VERSION"):
        toys.get("clay")


def test_a_table_lists_built_in_methods_that_need_no_params(toys):
    table = Family("toy", "toy_blocks", (), (("a", "toy_blocks.bare"),), any_of=("build", "wreck"), has_params=False)
    assert table.names() == ("a", "glass", "torn", "wood")
    with raises(ConfigError, code="invalid_method", match="lacks build or wreck"):
        table.get("a")
    assert table.get("glass").VERSION == 12


def test_params_of_a_family_hold_what_was_changed_and_defaults_for_the_rest(toys):
    params = MethodParams("toy")
    wood = toys.params_type("wood")
    changed = params.with_params("wood", wood(size_m=0.25))
    assert (changed["wood"].size_m, changed["stone"].size_m, params["wood"].size_m) == (0.25, 2.0, 0.5)
    assert changed != params
    assert hash(changed) == hash(params.with_params("wood", wood(size_m=0.25)))
    assert changed.with_params("wood", wood()) == params
    assert list(params) == ["glass", "stone", "wood"]
    with raises(ConfigError, code="invalid_method", match=r"toy_blocks\.wood\.Params, got toy_blocks\.stone\.Params"):
        params.with_params("wood", toys.params_type("stone")())


def test_every_declared_family_finds_its_folder():
    for family in families().values():
        assert family.group == f"gsmap.{family.name}s"
        if family.table:
            assert family.names()
