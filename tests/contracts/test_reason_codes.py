"""Contract: every code of an error or a reason is registered once, and every registered code is used."""

from __future__ import annotations

import ast
import functools
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import gsmap
from gsmap import errors
from gsmap.errors import ConfigError, GsmapError, InputError, MissingDependencyError
from gsmap.reason_codes import REASONS, reason, reason_code
from tools.make.error_codes import ERRORS

PACKAGE = Path(gsmap.__file__).parent
CLASSES = {name: kind for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, GsmapError)}
PRECISE = {
    "NotGaussiansError",
    "NotPinholesError",
    "DiskFullError",
    "ReadOnlyError",
    "DiskError",
    "MissingDependencyError",
}
"""Classes with one cause, so that their own code is precise."""


@functools.cache
def _trees() -> list[tuple[Path, ast.AST]]:
    return [(path, ast.parse(path.read_text())) for path in sorted(PACKAGE.rglob("*.py"))]


def _constructions(tree: ast.AST) -> Iterator[tuple[ast.Call, str, str | None]]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "id", getattr(node.func, "attr", ""))
        given = {k.arg: k.value for k in node.keywords}.get("code")
        if name in CLASSES:
            yield node, name, given.value if isinstance(given, ast.Constant) else None if given is None else ""


def test_every_error_is_raised_with_a_code() -> None:
    without = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path, tree in _trees()
        for node, name, code in _constructions(tree)
        if code is None and name not in PRECISE and path.name not in ("errors.py", "app.py")
    ]
    assert without == []


def test_codes_are_registered_and_used() -> None:
    used = {kind.code for kind in CLASSES.values()}
    words = set()
    for path, tree in _trees():
        used |= {code for _, _, code in _constructions(tree) if code}
        if path.name not in ("reason_codes.py",):
            words |= {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    assert used <= set(ERRORS), "list them in tools/make/error_codes.py"
    assert set(ERRORS) - used <= words, "delete what is not used from tools/make/error_codes.py"


def test_codes_are_words_and_meanings_are_sentences() -> None:
    for code, meaning in [*ERRORS.items(), *((code, meaning) for code, (meaning, _) in REASONS.items())]:
        assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", code)
        assert meaning[0].isupper() or meaning.startswith("gsmap")
        assert meaning.endswith(".")


@pytest.mark.parametrize("kind", CLASSES.values(), ids=list(CLASSES))
def test_codes_survive_pickling(kind: type[GsmapError]) -> None:
    for error in (kind("text"), kind("text", code="out_of_range")):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is kind
        assert str(again) == "text"
        assert again.code == error.code


def test_without_a_code_an_error_has_that_of_its_class() -> None:
    assert InputError("text").code == "input"
    assert ConfigError("text").code == "config"
    assert MissingDependencyError("text").code == "missing_dependency"
    assert InputError("text", code="not_finite").code == "not_finite"


def test_reasons_are_registered_and_used() -> None:
    used = {
        node.args[0].value
        for _, tree in _trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") == "reason"
        and isinstance(node.args[0], ast.Constant)
    }
    assert used == set(REASONS) - {"other"}


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("12% of the points seen contradict what cameras saw, allowed 5%", "free_space_violation"),
        ("12% of the surface seen contradicts what cameras saw, allowed 5%", "free_space_violation"),
        ("a place that looks alike? (others of this map that disagree so are)", "aliased_places"),
        ("contradicts what else is known of the two islands", "contradicts_component"),
        ("no match that chance would not explain (colours disagree)", "no_pose_proposed"),
        (
            "no pose proposed that the background model does not explain (the poorer graph has 7 nodes)",
            "no_pose_proposed",
        ),
        ("no pose that more nodes support than chance would (the poorer graph has 7)", "no_pose_proposed"),
        ("comparing shapes needs scenes in metres, and the unit of one is not known", "unit_unknown"),
        ("contradicts what else is known of the two components", "contradicts_component"),
        ("correspondences do not fit one pose", "inconsistent_correspondences"),
        ("no pose under which features of both surfaces agree", "no_pose_proposed"),
        ("it shows too little: 3 features", "too_few_features"),
        ("shapes are compared in metres, and a unit is not known", "unit_unknown"),
        ("surfaces pull the pose away from its correspondences, which chance explains", "correspondences_lost"),
        ("the map shows nothing to compare it with", "no_views"),
        ("the other bars contradict it", "contradicts_observations"),
        ("the overlap fixes the pose only to 3.1 deg, 8 cm", "pose_uncertain"),
        ("the only tie to the rest, and its own verdict is not strong enough to attach by itself", "unconfirmed"),
        ("what it shows fixes its pose only to 1.0 deg and 8 cm", "pose_uncertain"),
        ("what the map shows there is not in the picture: 3 patches found, needs 12", "not_confirmed"),
        ("ties two islands that nothing else joins", "unconfirmed"),
        ("too few nodes agree (the poorer graph has 7)", "no_pose_proposed"),
        ("would join two islands of 5 or more scenes: needs 2 agreeing edges over 2 scene pairs", "too_few_edges"),
    ],
)
def test_stored_reasons_of_earlier_releases_have_codes(text: str, code: str) -> None:
    assert reason_code(text) == code


def test_the_code_of_a_reason_is_that_of_its_text() -> None:
    assert reason_code("") == ""
    assert reason_code("something else") == "other"
    assert reason_code("12% of what both saw is not the same in both; places that look alike?") == "surfaces_differ"
    assert reason_code(reason("ambiguous", "ambiguous: two poses")) == "ambiguous"
    with pytest.raises(AssertionError, match="give 'ambiguous' in REASONS a pattern"):
        reason("ambiguous", "two poses fit")
