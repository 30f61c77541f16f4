"""What the page is told of a map."""

import json
from dataclasses import replace

import numpy as np
from view_room import POSE_B, A, B, C, MadeDoors

from gsmap.geometry.boxes import box_corners
from gsmap.view import ViewMap
from gsmap.view.content import ServerState, ViewExtent, ViewOverview, summary
from tools.make import page_contract


def test_the_types_of_the_page_are_those_of_the_server():
    stale = "run python -m tools.make.page_contract"
    assert page_contract.FILE.read_text(encoding="utf-8") == page_contract.source(), stale


def test_summary_tells_where_everything_is():
    view = MadeDoors().view
    said = json.loads(json.dumps(summary(view, ServerState(actions=True)), allow_nan=False))
    assert [s["component"] for s in said["scenes"]] == [0, 0, 3]
    assert [s["status"] for s in said["scenes"]] == ["placed", "tentative", "not placed"]
    np.testing.assert_allclose(said["scenes"][1]["S_map_scene"], POSE_B.matrix())
    low = view.scenes[1].scene.bounds[0]
    np.testing.assert_allclose(said["scenes"][1]["corners"][0], POSE_B.apply(low))
    assert [(e["target"], e["source"], e["doubt"]) for e in said["edges"]] == [(0, 1, 0.7), (0, 2, 0.0)]
    assert said["edges"][0]["detail"] == f"edges/{A}-{B}.json"
    assert said["scenes"][2]["extras"] == f"scenes/{C}/extras.json"
    assert [c["component"] for c in said["components"]] == [0, 3]
    assert said["components"][0]["num_scenes"] == 2
    corners = np.array([s["corners"] for s in said["scenes"][:2]]).reshape(-1, 3)
    np.testing.assert_allclose(said["components"][0]["box"], [corners.min(0), corners.max(0)])
    assert said["counts"]["gaussians"] == 1200


def test_how_surely_a_scene_lies_is_told_in_metres_and_in_the_maps_unit():
    view = replace(MadeDoors().view, metres_per_unit={0: 0.5})
    boxes = {view.scenes[0].key: np.array([[-1.0, -1, -1], [1, 1, 1]])}
    one, other, _ = summary(view, ServerState(boxes=boxes))["scenes"]
    assert one["middle"] == [0, 0, 0]
    assert abs(one["sigma_m"] - 0.5 * 0.02) < 1e-9
    values = np.sort(np.linalg.eigvalsh(one["ellipsoid"]))
    np.testing.assert_allclose(values, [1e-4, 1e-4, 4e-4], rtol=1e-6)
    assert other["sigma_m"] is other["ellipsoid"] is None


def test_what_is_up_is_what_most_scenes_say():
    view = MadeDoors().view
    first, second, alone = view.scenes
    ups = [c["up"] for c in summary(view, ServerState())["components"]]
    assert ups == [[0, 0, 1], [0, -1, 0]]
    tilted = replace(
        view, scenes=[replace(first, up=np.array([0.0, 1, 0])), second, replace(alone, up=np.array([1.0, 0, 0]))]
    )
    ups = [c["up"] for c in summary(tilted, ServerState())["components"]]
    np.testing.assert_allclose(ups, [first.S_map_scene.rotation @ [0, 1, 0], [1, 0, 0]])


def test_a_static_page_promises_nothing_that_is_computed_when_asked():
    view = replace(MadeDoors().view, has_objects=True, merged=frozenset([0]))
    corners, box = box_corners(np.array([[0, 0, 0], [6, 5, 2.5]])), np.array([[0.5, 0, 0], [5, 5, 2]])
    extent = ViewExtent((corners,), corners, corners[:4], box, (6.0, 5.0, 2.5), True)
    overviews = {0: ViewOverview("o.spz", (0,), (9,), 1, extent)}
    live, still = (summary(view, ServerState(live=live, overviews=overviews)) for live in (True, False))
    assert (live["graph"], live["history"]) == ("graph.json", "history.json")
    assert (still["graph"], still["history"], still["actions"]) == ("graph.json", None, False)
    assert still["components"][0]["merged"] == "merged/0/tileset.json"
    assert live["components"][0]["plan"] == "plans/0.json"
    assert still["components"][0]["plan"] is None
    told = {"uri": "o.spz", "pending": 1, "scenes": [0], "counts": [9], "frame": corners.tolist(), "has_ceiling": True}
    told["outline"] = corners[:4].tolist()
    told["size"] = [6.0, 5.0, 2.5]
    assert still["scenes"][0]["corners"] == corners.tolist()
    whole = {0: replace(overviews[0], pending=0)}
    assert summary(view, ServerState(overviews=whole))["components"][0]["box"] == box.tolist()
    assert still["components"][0]["overview"] == told
    assert still["components"][1]["overview"] is None


def test_an_empty_map_is_told():
    assert summary(ViewMap("empty"), ServerState())["components"] == []
