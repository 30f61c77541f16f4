"""Objects: parts found in renders, lifted, associated over views."""

import numpy as np
import pytest
from describe_places import moved, room
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap.describe import Params, describe, embedders, recipe_key
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.landmarks import layer as landmarks
from gsmap.describe.landmarks.layer import Params as LandmarkParams
from gsmap.describe.objects import layer as object_layers
from gsmap.describe.objects.associate import associate, giou, make_region
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.describe.objects.layer import descriptor_id
from gsmap.describe.objects.lift import find_visible
from gsmap.describe.objects.views import render_views
from gsmap.describe.onnx.check import check_model
from gsmap.describe.segmenters import builtin, per_view
from gsmap.describe.segmenters.builtin import felzenszwalb
from gsmap.errors import ConfigError
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.settings import changed, leaves
from gsmap.types import Cameras, Sim3
from gsmap.types.views import SceneContext, View

OBJECTS = Params(landmarks=False, object=ObjectParams(num_cameras=16))


def box(low, high) -> np.ndarray:
    return np.array([low, high], float)


def test_giou_by_hand():
    a = box([0, 0, 0], [2, 2, 2])
    others = np.stack(
        [a, box([1, 0, 0], [3, 2, 2]), box([4, 0, 0], [6, 2, 2]), box([2, 2, 2], [4, 4, 4]), box([0, 0, 0], [1, 1, 1])]
    )
    # Same; half shifted: 4 / 12; apart: hull 24, union 16; corner to corner: hull 64, union 16; inside: 1 / 8.
    np.testing.assert_allclose(giou(others, a), [1, 1 / 3, -8 / 24, -48 / 64, 1 / 8], atol=0.02)
    flat = box([0, 0, 1], [2, 2, 1])
    np.testing.assert_allclose(giou(flat[None], flat), 1)
    assert giou(flat[None], box([0, 0, 1.5], [2, 2, 1.5]))[0] < 0


def test_two_views_of_two_things_become_two_nodes():
    rng = np.random.default_rng(0)
    feature = np.eye(4, dtype=np.float32)
    cup, chair = rng.uniform(0, 0.1, (200, 3)), rng.uniform(2, 3, (200, 3))
    nodes = []
    associate(nodes, make_region(cup[:150], feature[0], 0.9, 0, 0.01), 1.1, 0.01)
    associate(nodes, make_region(chair[:150], feature[1], 0.8, 0, 0.01), 1.1, 0.01)
    seen_again = feature[0] + 0.3 * feature[2]
    seen_again /= np.linalg.norm(seen_again)
    joined = associate(nodes, make_region(cup[50:], seen_again, 0.7, 1, 0.01), 1.1, 0.01)
    assert joined is nodes[0]
    assert len(nodes) == 2
    assert joined.views == {0, 1}
    assert np.linalg.norm(joined.feature) == pytest.approx(1)
    expected = feature[0] + seen_again
    np.testing.assert_allclose(joined.feature, expected / np.linalg.norm(expected), atol=1e-6)
    # Points are thinned to one per cell of a cm.
    assert len(joined.points) <= len(cup)
    assert len(np.unique(np.floor((joined.points - joined.points.min(0)) / 0.01), axis=0)) >= 0.9 * len(joined.points)
    # The same place with another look, and the same look elsewhere, are other things.
    associate(nodes, make_region(cup, feature[3], 0.9, 2, 0.01), 1.1, 0.01)
    associate(nodes, make_region(cup + 5, feature[0], 0.9, 2, 0.01), 1.1, 0.01)
    assert len(nodes) == 4
    # Where the segmenter knows two masks to be one part, looks and place do not matter.
    one = associate(nodes, make_region(cup + 9, feature[0], 0.9, 3, 0.01, part=7), 1.1, 0.01)
    assert associate(nodes, make_region(cup + 12, feature[1], 0.9, 4, 0.01, part=7), 1.1, 0.01) is one


def test_lifting_takes_the_visible_surface_only():
    camera = Cameras(np.eye(4)[None], [[100.0, 100, 50, 40]], [[100, 80]])
    depth = np.full((80, 100), 2.0, np.float32)
    view = View(np.zeros((80, 100, 3), np.uint8), depth, np.ones_like(depth), np.zeros((80, 100), np.int32), camera)
    points = np.array([[0, 0, 2.0], [0.1, 0.2, 2.03], [0, 0, 3], [0, 0, 1], [0, 0, -2], [5, 0, 2]])
    rows, pixel = find_visible(points, view)
    assert rows.tolist() == [0, 1]
    assert pixel[0].tolist() == [50, 40]
    # As published: all that projects into the picture, behind the surface and before it, where something is shown.
    assert find_visible(points, view, np.inf)[0].tolist() == [0, 1, 2, 3]
    depth[40:60, :60] = 0
    with np.errstate(invalid="raise"):
        assert find_visible(points, view, np.inf)[0].tolist() == []


def test_masks_of_one_view_each_are_those_of_the_parts_and_name_none(monkeypatch):
    gaussians, cameras = room(n=6000)
    cloud = surface_cloud(gaussians)
    context = SceneContext(cloud, len(gaussians), None, 1.0)
    (view,) = render_views(gaussians, cameras.evenly(1), 160, "native")
    parts, masks = (method.make(context, method.Params()).segment(view) for method in (builtin, per_view))
    assert len(masks) > 3
    assert [(m.pixels.tobytes(), m.confidence) for m in masks] == [(m.pixels.tobytes(), m.confidence) for m in parts]
    assert {m.part for m in masks} == {None}
    # So what becomes one object is decided by looks and place: nothing resembles itself more than 2.
    params, counts = small(segmenter="per_view", min_views=1), []
    for least in (2.1, 0.5):
        monkeypatch.setattr(object_layers, "_MIN_SIMILARITY", least)
        counts.append(len(describe("room", gaussians, cameras, params).layers["objects"]))
    assert counts[0] > 2 * counts[1]


def test_felzenszwalb_cuts_at_the_heavy_edge():
    a, b = np.arange(9), np.arange(1, 10)
    weight = np.where(a == 4, 5.0, 0.1)
    parts = felzenszwalb(10, a, b, weight, 1.0, 2)
    assert parts.tolist() == [0] * 5 + [1] * 5
    assert len(set(felzenszwalb(10, a, b, weight, 1.0, 6))) == 1


def small(**changed) -> Params:
    """Objects of a few small views."""
    return Params(landmarks=False, object=ObjectParams(num_cameras=6, longest_side_px=160, **changed))


def test_masks_of_low_confidence_make_no_objects():
    gaussians, cameras = room(n=6000)

    def layer(least: float):
        params = small(min_confidence=least)
        return describe("room", gaussians, cameras, params, scale_policy="known").layers["objects"]

    every, sure = layer(0.0), layer(0.9)
    assert every.weights.min() < 0.8
    assert 0 < len(sure) < len(every)
    assert sure.weights.min() >= 0.9
    assert len(layer(1.0)) == 0


def test_auto_falls_back_to_the_built_in_ones_and_says_so():
    gaussians, cameras = room(n=2000)
    fallen = describe("room", gaussians, cameras, small())
    assert "built-in segmenter and embedder used, because the map has no models for other methods" in fallen.notes
    asked = describe("room", gaussians, cameras, small(segmenter="builtin", embedder="builtin"))
    assert not any("built-in" in note for note in asked.notes)
    assert recipe_key(small()).digest == recipe_key(small(segmenter="builtin", embedder="builtin")).digest
    assert recipe_key(small()).backend in ("native", "gsplat")


FLAT = """
from dataclasses import dataclass
import numpy as np

VERSION = 5
MODELS = ()

@dataclass(frozen=True)
class Params:
    dim: int = 4

def make(context, params):
    return Flat(params.dim)

class Flat:
    def __init__(self, dim):
        self.dim = dim

    def embed(self, view, masks, points):
        return np.tile(np.eye(self.dim, dtype=np.float32)[:1], (len(masks), 1))
"""


def test_an_embedder_is_one_file(tmp_path, monkeypatch):
    (tmp_path / "flat.py").write_text(FLAT)
    monkeypatch.setattr(embedders.__spec__, "submodule_search_locations", [*embedders.__path__, str(tmp_path)])
    monkeypatch.setattr(embedders, "__path__", [*embedders.__path__, str(tmp_path)])
    params = changed(small(embedder="flat"), {"object.embedders.flat.dim": 6})
    layer = describe("room", *room(n=6000), params, scale_policy="known").layers["objects"]
    assert len(layer) > 0
    assert layer.features.shape[1] == 6
    np.testing.assert_array_equal(layer.embeddings, layer.features)
    key = recipe_key(params)
    assert key.version["embedder.flat"] == 5
    assert key.settings["object"]["embedders"] == {"flat": {"dim": 6}}


def test_every_parameter_is_explained_and_in_the_key_of_what_it_changes():
    explicit = Params(object=ObjectParams(segmenter="builtin", embedder="builtin"))
    base = recipe_key(explicit).digest
    other = {bool: lambda v: not v, int: lambda v: v + 1, float: lambda v: v * 1.01 + 1e-3}
    other[tuple] = lambda v: tuple(x * 1.01 for x in v)
    for leaf in leaves(explicit):
        assert leaf.meaning, leaf.name
        if isinstance(leaf.value, str):
            continue  # names of methods: see the tests above
        key = recipe_key(changed(explicit, {leaf.name: other[type(leaf.value)](leaf.value)})).digest
        other_methods = ("segmenters.per_view", "segmenters.sam", "embedders.clip", "object.model_")
        unused = any(part in leaf.name for part in other_methods)
        assert (key == base) == unused, leaf.name


def test_how_much_is_kept_does_not_keep_layers_from_being_compared():
    base, more = ObjectParams(), ObjectParams(num_cameras=96, min_confidence=0.4)
    assert descriptor_id(base, {}) == descriptor_id(more, {})
    assert descriptor_id(base, {}) != descriptor_id(
        changed(base, {"segmenter": "builtin", "segmenters.builtin.scale": 5.0}), {}
    )
    many, fitted = LandmarkParams(max_per_octave=9), LandmarkParams(use_fitted_metric=True)
    ids = [landmarks.descriptor_id(p) for p in (LandmarkParams(), many, fitted)]
    assert ids[0] == ids[1] != ids[2]


def test_objects_sit_on_the_furniture_and_follow_the_scene():
    gaussians, cameras = room()
    green, red = [-0.4, 0.3, -0.4], [0.4, -0.4, -0.4]
    rgb = np.zeros_like(gaussians.means)
    n = len(gaussians) - 2 * 3000
    rgb[n : n + 3000], rgb[n + 3000 :] = green, red
    sh = sh0_of_rgb(rgb + 0.5)[:, None]
    gaussians = type(gaussians)(
        gaussians.means, gaussians.quats, gaussians.log_scales + 0.7, gaussians.logit_opacities, sh
    )
    one = describe("one", gaussians, cameras, OBJECTS, scale_policy="known").layers["objects"]
    S = Sim3(Rotation.random(random_state=5).as_matrix(), np.array([3.0, -7, 12]), 2.0)
    two = describe("two", *moved(gaussians, cameras, S), OBJECTS, scale_policy="unknown").layers["objects"]
    positions = S.inverse().apply(two.positions)
    for centre in ([1.6, 1.35, 0.4], [4.4, 3.75, 0.45]):
        i = np.argmin(np.linalg.norm(one.positions - centre, axis=1))
        assert np.linalg.norm(one.positions[i] - centre) < 0.5  # of the faces that cameras see
        assert (np.ptp(one.extents[i], axis=0) < 2).all()
        # The box is found in the other frame and unit too, and its embedding finds it.
        assert np.linalg.norm(positions - one.positions[i], axis=1).min() < 0.15
        best = np.argmax(two.embeddings @ one.embeddings[i])
        assert np.linalg.norm(positions[best] - one.positions[i]) < 0.3


def test_cameras_inside_walls_are_noted():
    gaussians, cameras = room()
    poses = cameras.T_frame_camera.copy()
    poses[:4, :3, 3] = [0.0, 2.5, 1.2]
    poses[:4, :3, :3] = np.stack([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], 1)  # in the wall, looking out of the room
    graph = describe("walled", gaussians, Cameras(poses, cameras.intrinsics_px, cameras.sizes_px), OBJECTS)
    assert any("are inside an object" in note for note in graph.notes)


def test_no_cameras_no_objects_but_a_note():
    graph = describe("blind", room(n=3000)[0], None, OBJECTS)
    assert len(graph.layers["objects"]) == 0
    assert any("no cameras" in note for note in graph.notes)


@pytest.mark.parametrize("name", ["segmenter", "embedder"])
def test_back_ends_that_do_not_exist_are_refused(name):
    with raises(ConfigError, code="unknown_method", match="'magic'"):
        describe("x", *room(n=500), Params(landmarks=False, object=ObjectParams(**{name: "magic"})))


@pytest.mark.parametrize("name", ["sam", "clip"])
def test_back_ends_without_their_model_say_what_to_add(name):
    kind = {"sam": "segmenter", "clip": "embedder"}[name]
    params = Params(landmarks=False, object=ObjectParams(**{kind: name}))
    with raises(ConfigError, code="model_required"):
        describe("x", *room(n=500), params)


def test_recipes_change_with_parameters_and_name_what_is_comparable():
    base = recipe_key()
    assert (base.stage, base.method) == ("describe", "graph")
    assert set(base.settings["layers"]) == {"landmarks", "objects", "things"}
    assert recipe_key().digest == base.digest
    other = recipe_key(Params(object=ObjectParams(min_views=3)))
    assert other.settings["landmark"] == base.settings["landmark"]
    assert other.settings["object"] != base.settings["object"]
    assert other.digest != base.digest
    assert recipe_key(Params(view_distance_m=3.4)).digest != base.digest
    graph = describe("x", *room(n=3000), OBJECTS)
    assert graph.layers["objects"].descriptor_id == descriptor_id(OBJECTS.object, {})


def test_sampled_cameras_are_spread():
    cameras = room()[1]
    assert cameras.evenly(5).names == ("0", "6", "12", "17", "23")
    assert len(cameras.evenly(100)) == 24


def test_models_that_are_given_are_used(tmp_path):
    networks = pytest.importorskip("describe_networks", reason="needs the onnx package")
    models = {
        "sam-encoder": check_model("sam-encoder", networks.sam_encoder(tmp_path / "e.onnx")),
        "sam-decoder": check_model("sam-decoder", networks.sam_decoder(tmp_path / "d.onnx")),
        "clip": check_model("clip", networks.image_encoder(tmp_path / "c.onnx"), "unit"),
    }
    params = Params(landmarks=False, object=ObjectParams(num_cameras=4, min_views=1))
    gaussians, cameras = room(n=15000)
    graph = describe("models", gaussians, cameras, params, models)
    layer = graph.layers["objects"]
    assert len(layer) > 0
    assert layer.features.shape[1] == 3
    assert not any("built-in" in note for note in graph.notes)
    assert layer.descriptor_id == descriptor_id(params.object, models)
    only = {"clip": models["clip"]}
    assert len({descriptor_id(params.object, {}), layer.descriptor_id, descriptor_id(params.object, only)}) == 3
    assert len({recipe_key(params, given).digest for given in ({}, models, only)}) == 3
