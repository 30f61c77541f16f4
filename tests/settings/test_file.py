"""The file of a map's settings: round trip, and what a person wrote into it stays."""

import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.settings import changed, differences, load, save

VALUES = {
    "bars.far_m": 0.1 + 0.2,
    "toys.wood.label": 'a "b"',
    "count": 9,
    "budget_s": None,
    "loud": True,
    "weights": (0.5, 2.0),
    "names": (),
}


def test_settings_round_trip_none_among_them(tmp_path, tree):
    path = tmp_path / "settings.toml"
    save(path, VALUES)
    assert changed(tree, load(path)) == changed(tree, VALUES)
    with_limit = changed(tree, {"budget_s": 3.0})
    assert differences(changed(with_limit, load(path)), changed(tree, VALUES)) == {}  # none takes the limit back
    assert load(tmp_path / "none.toml") == {}


def test_a_persons_comments_and_order_stay(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("# ours\n[bars]\nfar_m = 2.0 # measured\nnear_m = 1.0\n\n[other]\nkept = 'yes'\n")
    save(path, {"bars.far_m": 3.0, "count": 4}, drop=("bars.near_m", "no.such"))
    text = path.read_text()
    assert text.startswith("# ours\n")
    assert "far_m = 3.0 # measured" in text
    assert "near_m" not in text
    assert load(path) == {"bars.far_m": 3.0, "other.kept": "yes", "count": 4}


def test_what_goes_back_to_its_default_leaves_no_empty_table(tmp_path):
    path = tmp_path / "settings.toml"
    save(path, {"a.b.c": 1, "a.d": 2})
    save(path, {}, drop=("a.b.c",))
    assert load(path) == {"a.d": 2}
    assert "b" not in path.read_text().splitlines()[-2:][0]


@pytest.mark.parametrize("content", [b"a = \n", b"\xff\xfe\x00"])
def test_a_file_that_is_not_toml_is_named(tmp_path, content):
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with raises(ConfigError, code="invalid_settings_file", match=r"settings\.toml"):
        load(path)
