"""Plain values: what JSON can hold, with every bit of a number kept."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.types.plain import canonical, plain


@dataclass(frozen=True)
class Inner:
    size_m: float = 0.1
    sides: tuple[int, ...] = (1, 2)


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    name: str = "a"
    nothing: None = None


def test_everything_becomes_what_json_holds():
    value = {"a": np.float32(0.1), "b": (np.int64(3), np.bool_(True)), "c": np.arange(3), 4: Outer(), "p": Path("x/y")}
    out = plain(value)
    assert out["a"] == float(np.float32(0.1))
    assert type(out["b"][0]) is int
    assert out["b"][1] is True
    assert out["c"] == [0, 1, 2]
    assert out["4"] == {"inner": {"size_m": 0.1, "sides": [1, 2]}, "name": "a", "nothing": None}
    assert out["p"] == "x/y"
    assert json.loads(json.dumps(out)) == out


def test_floats_keep_their_bits():
    for value in (0.1 + 0.2, 1e-308, np.nextafter(1.0, 2.0)):
        assert json.loads(canonical({"x": value}))["x"] == float(value)


def test_the_canonical_text_does_not_depend_on_order_and_does_on_every_value():
    assert canonical({"a": 1, "b": 2}) == canonical({"b": 2, "a": 1})
    assert canonical({"a": 1}) != canonical({"a": 2})
    assert canonical({"a": [1, 2]}) != canonical({"a": [2, 1]})
    assert canonical(Outer()) == canonical(Outer(Inner()))
    assert canonical(Outer()) != canonical(Outer(Inner(0.2)))
