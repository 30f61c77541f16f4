import os

import numpy as np
import pytest

import gsmap
from gsmap import formats
from gsmap.errors import InputError, NotFoundError
from gsmap.types import Gaussians


def one(n: int = 3, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(0)
    k = (degree + 1) ** 2
    return Gaussians(
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(size=(n, 3)),
        rng.normal(size=n),
        rng.normal(size=(n, k, 3)),
    )


def test_longest_suffix_wins(monkeypatch):
    monkeypatch.setitem(formats.MODULES, ".compressed.ply", "compressed_ply")
    assert formats.suffix_of("a/b.COMPRESSED.ply") == ".compressed.ply"
    assert formats.suffix_of("a/b.ply") == ".ply"
    assert formats.suffix_of("a/plain") is None


def test_unknown_suffix_lists_what_is_known(tmp_path):
    for call in (lambda p: formats.read(p), lambda p: formats.write(p, one())):
        with pytest.raises(InputError, match=r"\.xyz.*\.ply"):
            call(tmp_path / "a.xyz")


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(NotFoundError, match="no such file"):
        gsmap.read(tmp_path / "a.ply")
    with pytest.raises(NotFoundError, match="no such folder"):
        gsmap.write(tmp_path / "none" / "a.ply", one())
    (tmp_path / "d.ply").mkdir()
    with pytest.raises(InputError, match="directory"):
        gsmap.read(tmp_path / "d.ply")


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    formats.write(path, one())
    before = path.read_bytes()

    def replace(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(InputError, match="No space left"):
        formats.write(path, one(5))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_damaged_file_says_stays_within_one_line(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty list " + b"y" * 3000 + b"\n")
    with pytest.raises(InputError) as caught:
        formats.read(path)
    (tmp_path / "cameras.json").write_text('[{"id": "' + "a\\n" * 2000 + '"}]')
    with pytest.raises(InputError) as also:
        formats.read_cameras(tmp_path / "cameras.json")
    for error in (caught, also):
        assert len(str(error.value)) < len(str(tmp_path)) + 400
        assert "\n" not in str(error.value)
