"""Maps as values on the command line: branches, merging, splitting, forgetting, each as a person would meet it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gsmap.map
from gsmap.map.stages import describe, register

Run = Callable[..., Any]


def names(cli: Run, map: object) -> list[str]:
    return sorted(row["name"] for row in cli("list", map, "scenes", "--json").json["scenes"])


def test_a_branch_is_a_map_wherever_one_is_given(site: Path, cli: Run, tmp_path: Path) -> None:
    made = cli("branch", site, "what-if")
    assert f"open it as {site}@what-if" in made.stderr
    assert cli("tag", site, "v1").code == 0
    branch = f"{site}@what-if"
    assert cli("edit", branch, "left", "--name", "west").code == 0
    assert cli("remove", branch, "odd:one").code == 0
    assert cli("optimize", branch).code == 0
    assert cli("settings", branch, "--set", "optimize.gate_probability=0.9").code == 0
    assert names(cli, branch) == ["right", "west"]
    assert names(cli, site) == names(cli, f"{site}@v1") == ["left", "odd:one", "right"]
    assert not (site / "settings.toml").exists()
    assert f"gsmap optimize {branch}" in str(cli("status", branch, "--json").json["todo"])
    # A folder that was exported to keeps to one map or branch.
    assert cli("export", branch, tmp_path / "out", "--tile-size", 0, "--merge", "union").code == 0
    refused = cli("export", site, tmp_path / "out", "--tile-size", 0, "--merge", "union")
    assert "another map" in refused.stderr
    rows = cli("branch", site, "--json").json["branches"]
    assert [(row["name"], row["kind"], row["num_scenes"]) for row in rows] == [("what-if", "branch", 2)]
    assert [row["name"] for row in cli("tag", site, "--list", "--json").json["tags"]] == ["v1"]
    assert cli("check", site).code == 0
    merged = cli("merge", site, branch, "--json").json
    assert merged["num_revisions"] == 1
    assert names(cli, site) == ["right", "west"]
    assert cli("branch", site, "what-if", "--delete").code == 0
    gone = cli("list", site.parent / "site.gsmap@what-if", "scenes")
    assert (gone.code, gone.stdout) == (1, "")
    assert "it has v1" in gone.stderr
    assert "is a tag: gsmap tag" in cli("branch", site, "v1", "--delete").stderr


def test_a_tag_says_what_to_do_instead(site: Path, cli: Run) -> None:
    cli("tag", site, "v1")
    for verb in (
        ["edit", f"{site}@v1", "left", "--name", "x"],
        ["settings", f"{site}@v1", "--set", "engine.workers=1"],
    ):
        refused = cli(*verb)
        assert (refused.code, refused.stdout) == (1, "")
        assert "is a tag and cannot be changed" in refused.stderr
    assert not (site / "branches" / "v1" / "settings.toml").exists()


def test_update_of_a_branch_that_is_not_there_makes_no_map(site: Path, cli: Run, captures: Path) -> None:
    refused = cli("update", f"{site}@typo", captures / "left.ply")
    assert refused.code == 1
    assert "no branch or tag 'typo'" in refused.stderr
    assert list(site.parent.glob("*@*")) == []
    for name in ("..", ".x", "a/b", "x" * 65):
        assert cli("branch", site, name).code == 2


def test_merged_parts_are_registered_across_only(
    site: Path, cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map in two halves and whole again: nothing is described, and only pairs across are tried."""
    west, rest = tmp_path / "west.gsmap", tmp_path / "rest.gsmap"
    assert cli("split", site, west, "--scenes", "left").code == 0
    assert cli("split", site, rest, "--scenes", "right", "odd:one").code == 0
    assert cli("check", west).code == cli("check", rest).code == 0
    assert names(cli, site) == ["left", "odd:one", "right"]
    cli("merge", west, rest)
    jobs: dict[str, list[Any]] = {"describe": [], "register": []}
    for stage, module in (("describe", describe), ("register", register)):

        def spied(work: Any, given: Any, *more: Any, stage: str = stage, run: Any = module.run_jobs, **how: Any) -> Any:
            given = list(given)
            jobs[stage] += given
            return run(work, given, *more, **how)

        monkeypatch.setattr(module, "run_jobs", spied)
    assert cli("update", west).code == 0
    assert jobs["describe"] == []
    left = {row["name"]: row["id"] for row in cli("list", west, "scenes", "--json").json["scenes"]}["left"]
    assert {target[0] for _, target, *_ in jobs["register"]} | {job[2][0] for job in jobs["register"]} > {left}
    assert all(left in (job[1][0], job[2][0]) for job in jobs["register"])
    poses = {row["scene_name"]: row["component"] for row in cli("poses", west, "--json").json["poses"]}
    assert poses == {"left": 0, "right": 0, "odd:one": 1}


def test_split_by_island_and_by_box(site: Path, cli: Run, tmp_path: Path) -> None:
    assert cli("split", site, tmp_path / "a", "--island", 0, "--json").json["scene_names"] == ["left", "right"]
    with gsmap.map.open(site) as m:
        pose = m.pose_graph().poses[m.store.scenes.get("right").id]
        far = pose.S_map_scene.apply(m.store.scenes.get("right").bounds.mean(0)) * 0 + 1000
    box = [*far, *(far + 1)]
    assert cli("split", site, tmp_path / "b", "--box", *box).code == 1
    assert not (tmp_path / "b").exists()
    whole = [-1000] * 3 + [1000] * 3
    assert cli("split", site, tmp_path / "c", "--box", *whole, "--json").json["scene_names"] == ["left", "right"]
    assert cli("split", site, tmp_path / "d").code == 2
    assert cli("split", site, tmp_path / "d", "--scenes").code == 2
    assert cli("split", site, tmp_path / "a", "--island", 1).code == 1


def test_a_scene_that_was_pruned_comes_from_a_tag(site: Path, cli: Run) -> None:
    cli("remove", site, "odd:one")
    assert cli("restore-scene", site, "odd:one", "--json").json["name"] == "odd:one"
    cli("tag", site, "v1")
    cli("remove", site, "odd:one")
    cli("optimize", site)
    cli("prune", site, "--keep-revisions", 1)
    refused = cli("restore-scene", site, "odd:one")
    assert refused.code == 1
    assert "--from" in refused.stderr
    assert cli("restore-scene", site, "odd:one", "--from", f"{site}@v1").code == 0
    assert names(cli, site) == ["left", "odd:one", "right"]
    assert cli("check", site).code == 0


def test_a_damaged_scene_is_mended_from_another_map(site: Path, cli: Run, tmp_path: Path) -> None:
    assert cli("split", site, tmp_path / "copy.gsmap", "--scenes", "odd:one").code == 0
    scene = cli("show", site, "odd:one", "--json").json["id"]
    files = [p for p in (site / "arrays" / "scenes" / scene).rglob("*") if p.is_file()]
    victim = max(files, key=lambda path: path.stat().st_size)
    content = victim.read_bytes()
    victim.unlink()  # the copy has the same file
    victim.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert cli("check", site).code == 1
    done = cli("restore-scene", site, "odd:one", "--from", tmp_path / "copy.gsmap")
    assert done.code == 0
    assert "odd:one is restored" in done.stderr
    assert cli("check", site).code == 0


def test_a_purge_says_where_else_it_may_live(site: Path, cli: Run) -> None:
    cli("tag", site, "v1")
    assert cli("remove", site, "odd:one", "--branches").code == 2
    done = cli("remove", site, "odd:one", "--purge")
    assert f"{site}@v1 still has the scene: gsmap remove {site} " in done.stderr
    scene = cli("remove", site, names(cli, f"{site}@v1")[0], "--purge", "--json").json["scene_id"]
    assert len(scene) == 32
    done = cli("remove", site, "odd:one", "--purge", "--branches", "--json")
    assert done.json["maps"] == [f"{site}@v1"]
    assert names(cli, f"{site}@v1") == ["left", "right"]
