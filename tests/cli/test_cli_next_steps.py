"""What wants a person: ``update`` names it with the command that settles it, and lists are filtered by its words."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gsmap.map
from gsmap.types import Sim3

Run = Callable[..., Any]


def next_steps(stdout: str) -> list[list[str]]:
    """The commands that the closing lines of ``update`` name."""
    lines = [line for line in stdout.splitlines() if line.startswith("next: ")]
    assert stdout.splitlines()[len(stdout.splitlines()) - len(lines) :] == lines  # they come last
    return [shlex.split(line.partition("): gsmap ")[2]) for line in lines]


def pairs(cli: Run, site: Path, status: str) -> list[set[str]]:
    """The pairs of the edges that a filter lets through, by name."""
    rows = cli("list", site, "edges", "--status", status, "--json").json["edges"]
    return [{row["target_name"], row["source_name"]} for row in rows]


def test_update_ends_with_commands_that_run(site: Path, cli: Run) -> None:
    steps = next_steps(cli("update", site).stdout)
    assert [step[0] for step in steps] == ["why", "list"]
    assert set(steps[0][2].split(":")) == {"left", "right"}
    for step in steps:
        done = cli(*step)
        assert done.code == 0, done.stderr
    assert f"confirm or reject MAP {steps[0][2]}" in " ".join(cli(*steps[0], "--json").json["advice"].split())
    assert cli("update", site, "--json").json["schema"] == 2  # and nothing after it


def test_edges_are_filtered_by_the_words_that_their_table_shows(site: Path, cli: Run) -> None:
    assert "one pair" in cli("list", site, "edges").stdout
    assert pairs(cli, site, "one pair") == pairs(cli, site, "one-pair") == [{"left", "right"}]
    assert pairs(cli, site, "tentative") == [{"left", "right"}]  # the word of JSON
    assert pairs(cli, site, "accepted") == [{"left", "right"}]
    assert pairs(cli, site, "used") == pairs(cli, site, "undecided") == pairs(cli, site, "unused") == []
    scenes = cli("list", site, "scenes", "--status", "one-pair", "--json").json["scenes"]
    assert {row["name"] for row in scenes} == {"left", "right"}
    assert all(row["one_pair"] and row["status"] == "tentative" for row in scenes)
    assert "2 placed by one pair, 0 in doubt" in cli("status", site).stdout
    refused = cli("list", site, "edges", "--status", "nice")
    assert refused.code == 2
    assert "tentative" in refused.stderr


def test_a_confirmed_pair_is_no_longer_tentative(site: Path, cli: Run) -> None:
    assert "one pair" not in cli("confirm", site, "left:right").stdout
    assert cli("list", site, "edges", "--status", "unsolved", "--json").json["edges"][0]["used"] is True
    assert pairs(cli, site, "tentative") == []
    assert "one pair" in cli("confirm", site, "left:right", "--withdraw").stdout
    assert pairs(cli, site, "tentative") == [{"left", "right"}]
    cli("confirm", site, "left:right")
    assert [step[0] for step in next_steps(cli("update", site).stdout)] == ["list"]  # the scene that is alone
    assert pairs(cli, site, "used") == [{"left", "right"}]


def test_confirming_what_optimize_did_not_use_does_not_say_that_it_did(site: Path, cli: Run) -> None:
    with gsmap.map.open(site) as m:
        m.add_edge("left:odd:one", Sim3(np.eye(3), np.array([9.0, 0, 0])), np.full(7, 0.01))
        assert m.confirm("left:odd:one").used is False


def test_several_pairs_are_judged_on_the_page(site: Path) -> None:
    with gsmap.map.open(site) as m:
        m.add_edge("left:odd:one", Sim3(np.eye(3), np.array([9.0, 0, 0])), np.full(7, 0.01))
        m.optimize()
        (row,) = [row for row in m.status().todo if row.what == "one_pair"]
    assert shlex.split(row.verb)[:2] == ["gsmap", "view"]


def test_an_edge_reviewed_since_the_last_optimize_is_unsolved(site: Path, cli: Run) -> None:
    def uses() -> list[str]:
        with gsmap.map.open(site) as m:
            (shown,) = (row.use for row in m.show_scene("left").edges if row.scene_name == "right")
            assert m.show_pair("left:right").use == shown
            return [row.use for row in m.edge_rows() if row.pair == "left:right"]

    assert uses() == ["one pair"]
    assert "unsolved" in cli("reject", site, "left:right").stdout
    assert uses() == ["unsolved"]
    assert pairs(cli, site, "unsolved") == [{"left", "right"}]
    assert pairs(cli, site, "tentative") == []
    page = site.with_name("report.html")
    cli("report", site, page)
    assert "tag unsolved" in page.read_text()
    assert "unsolved" not in cli("reject", site, "left:right", "--withdraw").stdout  # as it was solved
    cli("reject", site, "left:right")
    cli("optimize", site)
    assert uses() == [""]
    cli("reject", site, "left:right", "--withdraw")
    assert uses() == ["unsolved"]
    cli("optimize", site)
    assert uses() == ["one pair"]
    with gsmap.map.open(site) as m:
        assert m.add_edge("left:right", Sim3(np.eye(3), np.array([9.0, 0, 0])), np.full(7, 0.01)).use == "unsolved"
