"""Groups as archives: what lies where, what other programs make of them, and how many files a capture takes."""

import zipfile

import numpy as np
import pytest
import zarr
from store_samples import key, make_cameras, make_gaussians
from zarr.storage import ZipStore

from gsmap.errors import CorruptError
from gsmap.store import Store, array_archive
from gsmap.store.layout import CHUNK_ROWS
from gsmap.types import NodeLayer, SceneGraph

ARRAYS = {
    "means": np.random.default_rng(0).normal(size=(70, 3)).astype(np.float32),
    "sh": np.random.default_rng(1).normal(size=(70, 4, 3)).astype(np.float32),
    "names": np.arange(9, dtype=np.uint8),
    "none": np.zeros((0, 3)),
    "narrow": np.zeros((5, 0), np.float32),
}


def written(path, **arrays):
    array_archive.write(path, arrays or ARRAYS, chunk_rows=16)
    data = path.read_bytes()
    return data, array_archive.read_members(len(data), lambda start, stop: data[start:stop])


def test_zarr_opens_an_archive_by_itself(tmp_path):
    written(tmp_path / "a.zip")
    with ZipStore(tmp_path / "a.zip", mode="r") as store:
        group = zarr.open_group(store, mode="r", zarr_format=3)
        assert sorted(group.array_keys()) == sorted(ARRAYS)
        assert all(np.array_equal(group[name][...], array) for name, array in ARRAYS.items())


def test_members_are_where_unzip_finds_them(tmp_path):
    data, members = written(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.testzip() is None
        assert archive.namelist() == list(members)
        for info in archive.infolist():
            member = members[info.filename]
            assert archive.read(info) == data[member.start : member.start + member.size]
            assert member.crc32 == info.CRC


def test_the_same_arrays_are_the_same_bytes(tmp_path, monkeypatch):
    first, _ = written(tmp_path / "a.zip")
    monkeypatch.setattr("time.time", lambda: 2e9)
    assert written(tmp_path / "b.zip")[0] == first


def test_rows_of_all_long_arrays_lie_together_and_what_is_small_at_the_end(tmp_path):
    _, members = written(tmp_path / "a.zip")
    names = list(members)
    rows = [[f"means/c/{i}/0", f"sh/c/{i}/0/0"] for i in range(5)]
    assert names[:11] == [*(name for row in rows for name in row), "names/c/0"]
    assert all(name.endswith("zarr.json") for name in names[11:])


def test_an_archive_of_more_members_than_a_short_one_counts(tmp_path):
    """Beyond 65,535 members zip has other ends: zip64."""
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(65_600):
            archive.writestr(zipfile.ZipInfo(f"x/c/{i}"), b"1")
    data = path.read_bytes()
    members = array_archive.read_members(len(data), lambda start, stop: data[start:stop])
    assert len(members) == 65_600
    last = members["x/c/65599"]
    assert data[last.start : last.start + last.size] == b"1"


@pytest.mark.parametrize("at", [0, 3, 21, 40, 60, 100])
def test_every_cut_is_told(tmp_path, at):
    data, _ = written(tmp_path / "a.zip")
    short = data[: len(data) - 1 - at]
    with pytest.raises(ValueError):
        array_archive.read_members(len(short), lambda start, stop: short[start:stop])


def test_no_flip_of_a_bit_changes_what_is_read(tmp_path):
    """Every byte of an archive: it is refused, or reads as it was written; never anything else."""
    with Store.create(tmp_path / "m") as store:
        g = make_gaussians(40)
        scene, _ = store.scenes.add(g, make_cameras(), name="a")
        whole = store.scenes.gaussians("a")
        (path,) = (store.folder / "arrays" / "scenes" / scene.id).iterdir()
        data = path.read_bytes()
        refused = 0
        for at in range(0, len(data), 61):
            path.write_bytes(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :])
            try:
                read = store.scenes.gaussians("a")
            except CorruptError:
                refused += 1
                continue
            assert all(np.array_equal(getattr(read, n), getattr(whole, n)) for n in ("means", "quats", "sh"))
        assert refused > 0.5 * len(data) / 61


def test_a_capture_takes_two_files_and_its_pieces_are_read_alone(tmp_path, monkeypatch):
    with Store.create(tmp_path / "m") as store:
        g = make_gaussians(3 * CHUNK_ROWS)
        scene, _ = store.scenes.add(g, make_cameras(), name="a")
        layer = NodeLayer(*(np.zeros((5, 3)), np.ones((5, 8)), np.zeros(5), np.ones(5), np.zeros((5, 2, 3))),
                          np.ones((5, 2)), np.zeros(5), "test")  # fmt: skip
        store.graphs.save(SceneGraph(scene.id, {"objects": layer}), key("describe", scene.id))
        files = [path for path in (store.folder / "arrays").rglob("*") if path.is_file()]
        assert len(files) == 2
        with store.catalog.read() as connection:
            assert connection.exec_driver_sql("SELECT count(*) FROM files").scalar() == 2
        read = []
        real = packed_reads(monkeypatch, read)
        box = store.scenes.gaussians("a").means[:100].astype(float)
        read.clear()
        some = store.scenes.gaussians("a", np.stack([box.min(0), box.min(0) + 1e-3]))
        assert 0 < sum(read) < 0.75 * files[0].stat().st_size + files[1].stat().st_size, real
        assert len(some) < len(g)


def packed_reads(monkeypatch, sizes):
    """Note how many bytes every read of a file takes."""
    import os

    real = os.pread

    def pread(handle, count, at):
        found = real(handle, count, at)
        sizes.append(len(found))
        return found

    monkeypatch.setattr(os, "pread", pread)
    return real
