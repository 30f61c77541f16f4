"""`Map.find`: by a thing, a point, a picture and words; answered by one recipe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from find_room import CUPBOARD, DATES, FRAMES, RED, SETTINGS, TABLE, YELLOW, fill
from PIL import Image
from raising import raises

import gsmap
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.map import Map
from gsmap.map.objects import component_objects
from gsmap.map.objects.map_objects import load_objects
from gsmap.map.pictures.comparison_pictures import PictureFolder
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation
from gsmap.types.rows.find import FindHit, FindReport
from tools.make.tiny_encoder import image_encoder
from tools.make.tiny_text import text_tower, tokenizer


def where(hit: FindHit) -> tuple[float, float]:
    """The thing of the room that a hit is."""
    places = [*YELLOW, RED, TABLE, CUPBOARD]
    return min(places, key=lambda place: float(np.linalg.norm(np.array(place) - hit.position[:2])))


def places(report: FindReport, count: int) -> set[tuple[float, float]]:
    return {where(hit) for hit in report.hits[:count]}


def test_a_point_finds_what_stands_there_and_its_twins(site: Map) -> None:
    report = site.find(at=[*YELLOW[1], 0.45])
    assert report.by == "likeness"
    assert (report.described, report.placed) == (2, 2)
    assert places(report, 3) == set(YELLOW)
    assert [hit.rank for hit in report.hits] == list(range(1, len(report.hits) + 1))
    scores = [hit.score for hit in report.hits]
    assert scores == sorted(scores, reverse=True)
    assert scores[2] > 0.5 > scores[4]
    assert len({hit.object for hit in report.hits}) == len(report.hits)
    for hit in report.hits[:3]:
        assert hit.dates == tuple(f"{date}T00:00:00+00:00" for date in DATES.values())
        assert hit.size_m is not None
        np.testing.assert_allclose(hit.size_m, [0.4, 0.4, 0.45], atol=0.12)
        np.testing.assert_allclose(hit.position, hit.position_m)
        assert hit.scene_name in FRAMES
        assert hit.picture is None


def test_only_objects_that_the_map_lists_are_found(site: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = {thing.id for thing in site.objects().objects}
    monkeypatch.setattr(component_objects, "update_objects", None)  # nothing is computed anew
    hits = site.find(like=min(listed), top=100).hits
    assert {hit.object for hit in hits} <= listed
    assert len(hits) > 4


def test_objects_that_a_kept_photo_saw_are_found(site: Map) -> None:
    (known,) = site.objects().objects[:1]
    scene = site.scenes()[0].id
    placed = site.store.revisions.get()
    assert placed is not None
    things = (PhotoObjectObservation(placed.poses[scene].S_map_scene.inverse().apply(known.position), "seen", 0.9),)
    lens = np.array([500.0, 500, 320, 240])
    photo = LocalizedPhoto("0" * 64, "a.jpg", "2026-07-01", scene, np.eye(4), np.eye(6), lens, (640, 480), 0.99, things)
    site.store.photos.add(photo, b"\xff\xd8\xff" + bytes(200))
    try:
        assert "0" * 64 in {one.scene for one in load_objects(site.store, site.settings).objects[0].sightings}
        assert site.find(like=known.id).hits[0].dates == tuple(f"{date}T00:00:00+00:00" for date in DATES.values())
    finally:
        site.store.photos.remove(site.store.photos.list()[0].number)


def test_an_object_and_a_node_find_the_same(site: Map) -> None:
    first = site.find(at=[*YELLOW[0], 0.4]).hits[0]
    assert first.object is not None
    by_id = site.find(like=first.object)
    assert by_id.hits[0].object == first.object
    assert places(by_id, 3) == set(YELLOW)
    scene = next(scene for scene in site.scenes() if scene.name == "may")
    graph = site.store.graphs.load(scene.id)
    assert graph is not None
    world = FRAMES["may"].inverse().apply(graph.layers["objects"].positions)
    node = int(np.argmin(np.linalg.norm(world - [*YELLOW[0], 0.35], axis=1)))
    by_node = site.find(like=f"may:{node}")
    assert by_node.by == "likeness"
    assert places(by_node, 3) == set(YELLOW)
    wall = int(np.argmax(world[:, 2]))  # the ceiling, or high on a wall: of no thing
    by_wall = site.find(like=f"may:{wall}", top=3)
    assert by_wall.by == "embedding"
    assert by_wall.hits[0].object is None
    assert by_wall.hits[0].node is not None
    assert by_wall.hits[0].score == pytest.approx(1.0, abs=1e-3)


def test_a_picture_finds_things_of_its_colours(site: Map, tmp_path: Path) -> None:
    Image.new("RGB", (40, 30), (204, 26, 26)).save(tmp_path / "red.png")
    report = site.find(picture=tmp_path / "red.png")
    assert report.by == "embedding"
    assert report.embedder == "builtin"
    assert where(report.hits[0]) == RED
    assert report.hits[0].object is not None


def test_hits_are_drawn(site: Map, tmp_path: Path) -> None:
    report = site.find(at=[*RED, 0.4], top=2, pictures=tmp_path / "found")
    files = [hit.picture for hit in report.hits]
    assert all(file is not None for file in files)
    red = np.asarray(Image.open(files[0] or ""))
    assert red.ndim == 3
    assert (red[..., 0] > 150).mean() > 0.02
    drawn = {path.name for path in (tmp_path / "found").glob("find-*.png")}
    assert len(drawn) == 2
    scenes = {scene.id for scene in site.scenes()}
    kept = PictureFolder.load(tmp_path / "found", site.store.id).scenes
    assert set(kept) == drawn  # so that a purge finds them
    assert {scene for ids in kept.values() for scene in ids} <= scenes


def test_what_cannot_be_found_is_said(site: Map, tmp_path: Path) -> None:
    with raises(ConfigError, code="nothing_requested", match="specify one query"):
        site.find()
    with raises(ConfigError, code="nothing_requested", match="specify one query"):
        site.find("red", at=[0, 0, 0])
    with raises(ConfigError, code="invalid_point", match="three numbers"):
        site.find(at=[0, np.nan, 0])
    with raises(ConfigError, code="nothing_requested", match="query text is empty"):
        site.find("  ")
    with raises(ConfigError, code="object_not_found", match="clip-text"):
        site.find("red sofa")
    with raises(NotFoundError, code="nothing_near"):
        site.find(at=[2, 1.5, 1.5])
    with raises(NotFoundError, code="object_not_found", match="abcd"):
        site.find(like="abcd")
    with raises(NotFoundError, code="object_out_of_range"):
        site.find(like="may:9999")
    with pytest.raises(NotFoundError):
        site.find(like="august:1")
    with raises(NotFoundError, code="file_not_found", match=r"none\.png"):
        site.find(picture=tmp_path / "none.png")
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with raises(InputError, code="picture_unreadable"):
        site.find(picture=tmp_path / "bad.png")


def models(folder: Path) -> tuple[Path, Path, Path]:
    files = folder / "image.onnx", folder / "text.onnx", folder / "tokenizer.json"
    files[0].write_bytes(image_encoder(32))
    files[1].write_bytes(text_tower())
    files[2].write_text(tokenizer())
    return files


def test_words_find_things_and_one_recipe_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    image, text, words = models(tmp_path)
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        m.change_settings(SETTINGS)
        fill(m)
        with raises(NotFoundError, code="no_placed_scene"):
            m.find(at=[*RED, 0.4])
        m.describe()
        before = m.find(at=[*RED, 0.4])
        m.add_model("clip", image, preset="unit")
        with raises(ConfigError, code="object_not_found"):
            m.find("red")
        m.add_model("clip-text", text)
        m.add_model("clip-tokenizer", words)
        with raises(NotFoundError, code="no_placed_scene"):
            m.find("red")
        # While the map moves to the new embedder, the old graphs answer, all of them.
        kept = m.find(at=[*RED, 0.4])
        assert (kept.recipe, kept.embedder) == (before.recipe, "builtin")
        assert "earlier recipe" in kept.notes[0]
        m.describe("may")
        half = m.find(at=[*RED, 0.4])
        assert (half.recipe, half.described) == (before.recipe, 2)
        assert [hit.object for hit in half.hits] == [hit.object for hit in before.hits]
        said = m.find("red")
        assert (said.described, said.placed) == (1, 2)
        assert "1 of 2 captures are not described" in said.notes[0]
        m.describe()
        whole = m.find(at=[*RED, 0.4])
        assert (whole.embedder, whole.described) == ("clip", 2)
        assert whole.recipe != before.recipe
        assert not any("recipe" in note for note in whole.notes)
        said = m.find("Red")
        assert said.by == "embedding"
        assert where(said.hits[0]) == RED
        assert where(m.find("yellow").hits[0]) in YELLOW
        Image.new("RGB", (64, 64), (191, 178, 26)).save(tmp_path / "yellow.png")
        assert where(m.find(picture=tmp_path / "yellow.png").hits[0]) in YELLOW
        with raises(InputError, code="invalid_query"):
            m.find("sofa")
        with raises(InputError, code="invalid_query"):
            m.find("red " * 400)


def test_models_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    image, text, words = models(tmp_path)
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        with raises(InputError, code="model_misfit"):
            m.add_model("clip-text", image)
        with raises(InputError, code="invalid_tokenizer"):
            m.add_model("clip-tokenizer", text)
        (tmp_path / "other.json").write_text("{}")
        with raises(InputError, code="invalid_tokenizer"):
            m.add_model("clip-tokenizer", tmp_path / "other.json")
        m.add_model("clip-tokenizer", words)
        (tmp_path / "any.onnx").write_bytes(text_tower(None))
        m.add_model("clip-text", tmp_path / "any.onnx")
        assert {row.kind for row in m.model_rows()} == {"clip-text", "clip-tokenizer"}
