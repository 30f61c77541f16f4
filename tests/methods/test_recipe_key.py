"""A key changes with everything that makes a result, and with nothing else."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from gsmap.methods import RecipeKey, text_digest
from gsmap.types.plain import canonical


@dataclass(frozen=True)
class Params:
    bar: float = 0.5
    names: tuple[str, ...] = ("a",)


KEY = RecipeKey("merge", "tto", {"merge": 3, "merger.tto": 1}, {"params": Params()}, "native", ("s1", "s2"))


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "register"},
        {"method": "union"},
        {"version": {"merge": 4, "merger.tto": 1}},
        {"version": {"merge": 3, "merger.tto": 1, "refiner.gicp": 1}},
        {"settings": {"params": Params(bar=np.nextafter(0.5, 1))}},
        {"settings": {"params": Params(names=("a", "b"))}},
        {"backend": "gsplat"},
    ],
)
def test_every_part_of_the_recipe_names_the_result(change):
    other = replace(KEY, **change)
    assert other.recipe != KEY.recipe
    assert other.digest != KEY.digest


@pytest.mark.parametrize("inputs", [("s1",), ("s2", "s1"), ("s1s2",), ()])
def test_inputs_name_the_result_and_not_the_recipe(inputs):
    other = KEY.of(*inputs)
    assert other.recipe == KEY.recipe
    assert other.digest != KEY.digest


def test_equal_recipes_have_equal_keys_in_whatever_order_they_are_said():
    again = RecipeKey(
        "merge", "tto", {"merger.tto": 1, "merge": 3}, {"params": {"names": ["a"], "bar": 0.5}}, "native"
    ).of("s1", "s2")
    assert (again.recipe, again.digest) == (KEY.recipe, KEY.digest)
    assert len(KEY.digest) == 32
    assert int(KEY.digest, 16) >= 0


def test_the_recipe_is_told_without_its_inputs():
    assert KEY.to_json() == {
        "stage": "merge",
        "method": "tto",
        "version": {"merge": 3, "merger.tto": 1},
        "settings": {"params": {"bar": 0.5, "names": ["a"]}},
        "backend": "native",
    }


@pytest.mark.parametrize(
    "inputs", [("s1", "s2"), ("a" * 32, "auto"), ('a","b',), ("é", "b"), ("a b", ""), ("a:b",), ()]
)
def test_a_digest_is_that_of_the_canonical_text(inputs):
    assert KEY.digest_of(*inputs) == KEY.of(*inputs).digest == text_digest(canonical([KEY.recipe, list(inputs)]))
