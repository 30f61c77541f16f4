"""The page of `gsmap report` in a browser: nothing runs, nothing is asked for, nothing is wider than the window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from headless import Page

from gsmap.report import (
    EdgeEntry,
    Island,
    PlanEdge,
    PlanScene,
    Report,
    SceneEntry,
    make_plan,
    page,
)
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.maps import MapStatus, TodoRow
from gsmap.types.rows.pairs import EdgeRow
from gsmap.types.rows.revisions import RevisionRow
from gsmap.types.rows.scenes import SceneRow

HOSTILE = "<img src=//evil.example/x onerror=alert(1)>\"'"


def made() -> Report:
    rng = np.random.default_rng(0)
    names = ["lobby", HOSTILE, "a" * 70]
    statuses = ["placed", "placed", "tentative"]
    scenes = tuple(
        SceneEntry(
            SceneRow(
                f"{i:032x}", name, 1000, 0, 0, np.zeros((2, 3)), captured_at="2026-05-04", num_nodes=5, component=0,
                S_map_scene=None, status=status, note=HOSTILE,
            ),
            position_sigma_m=0.01 * (i + 1) ** 0.5,
        )
        for i, (name, status) in enumerate(zip(names, statuses, strict=True))
    )  # fmt: skip
    edges = []
    for a, b, used in ((0, 1, True), (1, 2, "tentative")):
        row = EdgeRow(
            target=scenes[a].row.id, target_name=names[a], source=scenes[b].row.id, source_name=names[b],
            status="accepted", reason=HOSTILE, S_target_source=None, scale=1.0, information=None, num_inliers=50,
            num_correspondences=90, overlap=0.4, seconds={}, used=used,
        )  # fmt: skip
        edges.append(EdgeEntry(row, chi2=3.0 + a, translation_m=0.01, rotation_deg=0.1, probability=0.9, component=0))
    shown = [
        PlanScene(
            name, status, rng.uniform(0, 5, (500, 3)) + 3 * i, rng.uniform(0, 5, (9, 3)), np.full(3, 3.0 * i), np.eye(3)
        )
        for i, (name, status) in enumerate(zip(names, statuses, strict=True))
    ]
    plan = make_plan(shown, [PlanEdge(0, 1, "used", HOSTILE), PlanEdge(1, 2, "tentative")], None)
    revisions = tuple(
        RevisionRow(
            number=k, created_at="2026-05-04T10:00:00+00:00", scenes=k, components=1, edges_used=1, edges_tentative=1,
            edges_refused=0, settings={}, note=HOSTILE,
        )
        for k in (1, 2, 3)
    )  # fmt: skip
    todo = TodoRow(what="tentative", count=1, verb=f"gsmap list {HOSTILE}", meaning=HOSTILE)
    pictures = {(edges[1].row.target, edges[1].row.source): rng.integers(0, 255, (90, 300, 3)).astype(np.uint8)}
    return Report(
        title=HOSTILE, map_id="0" * 32, made_at="2026-05-04T10:00:00+00:00", version="0", scenes=scenes,
        status=MapStatus(todo=(todo,), scenes=3, components=1, islands=1, tentative=1, revision=3, metres_per_unit=1.0),
        edges=tuple(edges), islands=(Island(0, tuple(names), MetricScale(1.0, 0.01, "told"), plan),),
        revisions=revisions,
        num_revisions=3, pair_pictures=pictures, storage={"scenes": (3, 12345)}, notes=(HOSTILE,),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1200])
def test_the_page_opens_without_a_request_or_an_error(width: int, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(page(made()))
    url = f"file://{tmp_path}/report.html"
    with Page("about:blank", tmp_path / "profile", width, 800) as browser:
        browser._call("Log.enable", {})
        browser._call("Page.navigate", {"url": url})
        browser.wait("document.readyState == 'complete' && document.querySelectorAll('svg').length > 2")
        assert browser.value("getComputedStyle(document.querySelector('.facts')).display") == "grid"  # the style counts
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.value("document.querySelectorAll('script, [onerror], [style]').length") == 0
        assert browser.value("document.title").startswith("<img src=//evil")
        loaded = "[...document.images].filter(i => i.complete && i.naturalWidth > 0).length"
        browser.value("document.images[0].scrollIntoView()")
        browser.wait(f"{loaded} == 1")
        asked = [told["request"]["url"] for told in said(browser, "Network.requestWillBeSent")]
        assert [where for where in asked if not where.startswith("data:image/webp") and where != url] == []
        assert said(browser, "Log.entryAdded") == []
        assert browser.failures() == []
        assert browser.picture().std() > 0.05
        # What its policy forbids is not asked for even where somebody puts it in.
        browser.value("document.body.insertAdjacentHTML('beforeend', '<img src=https://evil.example/a.png>')")
        browser.wait("document.images[1].complete")
        assert [told.get("blockedReason") for told in said(browser, "Network.loadingFailed")] == ["csp"]


def said(browser: Page, method: str) -> list[dict]:
    """What the browser has told of a kind."""
    return [message["params"] for message in browser.messages if message.get("method") == method]
