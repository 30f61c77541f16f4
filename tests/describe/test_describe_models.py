"""Models a user gives: checked, and run as their contracts say."""

from functools import partial

import numpy as np
import pytest
from PIL import Image
from raising import raises

from gsmap.describe import Params, recipe_key
from gsmap.describe.embedders import clip
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.describe.objects.layer import descriptor_id
from gsmap.describe.onnx.check import check_model, kinds, parse_preset
from gsmap.describe.segmenters import sam
from gsmap.errors import ConfigError, GsmapError, InputError, NotFoundError
from gsmap.networks.session import open_session
from gsmap.types import Cameras
from gsmap.types.views import Mask, View

networks = pytest.importorskip("describe_networks", reason="needs the onnx package")


def view_of(rgb: np.ndarray) -> View:
    height, width = rgb.shape[:2]
    camera = Cameras(np.eye(4)[None], [[100.0, 100, width / 2, height / 2]], [[width, height]])
    ones = np.ones((height, width), np.float32)
    return View(rgb, ones, ones, np.zeros((height, width), np.int32), camera)


def flag(height: int = 96, width: int = 160) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A picture of three flat regions and their pixels."""
    rgb = np.full((height, width, 3), (200, 40, 40), np.uint8)
    rows, columns = np.mgrid[:height, :width]
    green = (rows >= 20) & (rows < 60) & (columns >= 30) & (columns < 80)
    blue = columns >= 120
    rgb[green], rgb[blue] = (40, 200, 40), (40, 40, 200)
    return rgb, {"red": ~green & ~blue, "green": green, "blue": blue}


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("batch", ["batch", 1])
def test_sam_finds_every_region_once(tmp_path, batch):
    encoder = check_model("sam-encoder", networks.sam_encoder(tmp_path / "e.onnx"))
    decoder = check_model("sam-decoder", networks.sam_decoder(tmp_path / "d.onnx", batch=batch))
    segmenter = sam.SamSegmenter(sam.Params(points_per_side=8), encoder, decoder)
    assert segmenter.batch == (64 if batch == "batch" else 1)
    rgb, regions = flag()
    masks = segmenter.segment(view_of(rgb))
    assert len(masks) == 3
    for pixels in regions.values():
        best = max(masks, key=lambda m: iou(m.pixels, pixels))
        assert iou(best.pixels, pixels) > 0.85
        assert best.confidence == pytest.approx(0.95)


def test_sam_cuts_by_area_and_predicted_overlap(tmp_path, monkeypatch):
    encoder = check_model("sam-encoder", networks.sam_encoder(tmp_path / "e.onnx"))
    decoder = check_model("sam-decoder", networks.sam_decoder(tmp_path / "d.onnx"))
    rgb, regions = flag()
    share = regions["red"].mean()
    assert sam.SamSegmenter(sam.Params(8, min_iou=0.96), encoder, decoder).segment(view_of(rgb)) == []
    monkeypatch.setattr(sam, "_MAX_AREA", share - 0.05)
    assert len(sam.SamSegmenter(sam.Params(8), encoder, decoder).segment(view_of(rgb))) == 2


def test_suppression_keeps_the_best_of_boxes_that_overlap():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 9], [20, 20, 30, 30], [0, 0, 10, 5]], float)
    assert sam.suppress(boxes, np.array([0.8, 0.9, 0.7, 0.6]), 0.7) == [1, 2, 3]
    assert sam.suppress(boxes[:0], np.zeros(0), 0.7) == []


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("batch", ["n", 1, 4])
def test_clip_runs_any_layout_and_batch(tmp_path, channels_last, batch, monkeypatch):
    monkeypatch.setattr(clip, "crop", partial(clip.crop, margin=0.0, background=0.0))
    path = networks.image_encoder(tmp_path / "m.onnx", channels_last=channels_last, batch=batch)
    spec = check_model("clip", path, "mean=0,0,0;std=1,1,1")
    embedder = clip.ClipEmbedder(spec)
    rgb, regions = flag()
    names = ["green", "blue", "green", "red", "blue"]
    features = embedder.embed(view_of(rgb), [Mask(regions[n], 1.0) for n in names], [np.zeros((0, 3))] * 5)
    assert features.shape == (5, 3)
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, rtol=1e-5)
    green = np.array([40, 200, 40]) / np.linalg.norm([40, 200, 40])
    # The green box is 40 x 50: a fifth of its square is background, the picture's mean.
    assert features[0] @ green > 0.98
    np.testing.assert_allclose(features[0], features[2], atol=1e-6)
    assert features[1] @ features[3] < 0.95


@pytest.mark.parametrize("preset", ["clip", "imagenet", "unit", "mean=0.5,0.4,0.3;std=0.5,0.25,1"])
def test_normalise_is_per_channel(tmp_path, preset):
    spec = check_model("clip", networks.image_encoder(tmp_path / "m.onnx"), preset)
    picture = np.random.default_rng(0).uniform(0, 1, (2, 5, 4, 3)).astype(np.float32)
    out = clip.normalise(picture, spec)
    for c in range(3):
        np.testing.assert_allclose(out[..., c], (picture[..., c] - spec.mean[c]) / spec.std[c], rtol=1e-5, atol=1e-6)
    assert parse_preset("clip")[0][0] == pytest.approx(0.48145466)
    assert parse_preset("imagenet")[1][2] == pytest.approx(0.225)


def test_the_model_and_its_pixel_scaling_are_in_the_recipe(tmp_path):
    one, other = networks.image_encoder(tmp_path / "m.onnx"), networks.image_encoder(tmp_path / "n.onnx", side=16)
    specs = [check_model("clip", path, preset) for path in (one, other) for preset in ("clip", "unit")]
    params = Params(object=ObjectParams(num_cameras=4))
    assert len({recipe_key(params, {"clip": spec}).digest for spec in specs}) == 4
    assert len({descriptor_id(params.object, {"clip": spec}) for spec in specs}) == 4
    unused = Params(object=ObjectParams(embedder="builtin"))
    assert len({recipe_key(unused, {"clip": spec}).digest for spec in specs}) == 1


def test_crop_is_square_centred_and_keeps_the_mask():
    rgb = np.zeros((40, 60, 3), np.uint8)
    pixels = np.zeros((40, 60), bool)
    pixels[10:20, 5:25] = True
    rgb[pixels] = 255
    out = clip.crop(rgb, pixels, (20, 20), margin=0.0, background=1.0)
    assert out.shape == (20, 20, 3)
    assert out[7:13, 2:-2].min() > 0.9
    assert out[:3].max() < 0.1
    assert out[-3:].max() < 0.1


@pytest.mark.parametrize("preset", ["clp", "mean=1,2;std=1,1,1", "mean=0,0,0;std=0,1,1", "mean=0,0,0", ""])
def test_unknown_pixel_scaling_is_refused(preset):
    with raises(ConfigError, code="invalid_choice", match="pixel scaling"):
        parse_preset(preset)


def test_what_is_not_a_model_is_refused(tmp_path):
    picture = tmp_path / "picture.onnx"
    Image.new("RGB", (20, 20)).save(picture, format="PNG")
    with raises(InputError, code="not_a_model"):
        check_model("clip", picture)
    empty = tmp_path / "empty.onnx"
    empty.write_bytes(b"")
    with raises(InputError, code="not_a_model"):
        check_model("clip", empty)
    whole = networks.image_encoder(tmp_path / "whole.onnx").read_bytes()
    for cut in (1, len(whole) // 2, len(whole) - 1):
        part = tmp_path / f"cut{cut}.onnx"
        part.write_bytes(whole[:cut])
        with pytest.raises(InputError):
            check_model("clip", part)
    with pytest.raises(NotFoundError):
        check_model("clip", tmp_path / "absent.onnx")
    with raises(ConfigError, code="invalid_choice", match="'dino'"):
        check_model("dino", picture)


def test_noise_never_escapes_the_error_tree(tmp_path):
    rng = np.random.default_rng(0)
    whole = np.frombuffer(networks.image_encoder(tmp_path / "whole.onnx").read_bytes(), np.uint8)
    for i in range(60):
        noisy = whole.copy()
        noisy[rng.integers(0, len(whole), 3)] = rng.integers(0, 256, 3)
        path = tmp_path / f"{i}.onnx"
        path.write_bytes(noisy.tobytes())
        try:
            check_model("clip", path)
        except GsmapError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_kinds_are_those_that_methods_name():
    assert {kind: [m.__name__.split(".")[-1] for m in methods] for kind, methods in kinds().items()} == {
        "sam-encoder": ["sam"],
        "sam-decoder": ["sam"],
        "clip": ["clip"],
        "extractor": ["onnx"],
        "clip-text": [],
        "clip-tokenizer": [],
    }


def test_weights_in_other_files_are_refused(tmp_path):
    with raises(InputError, code="model_has_external_data"):
        check_model("clip", networks.external(tmp_path / "outside.onnx"))


def test_models_of_another_kind_are_refused(tmp_path):
    encoder = networks.image_encoder(tmp_path / "m.onnx")
    with raises(InputError, code="model_misfit"):
        check_model("sam-decoder", encoder)
    with raises(InputError, code="model_misfit"):
        check_model("sam-encoder", encoder)
    with raises(InputError, code="model_misfit"):
        check_model("clip", networks.sam_decoder(tmp_path / "d.onnx"))


def test_models_that_fit_on_paper_only_are_refused(tmp_path):
    with raises(InputError, code="model_misfit"):
        check_model("sam-encoder", networks.sam_encoder(tmp_path / "small.onnx", side=512))
    with raises(InputError, code="model_failed"):
        check_model("clip", networks.fixed_inside(tmp_path / "fixed.onnx"))
    # An encoder and a decoder of different models: each is one, together they do not run.
    encoder = check_model("sam-encoder", networks.sam_encoder(tmp_path / "coarse.onnx", cell=32))
    decoder = check_model("sam-decoder", networks.sam_decoder(tmp_path / "decoder.onnx"))
    with raises(InputError, code="model_failed"):
        sam.SamSegmenter(sam.Params(), encoder, decoder).segment(view_of(np.zeros((60, 80, 3), np.uint8)))


def test_a_model_that_changed_after_it_was_added_is_refused(tmp_path):
    path = networks.image_encoder(tmp_path / "m.onnx")
    spec = check_model("clip", path)
    networks.image_encoder(path, side=16)
    with raises(InputError, code="model_changed"):
        open_session(spec)
    path.unlink()
    with pytest.raises(NotFoundError):
        open_session(spec)


def test_a_real_image_encoder_tells_frames_apart(shared_data):
    """MobileNet: neighbouring frames of one room are more alike than frames of two rooms, and features are not flat."""
    path = shared_data / "models" / "mobilenet_v1_embedding.onnx"
    spec = check_model("clip", path, "mean=0.50196,0.50196,0.50196;std=0.50196,0.50196,0.50196")
    embedder = clip.ClipEmbedder(spec)
    assert embedder.size == (224, 224)
    names = ["house/frames/c0_000.jpg", "kitchen/frame-000000.color.jpg", "kitchen/frame-000040.color.jpg"]
    features = []
    for name in names:
        rgb = np.asarray(Image.open(shared_data / name).convert("RGB").resize((320, 240)))
        features.append(embedder.embed(view_of(rgb), [Mask(np.ones((240, 320), bool), 1.0)], [np.zeros((0, 3))])[0])
    features = np.array(features)
    assert features.shape == (3, 1024)
    assert features[1] @ features[2] > features[0] @ features[1]
    assert features[1] @ features[2] < 0.999
