"""Places seen from farther than rooms are: landmarks of their size, whether or not a metre is known."""

import numpy as np
import pytest
from describe_places import moved, room

from gsmap.describe import Params, describe
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.landmarks.detect import OctaveCache
from gsmap.describe.landmarks.layer import landmark_layer
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.describe.unit import landmark_units, working_unit_m
from gsmap.types import Sim3

LANDMARKS = Params(objects=False, things=False)
UP = np.array([0.0, 0.0, 1.0])
ROUNDED_M = 4.1 / 1024  # positions are kept to about a millimetre of the room, which is four of the hall


def large(factor):
    return moved(*room(n=12_000), Sim3(np.eye(3), np.zeros(3), factor))


def test_a_hall_four_times_as_large_has_the_landmarks_of_the_room_in_metres_too():
    small = describe("small", *room(n=12_000), LANDMARKS, scale_policy="known")
    hall = describe("hall", *large(4.0), LANDMARKS, scale_policy="known")
    assert hall.unit_m == 1.0
    assert small.working_m == 1.0
    assert hall.working_m == pytest.approx(0.14, rel=0.1)
    assert [name for name in small.layers if "free" not in name] == ["landmarks"]
    one, two = small.layers["landmarks"], hall.layers["landmarks@2"]
    assert two.unit_m == 0.25
    np.testing.assert_allclose(two.positions, 4 * one.positions, rtol=1e-5, atol=ROUNDED_M)
    np.testing.assert_allclose(two.embeddings, one.embeddings, atol=1.1 / 256)
    assert {"landmarks", "landmarks_gravity_free@2"} <= set(hall.layers)


def test_metres_that_are_not_told_are_treated_alike():
    told, untold = (describe("hall", *large(1.8), LANDMARKS, scale_policy=policy) for policy in ("known", "auto"))
    assert untold.working_m == pytest.approx(told.working_m)
    assert told.working_m < 0.4
    assert {name for name in untold.layers if ":" not in name} == set(told.layers)
    unknown = describe("hall", *large(1.8), LANDMARKS, scale_policy="unknown")
    assert unknown.working_m == unknown.unit_m


def test_any_two_guesses_within_an_octave_share_a_size():
    room_m = working_unit_m(1.3, room(n=100)[1])
    assert room_m == working_unit_m(0.6, room(n=100)[1]) == 1.0
    assert set(landmark_units(1.3, "known", working_m=room_m)) == {"landmarks"}
    cameras = room(n=100)[1]
    for guess in np.geomspace(1 / 30, 20, 60):
        for other in guess * np.geomspace(0.52, 1.9, 15):
            shared = set.intersection(
                *(set(landmark_units(g, "known", working_m=working_unit_m(g, cameras)).items()) for g in (guess, other))
            )
            sizes = [abs(np.log2(unit_m / np.sqrt(guess * other))) for _, unit_m in shared]
            assert min(sizes) <= 1.5, (guess, other)


def test_without_cameras_nobody_knows_from_where_it_was_seen():
    gaussians, cameras = large(4.0)
    assert working_unit_m(0.25, None) == 1.0
    graph = describe("hall", gaussians, None, LANDMARKS, scale_policy="known")
    assert graph.working_m == 1.0
    assert not any("@" in name for name in graph.layers)
    assert describe("hall", gaussians, cameras, LANDMARKS, scale_policy="known").working_m < 0.5


def test_octaves_that_layers_share_are_those_that_each_finds():
    cloud = surface_cloud(room(n=12_000)[0])
    octaves = OctaveCache()
    for unit_m in (1.0, 0.5, 0.6):
        shared, alone = (landmark_layer(cloud, UP, unit_m, octaves=given) for given in (octaves, None))
        assert len(alone) > 20
        np.testing.assert_array_equal(shared.positions, alone.positions)
        np.testing.assert_array_equal(shared.types, alone.types)
        np.testing.assert_array_equal(shared.weights, alone.weights)


def test_objects_of_a_large_place_are_of_its_size_where_the_metre_is_told():
    few = ObjectParams(segmenter="builtin", embedder="builtin", render_backend="native", num_cameras=2, min_views=1)
    params = Params(landmarks=False, things=False, object=few)
    graph = describe("hall", *large(4.0), params, scale_policy="known")
    assert graph.unit_m == 1.0
    assert graph.layers["objects"].unit_m == graph.working_m < 0.2
