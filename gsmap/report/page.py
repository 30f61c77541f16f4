"""Compose the HTML page of a report, one self-contained file of several sections."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from gsmap.markup import Markup, Part, joined, policy_meta, source_of, tag
from gsmap.report import plots
from gsmap.report.content import EdgeEntry, Island, PoseDifferences, Report
from gsmap.report.draw_plan import draw_plan
from gsmap.report.top import data_address, picture_webp
from gsmap.report.words import (
    angle,
    chi_square,
    count,
    cut,
    day,
    duration,
    length,
    metre,
    moment,
    number,
    probability,
    size,
    strained,
    verdict,
)

_MARK = re.compile(rb'<meta name="gsmap-map" content="([0-9a-f]{32,64})">')
_HEAD_BYTES = 4096  # start of a report file that contains the id of its map
_CHANGES = 200  # maximum number of rows in the tables of changes and objects
_MATRIX_SCENES = 300  # maximum number of scenes in the matrix of registered pairs
_FEW = 12  # rows of a long table that are visible; the remaining rows are folded
_STANDING = {
    "good": "In order",
    "look": "Needs review",
    "act": "Needs computation",
    "empty": "Empty",
}
_KINDS = {"scenes": "captures", "graphs": "scene graphs", "indexes": "retrieval index", "models": "networks"}
_ORDER = ("undecided", "tentative", "unsolved", "unused", "used", "rejected", "no_match", "never registered")


def page(report: Report) -> str:
    """Format a report as HTML.

    The same report gives the same bytes. The page's policy forbids scripts and all requests; its style sheet is
    allowed by its digest, and pictures are embedded.
    """
    style = resources.files("gsmap.report").joinpath("style.css").read_text(encoding="utf-8")
    policy = {"default-src": "'none'", "style-src": source_of(style), "img-src": "data:"}
    policy |= {"base-uri": "'none'", "form-action": "'none'"}
    sections = [(name, title, content) for name, (title, make) in SECTIONS.items() if (content := make(report))]
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        policy_meta(policy),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("meta", name="generator", content=f"gsmap {report.version}"),
        owner_mark(report.map_id),
        tag("title", f"{report.title}: map report"),
        tag("style", Markup(style)),
    )
    links = [tag("a", title, href=f"#{name}") for name, title, _ in sections]
    body = tag(
        "body",
        _head(report),
        tag("nav", links, aria_label="Sections"),
        tag("main", [tag("section", tag("h2", title), content, id=name) for name, title, content in sections]),
        _foot(report),
    )
    return "<!doctype html>\n" + tag("html", head, body, lang="en").html + "\n"


def owner_mark(map_id: str) -> Markup:
    """Return the element of the head by which `owner_of` recognizes a page of a map."""
    return tag("meta", name="gsmap-map", content=map_id)


def owner_of(path: Path) -> str | None:
    """Return the id of the map of a report or a page in one file; None for another file."""
    if not path.is_file():  # opening a pipe would wait for its writer
        return None
    try:
        with path.open("rb") as file:
            found = _MARK.search(file.read(_HEAD_BYTES))
    except OSError:
        return None
    return None if found is None else found[1].decode()


# --- the head --------------------------------------------------------------------------------------------------------


def _head(report: Report) -> Markup:
    standing, sentences = verdict(report)
    rows = [entry.row for entry in report.scenes]
    dates = sorted(row.captured_at for row in rows if row.captured_at)
    undated = len(rows) - len(dates)
    dated = [f"to {day(dates[-1])}"] if dates and day(dates[0]) != day(dates[-1]) else []
    dated += [f"{undated:,} without a date"] if undated else []
    islands = [island for island in report.islands if len(island.scenes) > 1]
    alone = len(report.islands) - len(islands)
    facts: list[tuple[str, Part, str]] = [
        ("Scenes", f"{len(rows):,}", _statuses(report)),
        ("Components", f"{len(report.islands):,}", count(alone, "single scene") if alone else ""),
        ("Gaussians", _short(sum(row.num_gaussians for row in rows)), ""),
        ("On disk", size(sum(num_bytes for _, num_bytes in report.storage.values())), ""),
        ("Captured", day(dates[0]) if dates else "–", ", ".join(dated)),
        ("Revision", str(report.revision.number) if report.revision else "none",
         moment(report.revision.created_at) if report.revision else "never solved"),
    ]  # fmt: skip
    if report.islands:
        known = report.islands[0].metre
        text = known.text().replace(f", {known.known_by}", "") if known.is_known else "lengths have no known unit"
        facts.append(("Metric scale", known.known_by, text))
    return tag(
        "header",
        tag("p", "gsmap map report", class_="kicker"),
        tag("h1", report.title),
        tag("p", f"Made {moment(report.made_at)} UTC by gsmap {report.version}", class_="quiet"),
        tag(
            "div",
            tag("p", tag("span", _STANDING[standing], class_="badge"), class_="standing"),
            tag("p", " ".join(sentences)),
            class_=f"verdict {standing}",
        ),
        tag(
            "dl",
            [
                tag("div", tag("dt", name), tag("dd", value, tag("small", more) if more else None))
                for name, value, more in facts
            ],
            class_="facts",
        ),
    )


def _statuses(report: Report) -> str:
    found: dict[str, int] = {}
    for entry in report.scenes:
        found[entry.row.status] = found.get(entry.row.status, 0) + 1
    return ", ".join(f"{num:,} {status}" for status, num in found.items())


def _short(value: int) -> str:
    for power, unit in ((9, "billion"), (6, "million")):
        if value >= 10**power:
            return f"{value / 10**power:.3g} {unit}"
    return f"{value:,}"


def _todo(report: Report) -> Markup | None:
    status = report.status
    if not status.todo and not status.at_work:
        return None
    rows = [(row.count, row.meaning, tag("code", row.verb)) for row in status.todo]
    parts: list[Part] = [_table(("count", "task", "command"), rows, (0,), (1, 2)) if rows else None]
    if status.at_work:
        working = [(row.what, row.task, row.host, moment(row.since)) for row in status.at_work[:_FEW]]
        parts += [tag("h3", "Running jobs"), _table(("subject", "task", "host", "since"), working)]
    return joined(parts)


# --- plans -----------------------------------------------------------------------------------------------------------


def _plans(report: Report) -> Markup | None:
    if not report.islands:
        return None
    drawn = [island for island in report.islands if island.plan is not None]
    others = [island for island in report.islands if island.plan is None]
    parts: list[Part] = [_plan(island, len(report.islands) > 1) for island in drawn]
    if others:
        rows = [(f"{i.component}", f"{len(i.scenes):,}", cut(", ".join(i.scenes), 80), i.note) for i in others]
        parts += [
            tag("h3", "Components without a plan"),
            _folded(("component", "scenes", "names", ""), rows, (0, 1), (2, 3)),
        ]
    return joined(parts)


def _plan(island: Island, many: bool) -> Markup:
    assert island.plan is not None
    title = f"Floor plan of component {island.component}" if many else "Floor plan"
    drawing, magnified = draw_plan(island.plan, title)
    span = island.plan.bounds[1] - island.plan.bounds[0]
    tracks = any(len(track) for track in island.plan.tracks)
    words = [f"{count(len(island.scenes), 'scene')}, {length(span[0])} by {length(span[1])}; {metre(island.metre)}."]
    if magnified:
        times = "to scale" if magnified == 1 else f"drawn {magnified:,} times larger"
        words.append(f"Ellipses contain the position of a scene with 95 % probability, {times}.")
    if tracks:
        words.append("Small dots are cameras.")
    if island.note:
        words.append(island.note)
    used = {edge.use for edge in island.plan.edges}
    legend = [tag("span", tag("i", class_=f"swatch {use}"), name) for use, name in _LEGEND.items() if use in used]
    return tag(
        "figure",
        tag("h3", f"Component {island.component}") if many else None,
        tag("div", drawing, class_="wide"),
        tag("p", legend, class_="legend") if legend else None,
        tag("figcaption", " ".join(words)),
    )


_LEGEND = {
    "used": "edge, used",
    "strained": "used, large residual",
    "tentative": "tentative: no cycle confirms it",
    "undecided": "undecided: contradicts another edge",
    "unused": "accepted, but not used",
    "unsolved": "newer than the poses",
    "rejected": "rejected",
    "no_match": "registered, no match",
}


# --- doubt -----------------------------------------------------------------------------------------------------------


def _doubt(report: Report) -> Markup | None:
    doubtful = [edge for edge in report.edges if edge.use in ("undecided", "tentative")]
    strain = strained(report.edges)
    if not doubtful and not strain:
        return None
    parts: list[Part] = []
    if doubtful:
        parts.append(
            tag("p", "No cycle of other edges confirms a tentative edge. If nothing contradicts it, its scene is "
                "placed by one pair, which is correct far more often than not; a look settles it. An "
                "undecided edge contradicts other edges, and gsmap cannot decide which is correct. Each row "
                "shows one camera: the first scene, the second scene, and their differences in red. If walls and "
                "furniture coincide, confirm the edge; if not, reject it.")
        )  # fmt: skip
    if strain:
        parts.append(
            tag("p", f"{count(len(strain), 'edge')} with a chi² above 99.9 % of correct edges: ",
                ", ".join(f"{e.row.pair} (chi² {chi_square(e.chi2)})" for e in strain[:_FEW]), ".")
        )  # fmt: skip
    entries = {(edge.row.target, edge.row.source): edge for edge in doubtful}
    for pair, picture in report.pair_pictures.items():
        edge, row = entries[pair], entries[pair].row
        likely = "" if edge.probability is None else f", correct with probability {probability(edge.probability)}"
        parts.append(
            tag(
                "figure",
                tag("h3", row.target_name, tag("span", " : ", class_="quiet"), row.source_name),
                tag("p", tag("span", row.target_name), tag("span", row.source_name),
                    tag("span", "differences in red"), class_="heads"),
                _picture(picture, f"{row.pair} from the same cameras"),
                tag("figcaption", f"{row.reason or edge.use}. {count(row.num_inliers, 'inlier')}, overlap "
                    f"{number(row.overlap, 2)}{likely}."),
                class_="pair",
            )
        )  # fmt: skip
    rest = len(doubtful) - len(report.pair_pictures)
    if rest > 0:
        parts.append(tag("p", f"{count(rest, 'more such pair')} without a picture; to draw one: ",
                         tag("code", "gsmap show MAP A:B --picture FILE"), class_="quiet"))  # fmt: skip
    return joined(parts)


def _picture(picture: np.ndarray, alt: str) -> Markup:
    height, width = picture.shape[:2]
    return tag("img", src=data_address(picture_webp(picture)), alt=alt, width=width, height=height, loading="lazy")


# --- edges -----------------------------------------------------------------------------------------------------------


def _edges(report: Report) -> Markup | None:
    if not report.edges:
        return None
    solved = [edge for edge in report.edges if edge.chi2 is not None and edge.use in ("used", "tentative", "undecided")]
    checked = [edge for edge in solved if edge.use == "used"]
    plots_: list[Part] = [_figure(_matrix(report), "Registered pairs by outcome.")]
    if plots.pulled(solved):
        plots_.append(
            _figure(
                plots.residual_bars(solved),
                f"{_largest(plots.pulled(solved))}. Dashed: 95 % and 99.9 % of correct edges lie below. "
                "An edge in no cycle has no residual, whether it is correct or not.",
            )
        )
    if len(checked) > 1:
        plots_.append(
            _figure(
                plots.residual_distribution(checked),
                "Steps: this map. Curve: chi² with 7 degrees of freedom. Left of the curve, residuals are smaller than "
                "the standard deviations predict (or the edges are in no cycle); right of it, larger.",
            )
        )
    if any(edge.translation_m is not None for edge in plots.pulled(solved)):
        plots_.append(
            _figure(plots.offset_bars(solved), "Distance between the poses and each edge's measurement, at "
                    "the centre of the second scene.")
        )  # fmt: skip
    parts: list[Part] = [_redundancy(report), tag("div", plots_, class_="plots"), _statistics(checked)]
    parts.append(_edge_table(report))
    return joined(parts)


def _largest(edges: Sequence[EdgeEntry]) -> str:
    most = plots.MAX_BARS
    return f"The {most} largest of {len(edges):,}" if len(edges) > most else "All edges in cycles"


def _redundancy(report: Report) -> Markup | None:
    """Format the redundancy of the edges and their variance factor."""
    used = [edge for edge in report.edges if edge.use == "used" and edge.chi2 is not None]
    tied: dict[int, set[str]] = {}
    for edge in used:
        if edge.component is not None:
            tied.setdefault(edge.component, set()).update((edge.row.target, edge.row.source))
    spare = 7 * (len(used) - sum(len(scenes) - 1 for scenes in tied.values()))
    if not used:
        return None
    total = sum(edge.chi2 or 0.0 for edge in used)
    if spare <= 0:
        return tag("p", f"{count(len(used), 'edge is', 'edges are')} used, without redundancy, "
                   "so that nothing checks these edges.")  # fmt: skip
    factor = total / spare
    verdict_ = (
        "residuals agree with the standard deviations of the edges"
        if 0.25 <= factor <= 2
        else "residuals are smaller than the standard deviations of the edges, which are conservative"
        if factor < 0.25
        else f"the standard deviations of the edges are too small by a factor of about {number(factor**0.5, 2)}, or an "
        "edge is wrong"
    )
    return tag(
        "p",
        f"{count(len(used), 'edge is', 'edges are')} used; {spare:,} of their measured values are redundant. Variance "
        f"factor {number(factor)} (1 is expected): {verdict_}.",
    )


def _statistics(edges: Sequence[EdgeEntry]) -> Markup | None:
    rows = []
    for name, unit, values in (
        ("translation", "m", [e.translation_m for e in edges if e.translation_m is not None]),
        ("rotation", "°", [e.rotation_deg for e in edges if e.rotation_deg is not None]),
        ("chi²", "", [e.chi2 for e in edges if e.chi2 is not None]),
    ):
        if len(values) > 1:
            v = np.array(values)
            figures = (np.sqrt((v**2).mean()), v.mean(), np.median(v), v.std(), v.min(), v.max())
            rows.append((f"{name}{', ' + unit if unit else ''}", *(number(float(one)) for one in figures)))
    if not rows:
        return None
    head = ("residual of used edges", "rmse", "mean", "median", "std", "min", "max")
    return _table(head, rows, numeric=tuple(range(1, 7)))


def _matrix(report: Report) -> Markup:
    known = [entry.row for entry in report.scenes]
    order = sorted(range(len(known)), key=lambda i: (known[i].component is None, known[i].component or 0, i))
    order = order[:_MATRIX_SCENES]
    place = {known[i].id: k for k, i in enumerate(order)}
    cells = []
    for edge in report.edges:
        a, b = place.get(edge.row.target), place.get(edge.row.source)
        if a is not None and b is not None:
            tip = f"{edge.row.pair}: {_LEGEND.get(edge.kind, edge.kind)}"
            cells.append((max(a, b), min(a, b), edge.kind, tip))
    return plots.matrix([known[i].name for i in order], cells, "Registered pairs of scenes")


def _edge_table(report: Report) -> Markup:
    rank = {use: k for k, use in enumerate(_ORDER)}
    ordered = sorted(
        report.edges,
        key=lambda e: (rank.get(e.use, len(rank)), -(e.chi2 or 0.0), e.probability or 0.0, e.row.pair),
    )
    shown = ordered[: report.params.edges]
    head = ("pair", "outcome", "chi²", "translation", "rotation", "inliers", "overlap", "probability", "reason")
    tried = [edge for edge in shown if edge.use not in ("rejected", "no_match")]
    refused = [edge for edge in shown if edge.use in ("rejected", "no_match")]
    numeric = (2, 3, 4, 5, 6, 7)
    parts: list[Part] = []
    if tried:
        parts += [tag("h3", "Edges, most doubtful first"), _folded(head, [_edge_row(e) for e in tried], numeric, (8,))]
    if refused:
        rows = [_edge_row(e) for e in refused]
        summary = f"{count(len(refused), 'pair')} that did not match"
        parts.append(tag("details", tag("summary", summary), _table(head, rows, numeric, (8,))))
    if len(ordered) > len(shown):
        parts.append(_more(len(ordered) - len(shown), "edges", "gsmap list MAP edges"))
    return joined(parts)


def _edge_row(edge: EdgeEntry) -> tuple[Part, ...]:
    review = f", {edge.row.review}ed by a person" if edge.row.review else ""
    return (
        edge.row.pair,
        tag("span", f"{edge.kind.replace('_', ' ')}{review}", class_=f"tag {edge.kind}"),
        chi_square(edge.chi2),
        length(edge.translation_m),
        angle(edge.rotation_deg),
        f"{edge.row.num_inliers:,}",
        number(edge.row.overlap, 2),
        probability(edge.probability),
        edge.row.reason,
    )


# --- scenes ----------------------------------------------------------------------------------------------------------


def _scenes(report: Report) -> Markup | None:
    if not report.scenes:
        return None
    rank = {"ingested": 0, "described": 0, "isolated": 1, "tentative": 2, "placed": 3}
    ordered = sorted(report.scenes, key=lambda s: (rank.get(s.row.status, 0), -(s.position_sigma_m or 0.0)))
    shown = ordered[: report.params.scenes]
    edges: dict[str, int] = {}
    for edge in report.edges:
        if edge.use in ("used", "tentative", "undecided"):
            for scene in (edge.row.target, edge.row.source):
                edges[scene] = edges.get(scene, 0) + 1
    rows = [
        (
            entry.row.name,
            tag("span", entry.row.status, class_=f"tag {entry.row.status}"),
            "–" if entry.row.component is None else str(entry.row.component),
            tag("span", day(entry.row.captured_at), class_="tag"),
            length(entry.position_sigma_m),
            angle(entry.rotation_sigma_deg),
            str(edges.get(entry.row.id, 0)),
            f"{entry.row.num_gaussians:,}",
            f"{entry.row.num_cameras:,}",
            size(entry.num_bytes),
            joined([tag("span", one, class_="chip") for one in entry.row.tags], entry.row.note),
        )
        for entry in shown
    ]
    head = (
        "scene",
        "status",
        "component",
        "captured",
        "sigma",
        "sigma, deg",
        "edges",
        "Gaussians",
        "cameras",
        "bytes",
        "notes",
    )
    parts: list[Part] = []
    known = [entry for entry in report.scenes if entry.position_sigma_m]
    if known:
        most = plots.MAX_BARS
        first = f"The {most} largest of {len(known):,}" if len(known) > most else "The largest first"
        words = f"{first}. At the centre of each scene, in the least certain direction, in the component frame."
        drawn = [_figure(plots.sigma_bars(known), words)]
        if len(known) > most:
            drawn.append(_figure(plots.sigma_distribution(known), "Share of the scenes up to each standard deviation."))
        parts.append(tag("div", drawn, class_="plots"))
    parts.append(_folded(head, rows, (2, 4, 5, 6, 7, 8, 9), (10,)))
    if len(ordered) > len(shown):
        parts.append(_more(len(ordered) - len(shown), "scenes", "gsmap list MAP scenes"))
    return joined(parts)


# --- changes, history, cost ------------------------------------------------------------------------------------------


def _changes(report: Report) -> Markup | None:
    parts: list[Part] = []
    if report.since is not None:
        names, num_accepted = report.new_scenes, sum(edge.status == "accepted" for edge in report.new_edges)
        some_ = f" ({', '.join(cut(name) for name in names[:_FEW])}{', …' * (len(names) > _FEW)})" if names else ""
        parts.append(
            tag("p", f"Since {moment(report.since)}: {count(len(names), 'new scene')}{some_}, "
                f"{count(len(report.new_edges), 'pair')} registered, {num_accepted:,} of them accepted.")
        )  # fmt: skip
    found = report.changes
    if found is not None:
        pictures = report.change_pictures
        since = "" if report.since is None else " since then"
        if not found.pairs:
            parts.append(tag("p", f"No captures were compared with earlier ones{since}.", class_="quiet"))
        else:
            parts.append(
                tag("p", f"{count(len(found.pairs), 'pair')} of captures compared{since}: "
                    f"{count(len(found.changes), 'change')}.")
            )  # fmt: skip
        cards = [
            tag(
                "figure",
                _picture(pictures[row.id], f"{row.kind}, before and after"),
                tag("figcaption", tag("b", f"{row.id}: {row.kind}"), f", {row.older_name} to {row.newer_name}, "
                    f"confidence {number(row.confidence, 2)}"),
            )
            for row in found.changes
            if row.id in pictures
        ]  # fmt: skip
        if cards:
            parts.append(tag("div", cards, class_="cards"))
        rows = [
            (row.id, row.kind, row.pair, day(row.newer_at), row.at_m, row.size_m, number(row.confidence, 2), row.status)
            for row in found.changes[:_CHANGES]
        ]
        if rows:
            head = ("id", "kind", "from:to", "seen", "at, m", "size, m", "confidence", "status")
            parts.append(_folded(head, rows, (6,)))
        if len(found.changes) > len(rows):
            parts.append(_more(len(found.changes) - len(rows), "changes", "gsmap changes MAP"))
        parts += [tag("p", note, class_="quiet") for note in found.notes]
    return joined(parts) or None


def _things(report: Report) -> Markup | None:
    """Format the rooms and objects of the map, named objects first."""
    known = report.objects
    if known is None or not known.objects:
        return None
    there = sum(row.there for row in known.objects)
    parts: list[Part] = [tag("p", f"{count(len(known.objects), 'object')}, {there:,} of them still in place.")]
    if known.rooms:
        rooms = [
            (row.id, f"{row.area_m2:.1f}", ", ".join(row.doors), f"{len(row.objects):,}") for row in known.rooms[:_FEW]
        ]
        parts += [tag("h3", "Rooms"), _table(("room", "m²", "doors to", "objects"), rooms, (1, 3))]
    ordered = sorted(known.objects, key=lambda row: (row.name is None, row.label is None))[:_CHANGES]
    rows = [
        (
            row.id,
            cut(row.name or row.label or ""),
            row.room or "",
            "there" if row.there else "gone",
            f"{row.seen} of {row.looks}",
            day(row.first_seen),
            day(row.last_seen),
        )
        for row in ordered
    ]
    parts.append(tag("h3", "Objects"))
    parts.append(_folded(("object", "name", "room", "", "seen", "first seen", "last seen"), rows, ()))
    if len(known.objects) > len(rows):
        parts.append(_more(len(known.objects) - len(rows), "objects", "gsmap graph MAP"))
    return joined(parts)


def _history(report: Report) -> Markup | None:
    if not report.revisions:
        return None
    parts: list[Part] = []
    if len(report.revisions) > 2:
        caption = "Grey: scenes. Blue: edges used. Amber: edges that no cycle confirms."
        parts.append(tag("div", _figure(plots.growth(report.revisions), caption), class_="plots"))
    moved = {one.after: one for one in report.moved}
    rows = [
        (
            str(row.number),
            moment(row.created_at),
            row.solver,
            f"{row.scenes:,}",
            f"{row.components:,}",
            f"{row.edges_used:,}",
            f"{row.edges_tentative:,}",
            f"{row.edges_refused:,}",
            _moves(moved.get(row.number)),
            row.note,
        )
        for row in reversed(report.revisions)
    ]
    head = (
        "revision",
        "created",
        "solver",
        "scenes",
        "components",
        "used",
        "tentative",
        "refused",
        "pose changes",
        "note",
    )
    parts.append(_folded(head, rows, (3, 4, 5, 6, 7), (9,)))
    if report.num_revisions > len(report.revisions):
        left = report.num_revisions - len(report.revisions)
        parts.append(_more(left, "earlier revisions", "gsmap list MAP revisions"))
    newest = report.moved_since or (report.moved[0] if report.moved else None)
    if newest is not None:
        parts.append(_moved_table(newest))
    return joined(parts)


def _moves(moved: PoseDifferences | None) -> str:
    if moved is None:
        return ""
    went = [row.translation_m for row in moved.rows if row.change == "moved" and row.translation_m is not None]
    new = sum(row.change == "added" for row in moved.rows)
    gone = sum(row.change == "removed" for row in moved.rows)
    parts = [f"{len(went):,} moved by up to {length(max(went))}"] if went else ["none moved"]
    parts += [f"{new:,} new"] * (new > 0) + [f"{gone:,} gone"] * (gone > 0)
    return f"{', '.join(parts)} since {moved.before}"


def _moved_table(moved: PoseDifferences) -> Markup:
    changed = [row for row in moved.rows if row.change != "same"]
    changed.sort(key=lambda row: -(row.translation_m or float("inf")))
    title = tag("h3", f"Pose changes from revision {moved.before} to {moved.after}")
    if not changed:
        return joined(title, tag("p", "No pose changed.", class_="quiet"))
    rows = [
        (row.scene_name, row.change, length(row.translation_m), angle(row.rotation_deg), row.status_after or "–")
        for row in changed[:200]
    ]
    return joined(title, _folded(("scene", "change", "translation", "rotation", "status"), rows, (2, 3)))


def _cost(report: Report) -> Markup | None:
    if not report.storage:
        return None
    stored = [(_KINDS.get(kind, kind), *figures) for kind, figures in report.storage.items()]
    total = sum(num_bytes for *_, num_bytes in stored)
    kept = [(kind, float(num_bytes), f"{kind}: {size(num_bytes)}") for kind, _, num_bytes in stored]
    rows: list[tuple[Part, ...]] = [
        (
            joined(tag("i", class_=f"swatch s{i % 8}"), kind),
            f"{num:,}",
            size(num_bytes),
            f"{100 * num_bytes / max(total, 1):.1f} %",
        )
        for i, (kind, num, num_bytes) in enumerate(stored)
    ]
    parts: list[Part] = [
        plots.stacked(kept, "Bytes by kind"),
        _table(("kind", "count", "bytes", "share"), rows, (1, 2, 3)),
    ]
    gaussians = sum(entry.row.num_gaussians for entry in report.scenes)
    if gaussians:
        own = sum(entry.num_bytes for entry in report.scenes)
        parts.append(tag("p", f"{own / gaussians:.1f} bytes per Gaussian in the arrays of the scenes.", class_="quiet"))
    if report.seconds:
        spent = sum(report.seconds.values())
        tried = sum(1 for edge in report.edges if edge.row.status != "never registered")
        words = ", ".join(f"{name} {duration(value)}" for name, value in report.seconds.items() if value > 0)
        parts.append(
            tag("p", f"Registering the {count(tried, 'pair')} took {duration(spent)}: {words}. Times of other stages "
                "are not stored.")
        )  # fmt: skip
    return joined(parts)


def _reading(report: Report) -> Markup:
    return tag(
        "dl",
        [joined(tag("dt", word), tag("dd", meaning)) for word, meaning in _GLOSSARY],
        class_="glossary",
    )


_GLOSSARY = (
    ("scene", "A capture in the map: its Gaussians and cameras in the scene frame."),
    (
        "component",
        "Scenes that edges connect. Components share no frame: their relative poses are unknown.",
    ),
    ("edge", "An accepted registration of two scenes: their relative pose with its covariance."),
    ("placed", "A scene whose pose is confirmed by a cycle of edges, a pose prior or a review."),
    (
        "tentative",
        "A scene or edge that depends on registrations that nothing else confirms. It is drawn at its most likely "
        "pose. Placed by one pair, it has nothing against it; otherwise it is in doubt: do not measure across it "
        "before a review.",
    ),
    (
        "undecided",
        "Edges that contradict each other without evidence for one of them: confirm one, reject the other, or capture "
        "the space between them.",
    ),
    (
        "chi²",
        "Squared residual of an edge in units of its standard deviations, summed over its seven degrees of freedom. "
        "About 7 is normal for an edge in many cycles; fewer than one in a thousand correct edges lies above 24.",
    ),
    (
        "sigma",
        "Standard deviation of a scene's position in the component frame, which one scene or the pose priors fix. It "
        "excludes errors that all captures share, such as a wrong metric scale.",
    ),
)


def _foot(report: Report) -> Markup:
    return tag(
        "footer",
        [tag("p", note) for note in report.notes],
        tag("p", f"Map {report.map_id[:12]}. This page has no scripts and loads nothing. Commands name the "
            f"map {report.title}, without its folder."),
    )  # fmt: skip


# --- parts -----------------------------------------------------------------------------------------------------------


def _table(
    head: Sequence[str], rows: Sequence[Sequence[Part]], numeric: Sequence[int] = (), long: Sequence[int] = ()
) -> Markup:
    """Return a table that scrolls sideways if too wide; columns in ``long`` may wrap."""
    kinds = {**dict.fromkeys(numeric, "num"), **dict.fromkeys(long, "long")}
    titles = [tag("th", name, scope="col", class_=kinds.get(k)) for k, name in enumerate(head)]
    lines = [tag("tr", [tag("td", cell, class_=kinds.get(k)) for k, cell in enumerate(row)]) for row in rows]
    return tag("div", tag("table", tag("thead", tag("tr", titles)), tag("tbody", lines)), class_="wide")


def _folded(
    head: Sequence[str], rows: Sequence[Sequence[Part]], numeric: Sequence[int] = (), long: Sequence[int] = ()
) -> Markup:
    """Return a table that shows its first rows and folds the remaining rows if there are many."""
    if len(rows) <= 2 * _FEW:
        return _table(head, rows, numeric, long)
    rest = tag("details", tag("summary", f"{len(rows) - _FEW:,} more"), _table(head, rows[_FEW:], numeric, long))
    return joined(_table(head, rows[:_FEW], numeric, long), rest)


def _more(left: int, what: str, verb: str) -> Markup:
    return tag("p", f"{left:,} more {what} are not shown: ", tag("code", verb), class_="quiet")


def _figure(drawing: Markup, caption: str) -> Markup:
    return tag("figure", drawing, tag("figcaption", caption))


SECTIONS: dict[str, tuple[str, Callable[[Report], Markup | None]]] = {
    "todo": ("Open tasks", _todo),
    "plan": ("Floor plan", _plans),
    "doubt": ("Doubtful edges", _doubt),
    "edges": ("Edges and residuals", _edges),
    "scenes": ("Scenes", _scenes),
    "changes": ("Changes", _changes),
    "things": ("Objects", _things),
    "history": ("History", _history),
    "cost": ("Storage and cost", _cost),
    "reading": ("How to read this page", _reading),
}
"""Sections by id, in order; empty sections are left out."""
