"""Every verb, as a table and as JSON, on one small map."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from cli_rooms import save_changes
from PIL import Image

import gsmap
import gsmap.map
import gsmap_synthetic
from gsmap import formats
from gsmap.cli.app import build, outputs
from gsmap.store import trust
from gsmap.types.localized_photo import LocalizedPhoto
from tools.make.tiny_encoder import image_encoder

Run = Callable[..., Any]


def verbs(command: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """The verbs of the program, by walking its tree of commands, so that none can be forgotten."""
    command = command or typer.main.get_command(build())
    for name, inner in getattr(command, "commands", {}).items():
        if hasattr(inner, "commands"):
            yield from verbs(inner, (*path, name))
        else:
            yield " ".join((*path, name)), inner


VERBS = dict(verbs())

# What is run for each verb (or each of its forms, as `OUTPUTS` of its file names them). MAP is a copy of the small map,
# SITE that map itself.
RUNS = {
    "init": "init TMP/new.gsmap",
    "ingest": "ingest MAP CAPTURES/left.ply --scale known",
    "describe": "describe MAP left",
    "register": "register MAP --pairs left:right",
    "optimize": "optimize MAP",
    "update": "update MAP",
    "status": "status MAP",
    "confirm": "confirm MAP left:right --note seen",
    "reject": "reject MAP left:right --note mirrored",
    "confirm CHANGE": "confirm MAP c1 --note seen",
    "reject CHANGE": "reject MAP c1 --note shadow",
    "edge": "edge MAP left:right --pose TMP/pose.txt --sigma 0.5,0.02 --note tape",
    "prior": "prior MAP left --anchor",
    "changes": "changes MAP",
    "graph": "graph MAP",
    "history": "history MAP 0.5,0.5,0.5",
    "find": "find MAP --like left:0",
    "localize": "localize MAP TMP/photo.png --focal auto",
    "edit OBJECT": "edit MAP o1 --name sofa --label seat",
    "edit": "edit MAP left --captured-at 2024-05-31 --note wet --tag hall",
    "export --for": "export MAP TMP/small --for localize --budget 50MB",
    "export": "export MAP TMP/out --tile-size 0 --merge voxel",
    "list scenes": "list MAP scenes",
    "list edges": "list MAP edges",
    "list revisions": "list MAP revisions",
    "list tiles": "list MAP tiles",
    "list photos": "list MAP photos",
    "show SCENE": "show MAP left",
    "show A:B": "show MAP left:right",
    "show CHANGE": "show MAP c1",
    "show OBJECT": "show MAP o1",
    "why A:B": "why MAP left:right --pictures TMP/why",
    "report": "report MAP TMP/report.html --since 2024-05-31",
    "diff": "diff MAP 1 2",
    "poses": "poses MAP",
    "georeference": "georeference MAP --scale-bar left:0,0,0 left:1,0,0 1.02",
    "measure": "measure MAP left:0,0,0 right:1,0,0",
    "settings": "settings MAP",
    "convert": "convert CAPTURES/left.ply TMP/left.spz",
    "clean": "clean CAPTURES/left.ply TMP/left.ply",
    "models add": "models add MAP clip TMP/encoder.onnx --preset unit",
    "models list": "models list MAP",
    "evaluate": "evaluate MAP --truth CAPTURES/truth",
    "branch": "branch MAP what-if",
    "tag": "tag MAP v1",
    "merge": "merge MAP SITE",
    "split": "split MAP TMP/part.gsmap --island 0",
    "remove": "remove MAP odd:one",
    "remove --purge": "remove MAP odd:one --purge",
    "remove --photo": "remove MAP photo.jpg --photo",
    "restore-scene": "restore-scene MAP left --from SITE",
    "check": "check MAP",
    "prune": "prune MAP --dry-run",
    "thin": "thin MAP --keep-days 365 --dry-run",
    "migrate": "migrate MAP",
    "backup": "backup MAP TMP/backup --verify --keep 1",
    "backup --list": "backup MAP TMP/saved --list",
    "restore": "restore TMP/saved TMP/restored.gsmap",
    "clone": "clone MAP TMP/clone.gsmap",
    "trust": "trust TMP/remote.gsmap --yes",
    "view": "view MAP --no-browser",
    "demo": "demo TMP/demo",
}
SILENT = {
    *("init", "prior", "convert", "models add", "branch", "tag", "remove", "check", "migrate", "view", "report"),
    *("backup", "restore", "clone", "remove --photo"),
}
"""Verbs whose table mode writes nothing on stdout: they have nothing to show, and say on stderr what they did."""


def save_photo(site: Path) -> None:
    """Keep a photograph of the scene `left`, as localising one does."""
    with gsmap.map.open(site) as m:
        sighting = LocalizedPhoto(
            digest="1" * 64,
            name="photo.jpg",
            captured_at=None,
            scene=m.store.scenes.get("left").id,
            T_scene_camera=np.eye(4),
            covariance=np.eye(6),
            intrinsics_px=np.array([100.0, 100, 80, 60]),
            size_px=(160, 120),
            probability=0.99,
        )
        m.store.photos.add(sighting, b"\xff\xd8\xff\xe0")


@pytest.fixture
def gsmap_run(
    cli: Run, site: Path, made_site: Path, captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], Any]:
    """Runs a line of `RUNS`."""
    np.savetxt(tmp_path / "pose.txt", np.eye(4))
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "photo.png")
    (tmp_path / "encoder.onnx").write_bytes(image_encoder())
    (tmp_path / "remote.gsmap" / "arrays").mkdir(parents=True)
    trust.write(tmp_path / "remote.gsmap", "postgresql+psycopg://me@example.org/site", "0" * 32)
    monkeypatch.setattr("gsmap.view.ViewServer.serve_forever", lambda self: None)
    # The demo's own captures take a minute: what it does with them is what is tried here.
    monkeypatch.setattr(gsmap_synthetic, "make_captures", lambda seed, progress: [])
    monkeypatch.setattr(gsmap_synthetic, "write_captures", lambda folder, made: _link_captures(captures, folder))

    def call(line: str) -> Any:
        if "c1" in line.split() or "changes" in line.split():
            save_changes(site)
        if "--photo" in line or "photos" in line:
            save_photo(site)
        if "TMP/saved" in line:
            with gsmap.map.open(site) as m:
                m.backup(tmp_path / "saved")
        places = {"MAP": site, "SITE": made_site, "TMP": tmp_path, "CAPTURES": captures}
        words = []
        for word in line.split():
            first, slash, rest = word.partition("/")
            words.append(f"{places[first]}{slash}{rest}" if first in places else word)
        return cli(*words)

    return call


def _link_captures(captures: Path, folder: Path) -> None:
    (folder / "truth").mkdir(parents=True)
    for path in [*captures.glob("left*"), *captures.glob("truth/left*")]:
        (folder / path.relative_to(captures)).symlink_to(path)


def test_no_verb_is_forgotten() -> None:
    assert set(RUNS) == set(outputs())
    run = {line.split()[0] + (f" {line.split()[1]}" if line.startswith("models") else "") for line in RUNS.values()}
    assert run == set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_takes_json_and_explains_itself(verb: str, cli: Run) -> None:
    options = {option for parameter in VERBS[verb].params for option in parameter.opts}
    assert "--json" in options
    short = cli(*verb.split(), "-h")
    assert short.code == 0
    assert f"gsmap {verb.split()[0]}" in short.stdout.split("Example:")[1]


@pytest.mark.parametrize("verb", RUNS)
def test_every_verb_prints_a_table(verb: str, gsmap_run: Callable[[str], Any]) -> None:
    done = gsmap_run(RUNS[verb])
    assert done.code == 0, done.stderr
    assert (done.stdout == "") == (verb in SILENT), done.stdout
    assert done.stdout or done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("verb", RUNS)
def test_every_verb_prints_its_object_as_json(verb: str, gsmap_run: Callable[[str], Any]) -> None:
    done = gsmap_run(RUNS[verb] + " --json")
    assert done.code == 0, done.stderr
    data = done.json
    assert next(iter(data)) == "schema"
    assert data["schema"] == 2
    output = outputs()[verb]
    names = [field.name for field in fields(output.row_type)]
    if output.key:
        assert list(data) == ["schema", output.key]
        rows = data[output.key] if output.is_list else [data[output.key]]
        assert rows or verb == "models list"
        assert [list(row) for row in rows] == [names] * len(rows)
    else:
        assert list(data) == ["schema", *names]


def test_the_contract_of_scenes_and_edges_stands(site: Path, cli: Run) -> None:
    scenes = {row["name"]: row for row in cli("list", site, "scenes", "--json").json["scenes"]}
    assert list(scenes["left"])[:13] == [
        "id",
        "name",
        "num_gaussians",
        "sh_degree",
        "num_cameras",
        "bounds",
        "scale_policy",
        "captured_at",
        "ingested_at",
        "world",
        "crs",
        "heights",
        "offset",
    ]
    assert np.shape(scenes["left"]["S_map_scene"]) == (4, 4)
    assert scenes["left"]["component"] == scenes["right"]["component"] != scenes["odd:one"]["component"]
    edges = cli("list", site, "edges", "--json").json["edges"]
    by_pair = {frozenset((row["target_name"], row["source_name"])): row for row in edges}
    good, bad = by_pair[frozenset(("left", "right"))], by_pair[frozenset(("left", "odd:one"))]
    assert {good["target"], good["source"]} == {scenes["left"]["id"], scenes["right"]["id"]}
    assert np.shape(good["S_target_source"]) == (4, 4)
    assert np.shape(good["information"]) == (7, 7)
    assert (good["status"], good["used"]) == ("accepted", "tentative")
    assert set(good["seconds"]) == {"match", "refine", "verdict"}
    assert (bad["status"], bad["used"], bad["S_target_source"]) == ("no_match", False, None)
    assert bad["reason"]


def test_diff_shows_what_moved(site: Path, cli: Run) -> None:
    cli("prior", site, "left", "--position", 5, 6, 7, "--sigma", 0.01)
    cli("optimize", site)
    shown = cli("diff", site, 2, 3)
    assert shown.code == 0, shown.stderr
    rows = {row["scene_name"]: row for row in cli("diff", site, 2, 3, "--json").json["scenes"]}
    assert rows["left"]["change"] == "moved"
    assert rows["left"]["translation_m"] > 1
    assert rows["left"]["scale_ratio"] == pytest.approx(1)
    assert rows["odd:one"]["change"] == "same"
    cli("remove", site, "odd:one")
    cli("optimize", site)
    gone = {row["scene_name"]: row for row in cli("diff", site, 3, 4, "--json").json["scenes"]}["odd:one"]
    assert (gone["change"], gone["rotation_deg"], gone["component_after"]) == ("removed", None, None)
    assert "removed" in cli("diff", site, 3, 4).stdout


def test_show_fits_a_screen_and_takes_names_with_colons(site: Path, cli: Run) -> None:
    shown = cli("show", site, "left")
    assert len(shown.stdout.splitlines()) <= 40
    assert "landmarks" in shown.stdout
    with_nodes = cli("show", site, "left", "--nodes")
    assert len(with_nodes.stdout.splitlines()) > 100
    assert cli("show", site, "odd:one", "--json").json["name"] == "odd:one"
    pair = cli("show", site, "left:odd:one", "--json").json
    assert {pair["target_name"], pair["source_name"]} == {"left", "odd:one"}
    lost = cli("show", site, "left:nobody")
    assert lost.code == 1
    assert "left:nobody" in lost.stderr


def test_lists_are_filtered(site: Path, cli: Run) -> None:
    def names(*options: object) -> list[str]:
        return [row["name"] for row in cli("list", site, "scenes", "--json", *options).json["scenes"]]

    cli("edit", site, "left", "--tag", "hall", "--captured-at", "2024-05-31")
    cli("edit", site, "right", "--tag", "hall", "--captured-at", "2024-06-30")
    assert names("--tag", "hall") == ["left", "right"]
    assert names("--component", 1) == names("--island", 1) == ["odd:one"]
    assert names("--status", "isolated") == ["odd:one"]
    assert names("--after", "2024-06-01", "--tag", "hall") == ["right"]
    assert names("--after", "2999-01-01") == []
    edges = cli("list", site, "edges", "--json", "--tag", "hall").json["edges"]
    assert [{row["target_name"], row["source_name"]} for row in edges] == [{"left", "right"}]
    assert len(cli("list", site, "edges", "--json", "--status", "no_match").json["edges"]) == 2
    assert len(cli("list", site, "revisions", "--json", "--after", "2000-01-01").json["revisions"]) == 2
    assert len(cli("list", site, "tiles", "--json", "--component", 0).json["tiles"]) == 1
    assert cli("list", site, "scenes", "--status", "nice").code == 2
    assert cli("list", site, "scenes", "--after", "yesterday").code == 2
    assert cli("list", site, "tiles", "--tag", "hall").code == 2
    untagged = cli("edit", site, "left", "--untag", "hall", "--name", "west", "--json").json
    assert (untagged["name"], untagged["tags"], untagged["captured_at"][:10]) == ("west", [], "2024-05-31")
    history = cli("show", site, "west", "--json").json["history"]
    assert [row["value"] for row in history if row["fact"] == "name"] == ["left", "west"]


def test_reviews_count_and_can_be_withdrawn(site: Path, cli: Run) -> None:
    rejected = cli("reject", site, "left:right", "--note", "mirrored", "--json").json
    assert (rejected["status"], rejected["review"]) == ("rejected", "reject")
    assert "unsolved" in {row["what"] for row in cli("status", site, "--json").json["todo"]}
    cli("optimize", site)
    assert cli("status", site, "--json").json["components"] == 3
    taken_back = cli("reject", site, "left:right", "--withdraw", "--json").json
    assert (taken_back["status"], taken_back["review"]) == ("accepted", None)
    assert cli("confirm", site, "left:right", "--json").json["review"] == "confirm"
    cli("optimize", site)
    status = cli("status", site, "--json").json
    assert (status["components"], status["islands"]) == (2, 2)
    events = [row["what"] for row in cli("show", site, "left:right", "--json").json["history"]]
    assert events == ["accepted", "reject", "withdraw", "confirm"]


def test_evaluate_says_plainly_that_a_map_failed(site: Path, captures: Path, cli: Run) -> None:
    truth = ("--truth", captures / "truth")
    good = cli("evaluate", site, *truth)
    assert "placed, 2 tentative, ATE 0.0" in good.stdout
    assert "0 of 1 false, beyond 1 deg or 0.05 m" in good.stdout
    assert "1 of 1 false, beyond 1 deg or 1e-09 m: left:right" in " ".join(
        cli("evaluate", site, *truth, "--max-rte", 1e-9).stdout.split()
    )
    cli("reject", site, "left:right")
    cli("optimize", site)
    failed = cli("evaluate", site, *truth)
    assert failed.code == 0
    assert "0 of 3 placed, no ATE: no two scenes are connected by edges" in failed.stdout
    report = cli("evaluate", site, *truth, "--json").json
    assert (report["num_scenes"], report["num_placed"], report["ate_m"], report["edges"]) == (3, 0, None, [])
    for option in ("--tiles", "--lpips"):
        refused = cli("evaluate", site, *truth, option, site)
        assert (refused.code, refused.stdout) == (2, "")
        assert f"{option} needs --images DIR" in refused.stderr


def test_a_point_may_begin_with_a_minus(site: Path, cli: Run) -> None:
    """What is no option is an argument of the verbs that take points; a wrong option is still refused."""
    assert cli("measure", site, "-1,0,0", "-1,2.5,0", "--component", 0, "--json").json["distance_m"] > 0
    assert cli("history", site, "-0.5,0.5,0.5").code == 0
    assert cli("measure", site, "-1,0,0", "1,0,0", "--wrong").code == 2


def test_a_measurement_of_ones_own_places_a_scene(site: Path, cli: Run, tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [20, 0, 0]
    (tmp_path / "pose.json").write_text(json.dumps(pose.tolist()))
    line = ["edge", site, "left:odd:one", "--pose", tmp_path / "pose.json", "--sigma", "0.5,0.02"]
    row = cli(*line, "--json").json
    assert (row["status"], row["proposer"]) == ("accepted", "manual")
    sigmas = np.sqrt(np.diag(np.linalg.inv(row["information"])))
    np.testing.assert_allclose(sigmas, [np.radians(0.5)] * 3 + [0.02] * 3 + [1e-5], rtol=1e-6)
    cli("optimize", site)
    poses = {row["scene_name"]: row for row in cli("poses", site, "--json").json["poses"]}
    assert {row["component"] for row in poses.values()} == {0}
    found = np.linalg.inv(poses["left"]["S_map_scene"]) @ poses["odd:one"]["S_map_scene"]
    np.testing.assert_allclose(found, pose, atol=1e-3)
    for bad in ("0.5", "0.5,-1", "a,b", "1,2,3,4"):
        assert cli(*line[:-1], bad).code == 2
    (tmp_path / "pose.json").write_text("[1, 2]")
    assert cli(*line).code == 1
    scaled = tmp_path / "scaled.txt"
    np.savetxt(scaled, np.diag([2.0, 2, 2, 1]))
    assert cli("edge", site, "left:odd:one", "--pose", scaled, "--sigma", "1,1").code == 2


def test_settings_are_shown_changed_and_refused(site: Path, cli: Run) -> None:
    rows = {row["name"]: row for row in cli("settings", site, "--json").json["settings"]}
    assert all(row["doc"] for row in rows.values())
    name = "optimize.gate_probability"
    assert rows[name]["value"] == rows[name]["default"]
    changed = cli("settings", site, "--set", f"{name}=0.9", "--json").json["settings"]
    assert {row["name"]: row["value"] for row in changed}[name] == 0.9
    assert "stale_poses" in {row["what"] for row in cli("status", site, "--json").json["todo"]}
    cli("settings", site, "--unset", name)
    assert cli("settings", site, "--json").json["settings"] == list(rows.values())
    for verb in (["settings", site], ["describe", site], ["register", site], ["optimize", site], ["update", site]):
        wrong = cli(*verb, "--set", "optimize.gate_probabilty=0.9")
        assert (wrong.code, wrong.stdout) == (2, "")
        assert name in wrong.stderr
    assert cli("export", site, site.parent / "o", "--preset", "napkin").code == 2
    assert cli("settings", site, "--set", name).code == 2
    assert cli("settings", site, "--set", f"{name}=often").code == 2


def test_settings_of_one_run_are_not_kept(site: Path, cli: Run) -> None:
    def revisions() -> int:
        return len(cli("list", site, "revisions", "--json").json["revisions"])

    before = revisions()
    cli("update", site)
    assert revisions() == before
    cli("update", site, "--set", "optimize.gate_probability=0.9")
    assert revisions() == before + 1
    assert not (site / "settings.toml").exists()


def test_pairs_from_a_file(site: Path, cli: Run, tmp_path: Path) -> None:
    (tmp_path / "pairs.txt").write_text("# checked by hand\nleft right\n\nright odd:one\n")
    rows = cli("register", site, "--pairs", tmp_path / "pairs.txt", "--json").json["edges"]
    assert [{row["target_name"], row["source_name"]} for row in rows] == [{"left", "right"}, {"right", "odd:one"}]
    assert cli("register", site, "--pairs", tmp_path / "none.txt").code == 1


@pytest.mark.parametrize("format", ["tum", "g2o", "colmap", "nerfstudio", "json"])
def test_poses_for_other_programs(site: Path, cli: Run, tmp_path: Path, format: str) -> None:
    done = cli("poses", site, tmp_path / "poses.out", "--format", format)
    assert (done.code, done.stdout) == (0, ""), done.stderr
    assert list(tmp_path.glob("poses*"))
    assert cli("poses", site, "--format", format).code == 2


def test_prune_says_what_it_would_do(site: Path, cli: Run) -> None:
    cli("remove", site, "odd:one")
    cli("optimize", site)
    line = ["prune", site, "--keep-revisions", 1, "--json"]
    planned = cli(*line, "--dry-run").json
    assert planned["dry_run"] is True
    assert planned["scene_names"] == ["odd:one"]
    assert planned["num_bytes"] > 10_000
    done = cli(*line).json
    assert done["dry_run"] is False
    assert done["scene_names"] == ["odd:one"]
    assert cli(*line).json["scene_names"] == []


def test_check_exits_with_1_and_names_what_is_damaged(made_site: Path, site: Path, cli: Run) -> None:
    victim = next(path for path in sorted((site / "arrays" / "scenes").rglob("*.zip")) if path.is_file())
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.unlink()  # it is a link to that of the map which the other tests share
    victim.write_bytes(data)
    assert cli("check", site).code == 1
    done = cli("check", site, "--json")
    assert done.code == 1
    assert done.json["ok"] is False
    assert len(done.json["problems"]) >= 1
    assert cli("check", made_site).code == 0


def test_quiet_and_verbose(site: Path, cli: Run, captures: Path) -> None:
    again = ["ingest", site, captures / "left.ply", "--scale", "known"]
    assert "left" in cli(*again).stderr
    assert cli("-q", *again).stderr == ""
    assert cli("-q", "list", site, "tiles", "--tag", "x").stderr.count("\n") == 1
    assert "INFO gsmap." in cli("-v", *again).stderr
    assert "INFO gsmap." not in cli(*again).stderr


def test_python_and_the_command_line_say_the_same(site: Path, cli: Run) -> None:
    with gsmap.open(site) as m:
        rows = m.scene_rows()
        assert rows == m.scene_rows()
        assert [row.to_json() for row in rows] == cli("list", site, "scenes", "--json").json["scenes"]


def test_a_converted_file_holds_what_the_json_says(cli: Run, captures: Path, tmp_path: Path) -> None:
    said = cli("convert", captures / "left.ply", tmp_path / "left.spz", "--json").json
    assert len(formats.read(tmp_path / "left.spz")) == said["num_gaussians"] > 1000


@pytest.mark.parametrize("verb", ["convert", "clean"])
def test_a_rewritten_file_keeps_its_mark_or_the_loss_is_noted(
    cli: Run, captures: Path, tmp_path: Path, verb: str
) -> None:
    gaussians = formats.read(captures / "left.ply")
    formats.write(tmp_path / "a.ply", gaussians, antialiased=True, extra={"filter_3D": np.zeros(len(gaussians))})
    for target, is_noted in (("a.spz", False), ("b.ply", False), ("b.sog", False), ("b.splat", True)):
        done = cli(verb, tmp_path / "a.ply", tmp_path / target)
        assert "filter of Mip-Splatting" in done.stderr  # what reading changed
        assert formats.info(tmp_path / target).antialiased != is_noted
        assert ("antialias" in done.stderr) == is_noted
        assert done.stderr.count("\n") == 2 + is_noted
