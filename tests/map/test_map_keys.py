"""What a map makes again and what it adopts: settings, dates, reviews and own measurements, on one map of one room."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap
import gsmap.map
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.types import Sim3
from gsmap.types.rows.pairs import EdgeRow
from gsmap_synthetic import DemoCapture, make_captures

PAIR = "capture_a:capture_b"
SIGMAS = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.02, 1e-4])
LANDMARKS = {"describe.objects": False}
ANOTHER_BAR = {"register.verdict.max_log_nfa": -7.0}


@pytest.fixture(scope="module", autouse=True)
def one_worker() -> Iterator[None]:
    """Jobs of a few tenths of a second do not pay for processes of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSMAP_WORKERS", "1")
        yield


@pytest.fixture(scope="module")
def captures() -> list[DemoCapture]:
    """One room walked through twice."""
    return make_captures(0, 2, steps=0, num_frames=6, num_gaussians=5_000, size_px=(80, 60), routes=[[0], [0]])


@pytest.fixture(scope="module")
def made_site(captures: list[DemoCapture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both captures, ingested from memory and placed."""
    path = tmp_path_factory.mktemp("maps") / "site.gsmap"
    with gsmap.map.create(path) as m:
        for capture in captures:
            m.ingest(capture.gaussians, cameras=capture.cameras, name=capture.name)
        m.update()
        assert [row.status for row in m.edge_rows()] == ["accepted"]
    return path


@pytest.fixture
def site(made_site: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made_site, tmp_path / "site.gsmap"))


class Watched:
    """A map, and in which stages it has computed something since it was last asked."""

    def __init__(self, site: Path) -> None:
        self._said: list[str] = []
        self.map = gsmap.map.open(site, lambda stage, fraction, text="": self._said.append(stage))

    def computed(self) -> set[str]:
        said, self._said = set(self._said), []
        return said

    def graph_keys(self) -> dict[str, str]:
        """The present graph of every scene that has one."""
        return {row.scene: row.key for row in self.map.describe()}

    def edge_key(self) -> str | None:
        (stored,) = self.map.store.registrations.current()
        return stored.key

    def todo(self) -> dict[str, int]:
        return {row.what: row.count for row in self.map.status().todo}

    def edge(self) -> EdgeRow:
        (row,) = self.map.edge_rows()
        return row


@pytest.fixture
def watched(site: Path) -> Iterator[Watched]:
    found = Watched(site)
    yield found
    found.map.close()


def contents(folder: Path) -> dict[str, str]:
    """Digest of every file of a closed map."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix not in (".sqlite-shm", ".sqlite-wal")
    }


# -- captures in memory


def test_captures_in_memory_keep_their_cameras(made_site: Path, captures: list[DemoCapture]) -> None:
    with gsmap.open(made_site) as m:
        assert [scene.name for scene in m.scenes()] == [capture.name for capture in captures]
        for capture in captures:
            gaussians, cameras = m.read(capture.name)
            stored, given = (g.means[np.lexsort(g.means.T)] for g in (gaussians, capture.gaussians))
            np.testing.assert_array_equal(stored, given)  # a store keeps them in an order of its own
            np.testing.assert_allclose(cameras.centers, capture.cameras.centers, atol=1e-9)
            assert cameras.names == capture.cameras.names


def test_bad_captures_in_memory_change_nothing(watched: Watched, captures: list[DemoCapture], tmp_path: Path) -> None:
    m, (a, b) = watched.map, captures
    holed = replace(a.gaussians, means=np.full_like(a.gaussians.means, np.nan))
    for sources, options, error in (
        ((a.gaussians, b.gaussians), {}, ConfigError),
        ((a.gaussians,), {"cameras": tmp_path / "cameras.json"}, ConfigError),
        ((tmp_path,), {"cameras": a.cameras}, ConfigError),
        ((a.gaussians,), {"captured_at": "yesterday"}, ConfigError),
        ((holed,), {}, InputError),
    ):
        with pytest.raises(error):
            m.ingest(*sources, **options)
    assert [row.new for row in m.ingest(a.gaussians, cameras=a.cameras, name="again")] == [False]
    assert len(m.scenes()) == 2


# -- settings


def test_other_settings_make_other_graphs_and_edges_and_going_back_adopts_the_first(watched: Watched) -> None:
    m = watched.map
    graphs, edge = watched.graph_keys(), watched.edge_key()
    pose = watched.edge().S_target_source.matrix()
    m.change_settings(LANDMARKS)
    assert watched.todo().items() >= {"stale_graphs": 2, "stale_edges": 1}.items()
    m.update()
    assert watched.computed() >= {"describe", "register", "optimize"}
    others = watched.graph_keys()
    assert set(others) == set(graphs)
    assert not set(others.values()) & set(graphs.values())
    assert watched.edge_key() != edge
    assert "objects" not in {layer.layer for layer in m.describe()[0].layers}
    assert not {"stale_graphs", "stale_edges", "stale_poses", "unsolved"} & set(watched.todo())
    m.change_settings(unset=list(LANDMARKS))
    assert watched.todo()["stale_edges"] == 1
    watched.computed()
    m.update()
    assert watched.computed() == {"optimize"}
    assert watched.graph_keys() == graphs
    assert watched.edge_key() == edge
    np.testing.assert_array_equal(watched.edge().S_target_source.matrix(), pose)
    assert watched.todo().keys() <= {"tentative", "one_pair"}


def test_status_distinguishes_poses_without_a_recipe_and_scenes_without_nodes(
    watched: Watched, captures: list[DemoCapture]
) -> None:
    m = watched.map
    m.store.revisions.save(m.store.revisions.get())  # as a merge does, which joins the poses of two maps
    assert "stale_poses" not in watched.todo()
    assert watched.todo()["unsolved"] == 1
    m.ingest(captures[0].gaussians[np.arange(5)], cameras=captures[0].cameras, name="bare")
    m.describe()
    assert m.store.graphs.node_counts()[m.scenes()[-1].id] == 0
    assert "unregistered" not in watched.todo()


def test_settings_of_register_leave_the_graphs(watched: Watched) -> None:
    m = watched.map
    graphs, edge = watched.graph_keys(), watched.edge_key()
    m.with_settings(ANOTHER_BAR)
    assert watched.todo().items() >= {"stale_edges": 1}.items()
    assert "stale_graphs" not in watched.todo()
    m.update()
    assert watched.computed() == {"register", "optimize"}
    assert watched.graph_keys() == graphs
    assert watched.edge_key() != edge


def test_a_stale_edge_is_made_again_though_its_pair_is_no_candidate(watched: Watched) -> None:
    m = watched.map
    m.with_settings({"retrieve.top_k": 0, "retrieve.num_neighbours": 0, **ANOTHER_BAR})
    edge = watched.edge_key()
    assert [{row.target_name, row.source_name} for row in m.register("auto")] == [{"capture_a", "capture_b"}]
    assert watched.edge_key() != edge
    assert m.register("auto") == []


def test_settings_of_optimize_make_a_revision_and_nothing_else(watched: Watched) -> None:
    m = watched.map
    m.with_settings({"optimize.gate_probability": 0.9})
    assert watched.todo()["stale_poses"] == 1
    m.update()
    assert watched.computed() == {"optimize"}
    assert [row.number for row in m.revision_rows()] == [1, 2]
    assert m.revision_rows()[-1].settings["gate_probability"] == 0.9
    m.update()
    assert watched.computed() == set()


def test_the_settings_file_is_honoured(site: Path) -> None:
    (site / "settings.toml").write_text("# ours\n[optimize]\ngate_probability = 0.9\n\n[describe]\nobjects = false\n")
    with gsmap.open(site) as m:
        assert (m.settings.optimize.gate_probability, m.settings.describe.objects) == (0.9, False)
        m.update()
        assert m.revision_rows()[-1].settings["gate_probability"] == 0.9
        assert "objects" not in {layer.layer for layer in m.describe()[0].layers}
        m.change_settings({"optimize.gate_probability": 0.8})
    assert (site / "settings.toml").read_text().startswith("# ours\n")
    with gsmap.open(site) as m:
        assert (m.settings.optimize.gate_probability, m.settings.describe.objects) == (0.8, False)


@pytest.mark.parametrize(
    ("text", "code", "match"),
    [
        ("[optimize]\ngate_probability = 'often'\n", "invalid_setting_value", r"settings\.toml: optimize\.gate_prob"),
        ("preset = 'napkin'\n", "unknown_preset", r"settings\.toml: .*'napkin'"),
        ("[optimize\n", "invalid_settings_file", r"settings\.toml"),
    ],
)
def test_a_bad_settings_file_is_refused_and_changes_nothing(site: Path, text: str, code: str, match: str) -> None:
    (site / "settings.toml").write_text(text)
    with gsmap.open(site) as m:
        for verb in (m.update, m.optimize, m.describe, m.status):
            with raises(ConfigError, code=code, match=match) as refused:
                verb()
            assert "\n" not in str(refused.value)
        assert [row.number for row in m.revision_rows()] == [1]
    assert (site / "settings.toml").read_text() == text


# -- tiles


def test_another_date_of_a_capture_makes_again_what_depends_on_dates(watched: Watched, tmp_path: Path) -> None:
    m = watched.map
    m.with_settings({"merge.mergers.tto.steps": 1})
    for merge in ("tto", "voxel"):
        assert m.export(tmp_path / merge, format="ply", tile_size_m=0, merge=merge).recomputed == 1
    assert "dirty_tiles" not in watched.todo()
    m.edit("capture_a", captured_at="2024-05-31")
    assert watched.todo()["dirty_tiles"] == 1
    assert [row.verb for row in m.status().todo if row.what == "dirty_tiles"] == [
        f"gsmap export {m.store.folder} {tmp_path / 'tto'} --format ply --tile-size 0 --merge tto"
    ]
    m.edit("capture_a", name="hall", tags=["spring"])
    assert watched.todo()["dirty_tiles"] == 1
    made = {merge: m.export(tmp_path / merge, format="ply", tile_size_m=0, merge=merge) for merge in ("tto", "voxel")}
    assert {merge: (row.recomputed, row.reused) for merge, row in made.items()} == {"tto": (1, 0), "voxel": (0, 1)}
    assert "dirty_tiles" not in watched.todo()


# -- what people say


def test_a_review_is_unsolved_until_a_new_revision_counts_it(watched: Watched) -> None:
    m = watched.map
    assert "unsolved" not in watched.todo()
    for count, (review, components) in enumerate([("reject", 2), ("confirm", 1)], 2):
        getattr(m, review)(PAIR)
        assert watched.todo()["unsolved"] == 1
        watched.computed()
        m.update()
        assert watched.computed() == {"optimize"}
        assert [row.number for row in m.revision_rows()] == list(range(1, count + 1))
        assert m.status().components == components
        assert "unsolved" not in watched.todo()
    m.confirm(PAIR, withdraw=True)
    assert watched.todo()["unsolved"] == 1
    m.update()
    assert (watched.edge().status, watched.edge().review) == ("accepted", None)
    with raises(InputError, code="nothing_to_withdraw"):
        m.confirm(PAIR, withdraw=True)
    assert "unsolved" not in watched.todo()


def test_ones_own_edge_is_used_until_it_is_withdrawn(watched: Watched) -> None:
    m = watched.map
    computed = watched.edge().S_target_source
    if watched.edge().target_name == "capture_b":
        computed = computed.inverse()
    mine = Sim3(np.eye(3), [20.0, 0.0, 0.0])
    m.add_edge(PAIR, mine, SIGMAS, note="tape measure")

    def between() -> np.ndarray:
        m.update()
        a, b = (m.pose_graph().poses[scene.id].S_map_scene for scene in m.scenes())
        return (a.inverse() @ b).matrix()

    assert watched.todo()["unsolved"] == 1
    np.testing.assert_allclose(between(), mine.matrix(), atol=1e-3)
    assert watched.edge().proposer == "manual"
    assert "stale_edges" not in watched.todo()
    m.with_settings(ANOTHER_BAR)  # what is registered anew does not outweigh what was measured
    np.testing.assert_allclose(between(), mine.matrix(), atol=1e-3)
    m.confirm(PAIR, withdraw=True)
    assert watched.todo()["unsolved"] == 1
    np.testing.assert_allclose(between(), computed.matrix(), atol=1e-3)
    for bad in (SIGMAS[:6], -SIGMAS, SIGMAS * np.nan):
        with raises(InputError, code="invalid_sigma"):
            m.add_edge(PAIR, mine, bad)
    with raises(InputError, code="invalid_pose"):
        m.add_edge(PAIR, mine.matrix(), SIGMAS)
    assert watched.edge().proposer != "manual"


def test_named_pairs_are_registered_again(watched: Watched, tmp_path: Path) -> None:
    m = watched.map
    (tmp_path / "pairs.txt").write_text("# looked alike\ncapture_b capture_a\n\ncapture_a:capture_b  # the same\n")
    assert m.register("auto") == m.register("all") == []
    for pairs in ([("capture_a", "capture_b")], tmp_path / "pairs.txt", PAIR):
        watched.computed()
        (row,) = m.register(pairs)
        assert watched.computed() == {"register"}
        assert {row.target_name, row.source_name} == {"capture_a", "capture_b"}
        assert row.status == "accepted"


@pytest.mark.parametrize(
    ("text", "error", "code", "match"),
    [
        ("capture_a capture_b\ncapture_a\n", InputError, "invalid_pairs_file", "line 2"),
        ("capture_a capture_b capture_a\n", InputError, "invalid_pairs_file", "line 1"),
        ("capture_a capture_z\n", NotFoundError, "scene_not_found", "line 1.*capture_z"),
        ("capture_a capture_a\n", ConfigError, "same_scene", "capture_a"),
        (None, NotFoundError, "file_not_found", r"pairs\.txt"),
    ],
)
def test_bad_files_of_pairs_are_refused(
    watched: Watched, tmp_path: Path, text: str | None, error: type[Exception], code: str, match: str
) -> None:
    if text is not None:
        (tmp_path / "pairs.txt").write_text(text)
    with raises(error, code=code, match=match):
        watched.map.register(tmp_path / "pairs.txt")
    assert watched.computed() == set()


# -- upkeep


def test_a_dry_run_of_prune_changes_nothing(site: Path) -> None:
    with gsmap.open(site) as m:
        m.remove("capture_b")
        m.update()
    before = contents(site)
    with gsmap.open(site) as m:
        would = m.prune(keep_revisions=1, dry_run=True)
        assert would.dry_run
        assert would.scene_names == ("capture_b",)
        assert would.num_bytes > 10_000
    assert contents(site) == before
    with gsmap.open(site) as m:
        freed = m.prune(keep_revisions=1)
        assert replace(would, dry_run=False) == freed
        assert m.prune(keep_revisions=1).scene_names == ()
        assert m.check().ok
    assert contents(site).keys() < before.keys()
