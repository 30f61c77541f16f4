"""`Map.localize` and ``gsmap localize``: features are made once and kept; whatever cannot be is told in one line."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import io
import json
import os
import resource
import shutil
import weakref
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raising import raises

import gsmap.map
from gsmap.cli.app import run
from gsmap.errors import ConfigError, CorruptError, InputError, NotFoundError, ReadOnlyError, StoreError
from gsmap.localize import Lens, index_recipe, photo_in_memory, read_photo
from gsmap.map.localization.localize import Localizer, feature_keys
from gsmap.map.page.source import view_of
from gsmap.map.settings import settings_of
from gsmap.map.small_map.export import SmallLocalizer
from gsmap.map.small_map.localize import localize_small
from gsmap.store import Store
from gsmap.types import Sim3


@pytest.fixture(scope="module")
def made(world, tmp_path_factory):
    """A map of one capture, and a photograph of it in a file."""
    folder = tmp_path_factory.mktemp("localize")
    photo = world.photos[1]
    Image.fromarray(photo.rgb).save(folder / "photo.png")
    with gsmap.map.create(folder / "m.gsmap") as m:
        m.ingest(world.capture.gaussians, cameras=world.capture.cameras, name="room")
        m.optimize()
        lens = ",".join(f"{value:.3f}" for value in photo.intrinsics_px)
        report = m.localize(folder / "photo.png", intrinsics=lens)
    return folder, lens, report


def test_a_photo_in_a_file_is_placed(made, world) -> None:
    folder, _, report = made
    (row,) = report.results
    assert row.status == "placed", row.reason
    assert row.scenes == ("room",)
    with gsmap.map.open(folder / "m.gsmap") as m:
        S_map_scene = m.pose_graph().poses[m.scenes()[0].id].S_map_scene
    truth = S_map_scene @ world.S_world_scene.inverse() @ Sim3.from_matrix(world.poses[1])
    assert np.linalg.norm(row.T_map_camera[:3, 3] - truth.translation) < 0.05
    assert row.to_json()["S_map_scan"] is None


def test_photos_in_memory_are_placed_like_files(made, world) -> None:
    """The same pixels, as an array of bytes or floats or as a PIL image, beside a file: the same pose, in order."""
    folder, lens, report = made
    rgb = world.photos[1].rgb
    given = [rgb, Image.fromarray(rgb), folder / "photo.png", rgb.astype(np.float32) / 255]
    numbers = [float(value) for value in lens.split(",")]
    with gsmap.map.open(folder / "m.gsmap") as m:
        rows = m.localize(*given, intrinsics=numbers).results
        with raises(ConfigError, code="option_not_applicable"):
            m.localize(rgb, masks=folder)
    assert [row.file for row in rows] == ["photo_0", "photo_1", str(folder / "photo.png"), "photo_3"]
    for row in rows:
        np.testing.assert_array_equal(row.T_map_camera, report.results[0].T_map_camera)


@pytest.mark.parametrize(
    ("pixels", "code"),
    [
        (np.zeros((4, 5, 2), np.uint8), "shape_mismatch"),
        (np.zeros((0, 5, 3), np.uint8), "shape_mismatch"),
        (np.full((4, 5, 3), 200.0), "out_of_range"),
        (np.full((4, 5, 3), np.nan), "out_of_range"),
        (np.zeros((4, 5, 3), np.int64), "wrong_type"),
        ("a name", "shape_mismatch"),
    ],
)
def test_what_is_no_image_in_memory_is_refused(pixels, code) -> None:
    with raises(InputError, code=code):
        photo_in_memory(pixels)


def test_images_in_memory_are_rgb_and_upright() -> None:
    grey = np.arange(20, dtype=np.uint8).reshape(4, 5)
    np.testing.assert_array_equal(photo_in_memory(grey).rgb, np.repeat(grey[..., None], 3, axis=2))
    with_alpha = np.dstack([np.full((4, 5, 3), 7, np.uint8), np.zeros((4, 5), np.uint8)])
    assert (photo_in_memory(with_alpha).rgb == 7).all()
    turned = Image.fromarray(np.dstack([grey] * 3))
    turned.getexif()[0x0112] = 6  # to be turned clockwise
    photo = photo_in_memory(turned)
    np.testing.assert_array_equal(photo.rgb[..., 0], np.rot90(grey, -1))
    assert turned.size == (5, 4)  # the caller's is as it was


def test_features_are_made_once(made, monkeypatch) -> None:
    folder, lens, report = made

    def never(*arguments):
        raise AssertionError("features were made again")

    monkeypatch.setattr("gsmap.map.localization.localize.features_of_scene", never)
    with gsmap.map.open(folder / "m.gsmap") as m:
        again = m.localize(folder / "photo.png", intrinsics=lens)
    assert np.array_equal(again.results[0].T_map_camera, report.results[0].T_map_camera)


def test_near_rules_out_what_is_elsewhere(made) -> None:
    folder, lens, report = made
    x, y, z = report.results[0].T_map_camera[:3, 3]
    with gsmap.map.open(folder / "m.gsmap") as m:
        assert m.localize(folder / "photo.png", intrinsics=lens, near="room").results[0].status == "placed"
        assert m.localize(folder / "photo.png", intrinsics=lens, near=f"{x},{y},{z},1").results[0].status == "placed"
        far = m.localize(folder / "photo.png", intrinsics=lens, near=f"{x + 1.5},{y},{z},1").results[0]
        assert far.status == "refused"
        assert far.T_map_camera is None
        with raises(ConfigError, code="invalid_point"):
            m.localize(folder / "photo.png", near="1,2,3")
        with pytest.raises(NotFoundError):
            m.localize(folder / "photo.png", near="nowhere")


def test_the_command_line_answers_in_json(made, capsys) -> None:
    folder, lens, _ = made
    with pytest.raises(SystemExit) as ended:
        run(["-q", "localize", str(folder / "m.gsmap"), str(folder / "photo.png"), "--intrinsics", lens, "--json"])
    assert not ended.value.code
    told = json.loads(capsys.readouterr().out)
    assert told["schema"] == 2
    assert [row["status"] for row in told["results"]] == ["placed"]
    assert np.array(told["results"][0]["covariance"]).shape == (6, 6)


def test_nothing_is_begun_where_a_file_is_no_picture(made) -> None:
    folder, _, _ = made
    (folder / "text.jpg").write_text("none")
    with gsmap.map.open(folder / "m.gsmap") as m:
        with raises(InputError, code="picture_unreadable"):
            m.localize(folder / "photo.png", folder / "text.jpg")
        with pytest.raises(NotFoundError):
            m.localize(folder / "none.jpg")
        with raises(ConfigError, code="nothing_requested"):
            m.localize()
        for lens in ({"intrinsics": "1,2,3"}, {"focal": "wide"}, {"intrinsics": "1,2,3,4", "focal": 5}):
            with pytest.raises(ConfigError):
                m.localize(folder / "photo.png", **lens)


def test_an_empty_map_says_what_to_do(made, tmp_path) -> None:
    with gsmap.map.create(tmp_path / "e.gsmap") as m, raises(NotFoundError, code="no_placed_scene"):
        m.localize(made[0] / "photo.png")


# --- what placed photographs tell, and those that are kept ----------------------------------------------------------


@pytest.fixture
def copy(made, tmp_path):
    """A map of its own, and the photo with a box of stripes standing in it."""
    folder, lens, _ = made
    with gsmap.map.open(folder / "m.gsmap") as m:
        m.clone(tmp_path / "c.gsmap")
    rgb = np.asarray(Image.open(folder / "photo.png")).copy()
    stripes = np.array([[230, 40, 40], [40, 220, 60]], np.uint8)[(np.arange(130) // 12) % 2]
    rgb[130:260, 250:350] = stripes[:, None]
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = "2026:05:04 10:00:00"
    Image.fromarray(rgb).save(tmp_path / "changed.jpg", quality=95, exif=exif)
    return tmp_path, lens


def test_changes_are_told_and_drawn(copy, capsys) -> None:
    folder, lens = copy
    with gsmap.map.open(folder / "c.gsmap") as m:
        (row,) = m.localize(folder / "changed.jpg", intrinsics=lens, changes=True, pictures=folder / "drawn").results
        assert row.status == "placed", row.reason
        assert row.added is None
        best = row.changes[0]
        x0, y0, x1, y1 = best.box_px
        assert x0 < 300 < x1
        assert y0 < 200 < y1
        assert best.scene_name == "room"
        assert np.isfinite(best.position).all()
        with Image.open(row.picture) as picture:
            assert picture.format == "PNG"
        assert m.photo_rows() == []
        with raises(ConfigError, code="missing_option", match="changes="):
            m.localize(folder / "changed.jpg", pictures=folder / "drawn")
        with raises(ConfigError, code="missing_option", match="add="):
            m.localize(folder / "changed.jpg", captured_at="2026-01-01")
    with pytest.raises(SystemExit) as ended:
        run(["-q", "localize", str(folder / "c.gsmap"), str(folder / "changed.jpg"), "--intrinsics", lens, "--changes"])
    assert not ended.value.code
    out = capsys.readouterr().out
    poses, _, differences = out.partition("\n\n# ")
    assert "component" in poses
    assert differences.splitlines()[0].endswith(f"changed.jpg differs, component {row.component}")


def test_a_photo_is_kept_once_and_follows_its_scene(copy) -> None:
    folder, lens = copy
    with gsmap.map.open(folder / "c.gsmap") as m:
        (row,) = m.localize(folder / "changed.jpg", intrinsics=lens, add=True).results
        assert row.added is True
        assert row.changes is None
        report = m.localize(folder / "changed.jpg", intrinsics=lens, add=True)
        assert report.results[0].added is False
        assert any("stored already" in note for note in report.notes)
        (kept,) = m.photo_rows()
        assert kept.captured_at == "2026-05-04T10:00:00+00:00"
        assert (kept.file, kept.scene_name, kept.size_px) == ("changed.jpg", "room", (480, 360))
        assert np.allclose(kept.T_map_camera, row.T_map_camera, atol=1e-9)
        assert np.allclose(kept.covariance, row.covariance, rtol=1e-6)
        assert m.store.photos.jpeg(1).startswith(b"\xff\xd8\xff")
        # The map is turned and grows: the photo goes along.
        S = Sim3(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5.0, 0, 0]), 2.0)
        graph = m.pose_graph()
        from dataclasses import replace

        poses = {k: replace(pose, S_map_scene=S @ pose.S_map_scene) for k, pose in graph.poses.items()}
        m.store.revisions.save(replace(graph, poses=poses))
        (moved,) = m.photo_rows()
        assert np.allclose(moved.T_map_camera[:3, 3], S.apply(row.T_map_camera[:3, 3]))
        assert np.allclose(moved.T_map_camera[:3, :3], S.rotation @ row.T_map_camera[:3, :3])
        (drawn,) = view_of(m.store, m.settings).photos
        assert (drawn["file"], drawn["captured_at"]) == ("changed.jpg", kept.captured_at)
        assert list(drawn["size_px"]) == [480, 360]
        assert np.allclose(drawn["T_map_camera"], moved.T_map_camera)
        with pytest.raises(NotFoundError):
            m.remove_photo("none.jpg")
        assert m.remove_photo("p1").file == "changed.jpg"
        assert m.photo_rows() == []


def test_a_map_that_is_read_only_keeps_none(copy) -> None:
    folder, lens = copy
    with gsmap.map.Map(Store.open(folder / "c.gsmap", "r")) as m, raises(ReadOnlyError, code="read_only"):
        m.localize(folder / "changed.jpg", intrinsics=lens, add=True)


# --- a small map ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(made):
    """A small map of a quarter of a megabyte, and what is said of it."""
    folder, _, _ = made
    with gsmap.map.open(folder / "m.gsmap") as m:
        report = m.export_small(folder / "small", 250_000)
    return folder / "small", report


def test_a_small_map_places_the_photo_where_the_whole_one_does(made, small) -> None:
    folder, lens, whole = made
    out, told = small
    assert told.num_bytes == sum(path.stat().st_size for path in out.iterdir()) <= 250_000
    (kept,) = told.scenes
    assert 0 < kept.num_features < kept.features_of
    assert 0 < kept.num_gaussians < kept.gaussians_of
    (row,) = localize_small(out, [folder / "photo.png"], intrinsics=lens).results
    assert row.status == "placed", row.reason
    assert row.scenes == ("room",)
    assert np.linalg.norm(row.T_map_camera[:3, 3] - whole.results[0].T_map_camera[:3, 3]) < 0.05
    assert localize_small(out, [folder / "photo.png"], intrinsics=lens, near="room").results[0].status == "placed"
    with pytest.raises(NotFoundError):
        localize_small(out, [folder / "photo.png"], near="nowhere")


def test_the_command_line_opens_a_small_map_and_says_what_it_is_not_for(made, small, capsys) -> None:
    folder, lens, _ = made
    out, _ = small
    photo = str(folder / "photo.png")
    with pytest.raises(SystemExit) as ended:
        run(["-q", "localize", str(out), photo, "--intrinsics", lens, "--json"])
    assert not ended.value.code
    assert json.loads(capsys.readouterr().out)["results"][0]["status"] == "placed"
    for wrong in (
        ["localize", str(out), photo, "--changes"],
        ["export", str(folder / "m.gsmap"), "x", "--budget", "5MB"],
    ):
        with pytest.raises(SystemExit) as ended:
            run(["-q", *wrong])
        assert ended.value.code
    assert not (folder / "x").exists()


def test_too_small_a_budget_is_refused_with_one_that_would_do(made, tmp_path) -> None:
    folder, _, _ = made
    with gsmap.map.open(folder / "m.gsmap") as m:
        with raises(ConfigError, code="small_map_budget"):
            m.export_small(tmp_path / "small", 60_000)
        assert list(tmp_path.iterdir()) == []
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "mine.txt").touch()
        with raises(StoreError, code="already_exists"):
            m.export_small(tmp_path / "full", 600_000)


@pytest.mark.parametrize("what", ["bytes", "json", "version", "missing"])
@pytest.mark.guards("data")
def test_a_damaged_small_map_is_told(made, small, tmp_path, what) -> None:
    folder, lens, _ = made
    out = tmp_path / "small"
    shutil.copytree(small[0], out)
    (scene,) = out.glob("*.npz")
    header = out / "localize.json"
    if what == "bytes":
        content = bytearray(scene.read_bytes())
        content[len(content) // 2] ^= 0xFF
        scene.write_bytes(bytes(content))
    elif what == "missing":
        scene.unlink()
    elif what == "json":
        header.write_text(header.read_text().replace('"S_map_scene"', '"S"'))
    else:
        header.write_text(header.read_text().replace('"version": 2', '"version": 3'))
    kind, code = (ConfigError, "small_map_version") if what == "version" else (CorruptError, "small_map_damaged")
    with raises(kind, code=code, match="again"):
        localize_small(out, [folder / "photo.png"], intrinsics=lens)


@contextlib.contextmanager
def room_for(num_bytes: int):
    """Address space for so many bytes beyond what is mapped already."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _scene_of(out: Path):
    """A scene of a small map, whose features are read."""
    return next(iter(SmallLocalizer(out).placed.values())).features


def test_a_small_map_is_read_with_little_memory(small) -> None:
    with room_for(512 << 20):
        assert _scene_of(small[0]).num_features > 0


def _npz_of(path: Path, method: int, **changed: np.ndarray | bytes) -> bytes:
    """A scene's file with other arrays, or other bytes of them."""
    out = io.BytesIO()
    with np.load(path) as stored, zipfile.ZipFile(out, "w", method) as archive:
        for name in stored.files:
            value = changed.get(name, stored[name])
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                if isinstance(value, bytes):
                    file.write(value)
                else:
                    np.lib.format.write_array(file, value, (1, 0), allow_pickle=True)
    return out.getvalue()


def _claims(shape: tuple[int, ...], held: int = 0) -> bytes:
    """An array's header, and as many zeros."""
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "|u1", "fortran_order": False, "shape": shape})
    return out.getvalue() + bytes(held)


@pytest.mark.parametrize(
    "what", ["zeros", "claims", "lzma", "bzip2", "negative", "objects", "no zip", "cut", "deflate"]
)
def test_a_hostile_small_map_is_damaged_and_costs_no_memory(small, tmp_path, what) -> None:
    """Its digest fits its bytes: whoever made it made both."""
    out = tmp_path / "small"
    shutil.copytree(small[0], out)
    (scene,) = out.glob("*.npz")
    deflated, angles = zipfile.ZIP_DEFLATED, "features.angles"
    if what == "zeros":
        content = _npz_of(scene, deflated, **{angles: np.zeros(64 << 20, np.uint8)})
    elif what == "claims":
        content = _npz_of(scene, deflated, **{angles: _claims((1 << 34,))})
    elif what in ("lzma", "bzip2"):
        method = zipfile.ZIP_LZMA if what == "lzma" else zipfile.ZIP_BZIP2
        content = _npz_of(scene, method)
    elif what == "negative":
        content = _npz_of(scene, deflated, **{angles: _claims((-1, -64), 64)})
    elif what == "objects":
        content = _npz_of(scene, deflated, **{angles: np.array([None, {}], object)})
    else:
        content = bytearray(scene.read_bytes())
        if what == "no zip":
            content = bytearray(b"PK") + bytes(100)
        elif what == "cut":
            content = content[:-30]
        else:
            at = 30 + int.from_bytes(content[26:28], "little") + int.from_bytes(content[28:30], "little")
            content[at : at + 40] = b"\xff" * 40
    scene.write_bytes(bytes(content))
    header = json.loads((out / "localize.json").read_text())
    header["scenes"][0]["sha256"] = hashlib.sha256(bytes(content)).hexdigest()
    (out / "localize.json").write_text(json.dumps(header))
    with room_for(512 << 20), pytest.raises(CorruptError):
        _scene_of(out)


def test_a_small_map_whose_files_are_vast_is_not_read(small, tmp_path) -> None:
    out = tmp_path / "small"
    shutil.copytree(small[0], out)
    (scene,) = out.glob("*.npz")
    for path, size in ((scene, 3 << 30), (out / "localize.json", 1 << 30)):
        os.truncate(path, size)  # sparse
        with room_for(512 << 20), pytest.raises(CorruptError):
            _scene_of(out)


# --- what is kept ---------------------------------------------------------------------------------------------------


def _segments(store: Store):
    return store.indexes.segments(index_recipe())


def test_the_index_of_views_is_made_once_and_grows_by_what_is_new(made, world, tmp_path, monkeypatch) -> None:
    folder, lens, report = made
    shutil.copytree(folder / "m.gsmap", tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        (before,) = _segments(m.store)
        assert before.num_nodes > 100
        asked = []
        put = m.store.indexes.save_segment
        monkeypatch.setattr(m.store.indexes, "save_segment", lambda *a, **k: asked.append(a) or put(*a, **k))
        again = m.localize(folder / "photo.png", intrinsics=lens).results[0]
        assert np.array_equal(again.T_map_camera, report.results[0].T_map_camera)
        assert not asked
        m.register()  # the index of graphs leaves that of views alone
        assert [one.id for one in _segments(m.store)] == [before.id]
        other = world.capture.gaussians
        m.ingest(other[np.arange(0, len(other), 2)], cameras=world.capture.cameras, name="again")
        m.optimize()
        m.localize(folder / "photo.png", intrinsics=lens)
        (after,) = _segments(m.store)
        assert len(after.members) == 2
        assert after.num_nodes > before.num_nodes


def test_a_scene_whose_features_could_not_be_made_stays_out_of_the_index(made, world, tmp_path, monkeypatch) -> None:
    folder, lens, _ = made
    shutil.copytree(folder / "m.gsmap", tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        other = world.capture.gaussians
        m.ingest(other[np.arange(0, len(other), 2)], cameras=world.capture.cameras, name="again")
        m.optimize()
        monkeypatch.setattr("gsmap.map.localization.localize.ensure", lambda *arguments: None)
        assert m.localize(folder / "photo.png", intrinsics=lens).results[0].scenes == ("room",)


def test_a_damaged_index_of_views_is_made_anew(made, tmp_path) -> None:
    folder, lens, report = made
    shutil.copytree(folder / "m.gsmap", tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        (segment,) = _segments(m.store)
        (archive,) = (m.store.arrays.root / "indexes" / segment.id).glob("*")
        os.chmod(archive, 0o644)
        content = bytearray(archive.read_bytes())
        content[len(content) // 2] ^= 0xFF
        archive.write_bytes(bytes(content))
    with gsmap.map.Map(Store.open(tmp_path / "c.gsmap", "r")) as m, pytest.raises(CorruptError):
        m.localize(folder / "photo.png", intrinsics=lens)
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        again = m.localize(folder / "photo.png", intrinsics=lens).results[0]
        assert np.array_equal(again.T_map_camera, report.results[0].T_map_camera)
        assert m.check().ok


def test_segments_that_others_made_one_meanwhile_are_asked_anew(made, tmp_path) -> None:
    folder, lens, report = made
    shutil.copytree(folder / "m.gsmap", tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        photo = read_photo(folder / "photo.png", Lens(tuple(float(x) for x in lens.split(","))))
        localizer = Localizer(m.store, m.settings, lambda *told: None)
        m.store.indexes.forget([one.id for one in _segments(m.store)])
        found = localizer.localize(photo)
        assert np.array_equal(found.T_map_camera, report.results[0].T_map_camera)
        assert len(_segments(m.store)) == 1


def test_arrays_are_freed_together_with_their_localizer(made) -> None:
    folder, lens, _ = made
    with gsmap.map.open(folder / "m.gsmap") as m:
        localizer = Localizer(m.store, m.settings, lambda *told: None)
        localizer.localize(read_photo(folder / "photo.png", Lens(tuple(float(x) for x in lens.split(",")))))
        arrays = [weakref.ref(scene.chunked) for scene in localizer.placed.values()]
        gc.disable()
        try:
            del localizer
            assert [array() for array in arrays] == [None] * len(arrays)
        finally:
            gc.enable()


def test_features_come_and_go_with_their_scene(made, world, tmp_path) -> None:
    """Kept by key, damaged bytes are told, and nothing is left of a scene that is purged."""
    folder, _, _ = made
    with gsmap.map.open(folder / "m.gsmap") as m:
        m.clone(tmp_path / "c.gsmap")
    with Store.open(tmp_path / "c.gsmap") as store:
        (scene,) = store.scenes.list()
        (key,) = feature_keys(store, [scene], settings_of({})).values()
        held = store.view_features.load(scene.id, key)
        assert np.array_equal(held.points, world.placed.features.points) or held.num_features > 100
        assert store.view_features.stored_keys([key, "0" * 32]) == {key.digest}
        assert store.view_features.load(scene.id, "0" * 32) is None
        (archive,) = (store.arrays.root / "views").glob("*/*")
        os.chmod(archive, 0o644)
        content = bytearray(archive.read_bytes())
        content[len(content) // 3] ^= 0xFF
        archive.write_bytes(bytes(content))
        with pytest.raises(CorruptError):
            store.view_features.load(scene.id, key)
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        assert not m.check().ok
        m.purge("room")
        assert m.store.view_features.stored_keys([key]) == set()
        assert m.check().ok
