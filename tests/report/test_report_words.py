"""What a report says of a map in words, whatever its state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from gsmap.report import EdgeEntry, Island, Report, SceneEntry, page
from gsmap.report.words import angle, chi_square, cut_pair, length, number, probability, size, some, verdict
from gsmap.types.metric_scale import KNOWN_BY, KnownBy, MetricScale
from gsmap.types.rows.maps import MapStatus, TodoKind, TodoRow
from gsmap.types.rows.pairs import EdgeRow
from gsmap.types.rows.revisions import RevisionRow
from gsmap.types.rows.scenes import SceneRow


def scene(name: str, status: str = "placed", component: int | None = 0) -> SceneEntry:
    row = SceneRow(
        name=name,
        id=name,
        num_gaussians=10,
        sh_degree=0,
        num_cameras=0,
        bounds=np.zeros((2, 3)),
        num_nodes=1,
        component=component,
        S_map_scene=None,
        status=status,
    )
    return SceneEntry(row)


def edge(a: str, b: str, used: bool | str = True, chi2: float = 3.0, **more: Any) -> EdgeEntry:
    row = EdgeRow(
        target=a,
        target_name=a,
        source=b,
        source_name=b,
        status="accepted",
        reason="",
        S_target_source=None,
        scale=1.0,
        information=None,
        num_inliers=9,
        num_correspondences=9,
        overlap=0.5,
        seconds={},
        used=used,
        **more,
    )
    return EdgeEntry(row, chi2=chi2, component=0)


def report(*scenes: SceneEntry, edges: tuple[EdgeEntry, ...] = (), solved: bool = True, **todo: int) -> Report:
    rows = tuple(TodoRow(what=what, count=num, verb="gsmap", meaning=what) for what, num in todo.items())
    status = MapStatus(
        todo=rows, scenes=len(scenes), components=1, islands=1, tentative=0, revision=1, metres_per_unit=None
    )
    revision = RevisionRow(
        number=1,
        created_at="2026-05-04T10:00:00+00:00",
        scenes=1,
        components=1,
        edges_used=1,
        edges_tentative=0,
        edges_refused=0,
        settings={},
    )
    return Report(
        "a",
        "0" * 32,
        "2026-05-04",
        "0",
        status,
        scenes,
        edges,
        (Island(0, tuple(one.row.name for one in scenes), MetricScale()),) if solved else (),
        (revision,) if solved else (),
    )


@pytest.mark.parametrize(
    ("made", "standing", "says"),
    [
        (report(solved=False), "empty", "This map is empty"),
        (report(scene("a", "described", None), solved=False, unsolved=1), "act", "poses were never solved"),
        (report(scene("a"), scene("b")), "good", "All 2 scenes are placed in one component"),
        (report(scene("a"), scene("b", "tentative"), tentative=1), "look", "Doubtful: b rests on"),
        (report(scene("a"), scene("b", component=1)), "good", "in 2 components, which share no frame"),
        (report(scene("a"), scene("b", "isolated", 1), isolated=1), "look", "no edge connects b to other scenes"),
        (report(scene("a"), scene("b", "described", None), unsolved=1), "act", "b has no pose"),
        (report(scene("a"), set_aside=1), "act", "Next: set_aside"),
        (
            report(scene("a"), scene("b"), edges=(edge("a", "b", undecided=True),), undecided=1),
            "look",
            "Contradictory: a:b",
        ),
        (report(scene("a"), scene("b"), edges=(edge("a", "b", chi2=99.0),)), "good", "Large residuals: 1 used edge"),
    ],
)
def test_the_verdict_says_how_a_map_stands(made: Report, standing: str, says: str) -> None:
    found, sentences = verdict(made)
    assert found == standing
    assert says in " ".join(sentences)
    assert " ".join(sentences).replace("'", "&#x27;") in page(made)


@pytest.mark.parametrize("known_by", KNOWN_BY)
def test_every_way_to_know_a_metre_is_said(known_by: KnownBy) -> None:
    made = report(scene("a"), scene("b"))
    island = replace(made.islands[0], metre=MetricScale(0.5, 0.01, known_by))
    said = " ".join(verdict(replace(made, islands=(island,)))[1])
    assert ("lengths have no known unit" in said.lower()) == (known_by == "unknown")
    assert ("to 1 %" in said) == (known_by != "unknown")


@pytest.mark.parametrize("what", get_args(TodoKind))
def test_a_map_with_something_to_do_is_not_in_order(what: TodoKind) -> None:
    assert verdict(report(scene("a"), scene("b"), **{what: 1}))[0] in ("act", "look")


def test_nothing_checks_edges_in_no_loop() -> None:
    chain = report(scene("a"), scene("b"), scene("c"), edges=(edge("a", "b"), edge("b", "c")))
    assert "nothing checks these edges" in page(chain)
    loop = replace(chain, edges=(*chain.edges, edge("a", "c", chi2=8.0)))
    assert "7 of their measured values are redundant" in page(loop)
    assert "Variance factor 2 (1 is expected)" in page(loop)


def test_the_same_report_is_the_same_page() -> None:
    made = report(scene("a"), scene("b"), edges=(edge("a", "b"),))
    assert page(made) == page(made)


def test_numbers_are_short() -> None:
    assert [length(v) for v in (None, 0.0, 1e-6, 0.00234, 0.0523, 0.25, 12.345, 2345.6)] == [
        "–",
        "0",
        "< 0.1 mm",
        "2.3 mm",
        "52 mm",
        "0.25 m",
        "12.3 m",
        "2.35 km",
    ]
    assert [number(v) for v in (None, float("nan"), 0, 1.23456, 12345.6, 1e-7)] == [
        "–",
        "–",
        "0",
        "1.23",
        "12,346",
        "1.00e-07",
    ]
    assert [angle(v) for v in (None, 0.0, 1e-9, 0.0234)] == ["–", "0°", "< 0.001°", "0.023°"]
    assert [chi_square(v) for v in (None, 1e-17, 3.0)] == ["–", "0", "3"]
    assert probability(1.0) == "0.999"
    assert [size(v) for v in (12, 12_345, 5_678_901)] == ["12 bytes", "12.3 kB", "5.68 MB"]
    assert some(["a"]) == "a"
    assert some(["a", "b"]) == "a and b"
    assert some(list("abcde")) == "a, b, c and 2 more"
    assert cut_pair(("street-00132", "street-00131"), 19) == "…et-00132:…et-00131"
