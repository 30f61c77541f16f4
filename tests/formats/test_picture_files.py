"""Pictures from outside: five formats, whatever the name, and no more pixels than a header may claim."""

from __future__ import annotations

import ast
import json
import os
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

import gsmap
from gsmap import formats
from gsmap.describe import query_embedding
from gsmap.errors import InputError, MissingDependencyError, NotFoundError
from gsmap.evaluate.renders import read_image
from gsmap.formats.pictures import MAX_PIXELS, open_picture
from gsmap.formats.scans import read_depth
from gsmap.ingest import dates
from gsmap.localize import read_photo
from gsmap.localize.photos import read_mask
from gsmap.map.localization import photo_poses
from gsmap.world import exif

POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\n%%EndComments\nshowpage\n%%EOF\n"


def png(width: int, height: int, data: bytes = b"") -> bytes:
    """A grey PNG whose header claims a size that its data need not have."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def frames(path: Path) -> object:
    """The cameras of a ``transforms.json`` that leaves the sizes to its pictures."""
    frame = {"file_path": path.name, "transform_matrix": np.eye(4).tolist(), "fl_x": 100.0}
    path.with_name("transforms.json").write_text(json.dumps({"frames": [frame]}))
    return formats.read_cameras(path.with_name("transforms.json"))


READERS: dict[str, Callable[[Path], object]] = {
    "localize": read_photo,
    "mask": lambda path: read_mask("p.png", _as_mask(path), (8, 8)),
    "evaluate": read_image,
    "depth": lambda path: read_depth(path, (100.0, 100.0, 4.0, 4.0)),
    "nerfstudio": frames,
    "placed photos": photo_poses._size,
    "find": query_embedding._picture,
}
QUIET: dict[str, Callable[[Path], object]] = {"exif": exif.read, "dates": dates._exif_date}


def _photo(path: Path) -> Path:
    Image.new("RGB", (8, 8)).save(path)
    return path


def _as_mask(path: Path) -> Path:
    folder = path.with_name("masks")
    folder.mkdir()
    path.rename(folder / "p.png.png")
    return folder


@pytest.fixture
def ghostscript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that is there once anybody started ``gs``."""
    ran, stub = tmp_path / "ran", tmp_path / "bin" / "gs"
    stub.parent.mkdir()
    stub.write_text(f"#!/bin/sh\ntouch {ran}\nexit 1\n")
    stub.chmod(0o755)
    monkeypatch.setenv("PATH", f"{stub.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    return ran


@pytest.mark.parametrize("reader", READERS | QUIET)
def test_a_photograph_that_is_postscript_starts_no_program(tmp_path: Path, ghostscript: Path, reader: str) -> None:
    (tmp_path / "photo.jpg").write_bytes(POSTSCRIPT)
    if reader in QUIET:
        assert QUIET[reader](tmp_path / "photo.jpg") is None
    else:
        with pytest.raises(InputError):
            READERS[reader](tmp_path / "photo.jpg")
    assert not ghostscript.exists()


@pytest.mark.parametrize("size", [(30_000, 30_000), (12_000, 12_000)])
@pytest.mark.parametrize("reader", READERS | QUIET)
@pytest.mark.filterwarnings("error")
def test_a_header_that_claims_a_bomb_is_an_error_before_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str, size: tuple[int, int]
) -> None:
    """Beyond what Pillow refuses, and between its warning and that."""
    (tmp_path / "photo.png").write_bytes(png(*size))
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda picture: pytest.fail("it was decoded"))
    if reader in QUIET:
        assert QUIET[reader](tmp_path / "photo.png") is None
    else:
        with pytest.raises(InputError):
            READERS[reader](tmp_path / "photo.png")


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
@pytest.mark.parametrize("damage", ["cut", "text", "empty", "short"])
def test_a_damaged_picture_is_an_input_error(tmp_path: Path, reader: str, damage: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "photo.tiff")
    whole = (tmp_path / "photo.tiff").read_bytes()
    if (damage, reader) == ("cut", "nerfstudio"):
        pytest.skip("it reads the header alone")
    content = {"cut": whole[: len(whole) // 2], "text": b"no picture", "empty": b"", "short": whole[:9]}[damage]
    (tmp_path / "photo.tiff").write_bytes(content)
    with pytest.raises(InputError):
        READERS[reader](tmp_path / "photo.tiff")


@pytest.mark.parametrize("reader", sorted({*READERS} - {"mask"}))
def test_what_is_no_file_is_told(tmp_path: Path, reader: str) -> None:
    (tmp_path / "photo.jpg").mkdir()
    with pytest.raises((NotFoundError, InputError)):
        READERS[reader](tmp_path / "photo.jpg")


@pytest.mark.parametrize("form", ["JPEG", "MPO", "PNG", "WEBP", "TIFF"])
def test_each_format_is_read_whatever_its_name(tmp_path: Path, form: str) -> None:
    """MPO: a JPEG with more pictures behind it, as phones and drones write."""
    Image.new("RGB", (24, 16), (200, 100, 50)).save(tmp_path / "a.jpg", form, quality=95)
    rgb = read_photo(tmp_path / "a.jpg").rgb
    assert rgb.shape == (16, 24, 3)
    assert np.abs(rgb.astype(int) - [200, 100, 50]).max() < 8


@pytest.mark.parametrize("form", ["GIF", "BMP", "PPM", "ICO", "TGA", "PDF"])
def test_no_other_format_is_read(tmp_path: Path, form: str) -> None:
    Image.new("RGB", (24, 16)).save(tmp_path / "a.png", form)
    with pytest.raises(InputError):
        read_photo(tmp_path / "a.png")


def test_a_photo_is_turned_upright(tmp_path: Path) -> None:
    picture = Image.new("RGB", (24, 16))
    tags = picture.getexif()
    tags[0x0112] = 6
    picture.save(tmp_path / "a.jpg", exif=tags)
    assert read_photo(tmp_path / "a.jpg").size_px == photo_poses._size(tmp_path / "a.jpg") == (16, 24)


def test_large_photographs_are_opened_without_a_warning(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    (tmp_path / "a.png").write_bytes(png(12_000, 9_000))  # those of a phone of 108 Mpx
    with open_picture(tmp_path / "a.png") as picture:
        assert picture.size == (12_000, 9_000)
    assert not list(recwarn)
    assert MAX_PIXELS > 12_000 * 9_000


def test_a_decoder_that_finds_no_memory_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError), open_picture(_photo(tmp_path / "a.png")):
        raise MemoryError


def test_a_heic_photo_names_what_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(64))
    with pytest.raises(MissingDependencyError):
        read_photo(tmp_path / "a.jpg")
    with pytest.raises(InputError), open_picture(tmp_path / "a.jpg", formats=["JPEG"]):
        pytest.fail("it was opened")


def test_a_heic_photo_is_read_where_pillow_heif_is(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    heif.from_pillow(Image.new("RGB", (64, 48), (200, 100, 50))).save(tmp_path / "a.heic", quality=95)
    rgb = read_photo(tmp_path / "a.heic").rgb
    assert rgb.shape == (48, 64, 3)
    assert np.abs(rgb.astype(int) - [200, 100, 50]).max() < 12


def test_nothing_else_opens_pictures() -> None:
    """A new reader goes through `open_picture`, too."""
    root = Path(gsmap.__file__).parent
    opens = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and node.attr == "open" and ast.unparse(node.value).endswith("Image")
    }
    assert opens == {"formats/pictures.py"}
