"""Meaning and unit of a setting, from the docstring that its author wrote."""

import pytest
from settings_tree import Bars, Tree

from gsmap.settings import field_docs, unit_of


def test_every_entry_is_found_and_the_next_section_ends_them():
    docs = field_docs(Tree)
    assert docs["budget_s"] == "seconds, or None where there is no limit."
    assert docs["mode"] == "how; ``slow`` is exact."
    assert set(docs) == {"bars", "toy", "toys", "count", "budget_s", "loud", "mode", "weights", "names"}


def test_names_that_share_an_entry_share_its_lines_and_a_docstring_may_begin_with_args():
    assert field_docs(Bars) == {
        "near_m": "how close and how far a thing may be.",
        "far_m": "how close and how far a thing may be.",
        "turn_deg": "largest turn.",
    }


def test_a_class_without_args_says_nothing():
    class Silent:
        """Only this."""

    class Bare:
        pass

    assert field_docs(Silent) == field_docs(Bare) == {}


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("size_m", "m"),
        ("area_m2", "m^2"),
        ("turn_rad", "rad"),
        ("cell_cm", "cm"),
        ("side_px", "px"),
        ("limit_mb", "MB"),
        ("keep_days", "days"),
        ("num_items", ""),
        ("m", ""),
    ],
)
def test_units_are_endings_of_names(name, unit):
    assert unit_of(name) == unit
