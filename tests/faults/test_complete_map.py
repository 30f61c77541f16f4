"""One map that has everything: what it answers must not change with what else is done to the map."""

from __future__ import annotations

import contextlib
import io
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from fault_verbs import BASES, FUNCTIONS, copy_map, words, write_samples

from gsmap import formats
from gsmap.cli.app import run

CRATE = np.array([[2.0, 1.2, 0.0], [2.6, 1.8, 1.0]])  # in the frame of every capture


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("samples") / "samples"
    write_samples(folder)
    return folder


@pytest.fixture(scope="module")
def stages(samples: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The map on its way: a copy before each line that could make it forget, and the end of it."""
    root = tmp_path_factory.mktemp("complete")
    work = root / "work"
    work.mkdir()
    out = {}
    for line in (*BASES["empty"][1], *BASES["complete"][1]):
        verb = line.split()[0]
        if verb in ("branch", "thin") or "--supersedes" in line:
            copy_map(work, root / f"before {verb}")
            out[f"before {verb}"] = root / f"before {verb}"
        if line in FUNCTIONS:
            FUNCTIONS[line](work / "site.gsmap")
        else:
            gsmap(line, work, samples)
    return out | {"complete": work}


def gsmap(line: str, folder: Path, samples: Path = Path()) -> str:
    """What a line of the command line prints; it must end well."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.raises(SystemExit) as end:
        run(words(line, folder, samples))
    assert not end.value.code, line
    return said.getvalue()


def check_answers(folder: Path, name: str = "MAP", scenes: tuple[str, ...] = ("now", "then")) -> None:
    """A map of the room knows where its scenes lie, how long it is, and that the crate was there in January only."""
    ask = lambda line: json.loads(gsmap(f"{line} --json", folder))  # noqa: E731
    assert ask(f"check {name}")["problems"] == []
    poses = {pose["scene_name"]: pose for pose in ask(f"poses {name}")["poses"]}
    assert tuple(sorted(poses)) == scenes
    across = ask(f"measure {name} {scenes[0]}:0,0,0 {scenes[-1]}:4,3,0")
    assert across["distance_m"] == pytest.approx(5, abs=3 * across["sigma_m"])
    (crate,) = ask(f"graph {name}")["objects"]
    assert np.allclose(crate["position"], CRATE.mean(0), atol=0.1)
    assert np.allclose(crate["size"], np.ptp(CRATE, axis=0), atol=0.1)
    assert (crate["id"], crate["name"], crate["label"]) == ("o1", "crate", "box")
    assert {crate["first_seen"][:10], crate["last_seen"][:10]} == {"2026-01-01"}
    (hit,) = ask(f"find {name} crate")["hits"]
    assert (hit["object"], hit["scene_name"]) == ("o1", "then")
    if "now" in scenes:
        assert crate["there"] is False
        (first,) = (one for one in ask(f"changes {name}")["changes"] if one["id"] == "c1")
        assert (first["kind"], first["status"]) == ("disappeared", "confirmed")


@pytest.mark.parametrize("stage", ["before branch", "before thin", "before ingest", "complete"])
def test_it_answers_alike_all_the_way(stages: dict[str, Path], stage: str) -> None:
    check_answers(stages[stage])


@pytest.mark.parametrize(
    ("lines", "name"),
    [
        (["changes MAP@what-if"], "MAP@what-if"),
        (["merge MAP MAP@what-if", "optimize MAP"], "MAP"),
        (["georeference MAP --remove", "optimize MAP"], "MAP"),
        (["backup MAP HERE/kept", "restore HERE/kept HERE/copy.gsmap"], "HERE/copy.gsmap"),
        (["clone MAP HERE/copy.gsmap"], "HERE/copy.gsmap"),
        (["prune MAP --keep-revisions 1"], "MAP"),
        (["thin MAP --keep-days 0", "update MAP"], "MAP"),
        (["ingest MAP IN/later.ply --supersedes now", "update MAP"], "MAP"),
    ],
)
def test_copies_and_later_verbs_answer_alike(
    stages: dict[str, Path], samples: Path, tmp_path: Path, lines: list[str], name: str
) -> None:
    copy_map(stages["complete"], tmp_path)
    for line in lines:
        gsmap(line, tmp_path, samples)
    check_answers(tmp_path, name)


def test_a_part_of_it_keeps_what_is_said_of_its_scene(stages: dict[str, Path], tmp_path: Path) -> None:
    copy_map(stages["complete"], tmp_path)
    gsmap("split MAP HERE/part.gsmap --scenes then", tmp_path)
    check_answers(tmp_path, "HERE/part.gsmap", ("then",))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ends = json.loads(gsmap("measure HERE/part.gsmap then:0,0,0 then:4,3,0 --json", tmp_path))
    # The control points are marked in photos of the other scene, so nothing ties this one to the world.
    assert ends["a"]["sigma_m"] is None


def test_what_is_static_and_what_localizes_is_without_the_crate(
    stages: dict[str, Path], samples: Path, tmp_path: Path
) -> None:
    copy_map(stages["complete"], tmp_path)
    gsmap("export MAP HERE/static --format ply --merge union --tile-size 0 --static", tmp_path, samples)
    gsmap("export MAP HERE/whole --format ply --merge union --tile-size 0 --prefer both", tmp_path, samples)
    inside = {}
    for kind in ("static", "whole"):
        (file,) = (tmp_path / kind).rglob("*.ply")
        means = formats.read(file).means
        inside[kind] = int(((means > CRATE[0] + 0.03) & (means < CRATE[1] + [-0.03, -0.03, 0.03])).all(1).sum())
    assert inside["whole"] > 20
    assert inside["static"] == 0


READING = (
    *("status MAP", "list MAP scenes", "list MAP edges", "list MAP revisions", "list MAP tiles", "list MAP photos"),
    *("show MAP then", "show MAP then:now", "show MAP c1", "show MAP o1", "why MAP then:now", "history MAP o1"),
    *("diff MAP 1 2", "poses MAP --crs EPSG:32632", "poses MAP HERE/poses.g2o --format g2o", "settings MAP"),
    *("georeference MAP", "find MAP --like o1", "models list MAP", "branch MAP", "tag MAP", "prune MAP --dry-run"),
    *("thin MAP --keep-days 0 --dry-run", "graph MAP HERE/graph.graphml", "register MAP", "describe MAP", "update MAP"),
)


@pytest.mark.parametrize("stage", ["before thin", "complete"])
def test_every_verb_answers_before_and_after(stages: dict[str, Path], tmp_path: Path, stage: str) -> None:
    copy_map(stages[stage], tmp_path)
    for line in READING:
        gsmap(line, tmp_path)
    (hit,) = json.loads(gsmap("find MAP --like o1 --json", tmp_path))["hits"]
    assert (hit["object"], hit["scene_name"]) == ("o1", "then")
