import os
import sys

import numpy as np
import pytest
from raising import raises

import gsmap
from gsmap import formats
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.methods import family
from gsmap.methods.family import _loaded
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


def test_longest_suffix_wins():
    assert formats.suffix_of("a/b.COMPRESSED.ply") == ".compressed.ply"
    assert formats.suffix_of("a/b.ply") == ".ply"
    assert formats.suffix_of("a/plain") is None


def test_a_name_without_a_dot_is_a_whole_name():
    assert formats.suffix_of("a/META.json") == "meta.json"
    assert formats.suffix_of("a/lod-meta.json") == "lod-meta.json"
    assert formats.suffix_of("a/hall.meta.json") is None  # what somebody says of hall.ply


@pytest.fixture
def added(tmp_path, monkeypatch):
    """A package, installed as pip would, that adds a format with a layout of its own and one that cannot be loaded."""
    site = tmp_path / "site"
    about = site / "lists-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lists\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[gsmap.formats]\n.list.ply = splat_lists\n.torn = no_such_module\n")
    (site / "splat_lists.py").write_text(
        "import numpy as np\n"
        "from gsmap.types import FileInfo, Gaussians\n"
        "VERSION = 3\n"
        "NAMES = 'means', 'quats', 'log_scales', 'logit_opacities', 'sh'\n"
        "def read(path):\n"
        "    with np.load(open(path, 'rb')) as file:\n"
        "        return Gaussians(*(file[name] for name in NAMES))\n"
        "def write(path, gaussians, *, loud=False):\n"
        "    np.savez(open(path, 'wb'), **{name: getattr(gaussians, name) for name in NAMES})\n"
        "def info(path):\n"
        "    return FileInfo(notes=('a list',))\n"
    )
    monkeypatch.syspath_prepend(site)
    yield "splat_lists"
    sys.modules.pop("splat_lists", None)
    _loaded.cache_clear()


def test_another_package_adds_a_format(added, tmp_path):
    path = tmp_path / "a.list.ply"
    formats.write(path, one(4, degree=2), loud=True)
    np.testing.assert_array_equal(formats.read(path).sh, one(4, degree=2).sh)
    assert formats.info(path).notes == ("a list",)
    assert family("format").version(".list.ply") == {"format.list.ply": 3}
    formats.write(tmp_path / "b.ply", one())
    assert len(formats.read(tmp_path / "b.ply")) == 3
    assert ".list.ply" in formats.known("read")
    assert ".torn" not in formats.known("read")
    with raises(ConfigError, code="method_not_loadable"):
        formats.read(tmp_path / "a.torn")


def test_built_in_formats_keep_their_contract():
    assert set(family("format").names()) >= {
        ".ply",
        ".compressed.ply",
        ".glb",
        ".sog",
        ".splat",
        ".spz",
        "tileset.json",
    }
    for suffix in family("format").names():
        module = family("format").get(suffix)
        assert isinstance(module.VERSION, int)
        assert hasattr(module, "read") or hasattr(module, "write")


def test_unknown_suffix_lists_what_is_known(tmp_path):
    for call in (lambda p: formats.read(p), lambda p: formats.write(p, one())):
        with raises(InputError, code="unsupported_format"):
            call(tmp_path / "a.xyz")


def test_missing_file_and_folder(tmp_path):
    with raises(NotFoundError, code="file_not_found"):
        gsmap.read(tmp_path / "a.ply")
    with raises(NotFoundError, code="folder_not_found"):
        gsmap.write(tmp_path / "none" / "a.ply", one())
    (tmp_path / "d.ply").mkdir()
    with raises(InputError, code="file_unreadable"):
        gsmap.read(tmp_path / "d.ply")


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    formats.write(path, one())
    before = path.read_bytes()

    def replace(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", replace)
    with raises(InputError, code="not_writable"):
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


@pytest.mark.parametrize("suffix", sorted(set(formats.known("read")) & set(formats.known("write"))))
def test_every_format_that_is_written_is_read_by_name_and_makes_its_folder(tmp_path, suffix):
    """A format that is a folder makes it, and what lies above it; others want theirs to be there."""
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    g = one(40)
    if suffix.startswith("."):
        path = tmp_path / f"a{suffix}"
    else:
        path = tmp_path / "new" / "place" / suffix
    formats.write(path, g)
    back = formats.read(path)
    assert len(back) == 40
    ours, theirs = (np.sort(x.means, axis=0) for x in (g, back))
    np.testing.assert_allclose(theirs, ours, atol=0.01)
    assert not list(path.parent.rglob(".*"))
