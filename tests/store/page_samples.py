"""Pages of a catalog to write and to damage."""

from pathlib import Path

from gsmap.store import Store

PAGE = 4096


def fill(store: Store, count: int = 3) -> None:
    for i in range(count):
        store.exports.begin(f"/out/{i}", revision=None, settings={"x": "y" * 9000})


def flip(file: Path, offset: int) -> None:
    with open(file, "rb+") as opened:
        opened.seek(offset)
        byte = opened.read(1)[0]
        opened.seek(offset)
        opened.write(bytes([byte ^ 4]))
