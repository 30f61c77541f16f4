"""One good map, the things around it that nothing may touch, and a way to plant something bad in a copy of it."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sqlite3
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.change import recipe_key
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.methods import RecipeKey
from gsmap.store import Store, array_archive, page_digests
from gsmap.types import (
    Cameras,
    Change,
    ChangeReport,
    Gaussians,
    NodeLayer,
    PoseGraph,
    Prior,
    Registration,
    SceneGraph,
    ScenePose,
    Sim3,
)
from gsmap.types.world import ControlPoint, ImagePoint, PositionFix, ScaleBar, WorldFrame

MAX_MEMORY = 6 << 30  # of address space beyond what is mapped already; far below what a bomb would take


def make_gaussians(seed: int, n: int = 300) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-2, 2, size=(n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), np.log(0.05)),
        np.full(n, 3.0),
        sh0_of_rgb(rng.uniform(size=(n, 3)))[:, None],
    )


def make_cameras(n: int = 2, size: tuple[int, int] = (64, 48)) -> Cameras:
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, 2, 3] = -5.0 - np.arange(n)
    return Cameras(pose, np.tile([60.0, 60, 32, 24], (n, 1)), np.tile(size, (n, 1)), tuple("ab"[:n]))


def make_world(root: Path) -> None:
    """``root/site.gsmap`` with two scenes and something of everything, ``root/tiles`` exported from it, and
    ``root/home``: the person's own folders, files and other map."""
    with Store.create(root / "site.gsmap") as store:
        a, b = (
            store.scenes.add(make_gaussians(i), make_cameras(), name=name, captured_at=f"2026-01-0{i + 1}")[0]
            for i, name in enumerate("ab")
        )
        for scene in (a, b):
            rng = np.random.default_rng(3)
            m = 4
            layer = NodeLayer(
                rng.normal(size=(m, 3)), np.ones((m, 5)), np.zeros(m), np.ones(m), rng.normal(size=(m, 2, 3)),
                np.ones((m, 3)), np.ones(m), "test",
            )  # fmt: skip
            graph = SceneGraph(scene.id, {"objects": layer}, np.array([0, 0, 1.0]))
            store.graphs.save(graph, RecipeKey("describe", "test", {}, {}, "native", (scene.id,)))
        pose, eye = Sim3.identity(), np.eye(7)
        edge = Registration(a.id, b.id, "accepted", "", pose, eye, 10, 20, 0.5, "graph:objects", True, {}, {})
        store.registrations.save(edge, RecipeKey("register", "test", {}, {}, "native", (a.id, b.id)))
        store.registrations.review("a", "b", "confirm", "seen")
        for _ in range(2):
            poses = {s.id: ScenePose(s.id, pose, 0, "placed", eye) for s in (a, b)}
            store.revisions.save(PoseGraph(poses))
        store.priors.set(Prior("a", pose, np.ones(7)))
        K = np.array([100.0, 100, 32, 24])
        store.world.add(
            [
                WorldFrame("EPSG:25832", 48.0, 11.0, 500.0),
                ControlPoint("G1", "EPSG:25832", np.array([691234.5, 5334567.125, 519.3])),
                ImagePoint("G1", "1.jpg", a.id, np.ones(2), 1.0, np.eye(4), K),
                PositionFix("2.jpg", a.id, np.zeros(3), "EPSG:4979", np.array([11.0, 48, 500]), (1.0, 1.0)),
                ScaleBar("bar", (a.id, b.id), np.arange(6.0).reshape(2, 3), (0.1, 0.1), 2.0, 0.01),
            ]
        )
        store.scenes.edit("a", note="wet floor", tags_add=["hall"])
        (root / "net.onnx").write_bytes(b"no network, but nobody runs it")
        options = {"kind": "clip", "sha256": "0" * 64, "preset": "unit", "mean": [0.0] * 3, "std": [1.0] * 3}
        store.models.add("net", root / "net.onnx", kind="clip", options=options | {"inputs": [], "outputs": []})
    with gsmap.map.open(root / "site.gsmap") as m:
        box, rows = np.array([[0.0, 0, 0], [1, 1, 1]]), np.arange(3, dtype=np.int32)
        chair = Change("moved", box, box.astype(np.float32), rows, rows, pose, confidence=0.9)
        report, key = ChangeReport((chair,), 1.0, np.ones(3), ("dark",)), recipe_key(m.settings.change).of(a.id, b.id)
        m.store.changes.save(report, key, older=a.id, newer=b.id, S_newer_older=pose, S_frame_newer=pose)
        m.confirm("c1", "seen")
        m.export(root / "tiles", format="ply", merge="union", tile_size_m=0)
    (root / "captures").mkdir()
    formats.write(root / "captures" / "c.ply", make_gaussians(5))
    home = root / "home"
    (home / "photos" / "2019").mkdir(parents=True)
    (home / "empty").mkdir()
    (home / "thesis.txt").write_bytes(b"years of work\n" * 100)
    (home / "settings.toml").write_text('preset = "paper"\n')
    for i in range(3):
        (home / "photos" / "2019" / f"{i}.jpg").write_bytes(os.urandom(2000))
    with Store.create(home / "mine.gsmap") as other:
        other.scenes.add(make_gaussians(9), make_cameras(), name="mine")


def everything_in(folder: Path) -> dict[str, tuple[object, ...]]:
    """Every path below a folder with its kind, mode, time of change, and bytes or target."""
    out: dict[str, tuple[object, ...]] = {}
    for path in [folder, *folder.rglob("*")]:
        about = path.lstat()
        content = ""
        if path.is_symlink():
            content = os.readlink(path)
        elif path.is_file():
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        out[str(path)] = (about.st_mode, about.st_mtime_ns, about.st_size if path.is_file() else 0, content)
    return out


@dataclass
class World:
    """A copy of the good map and of what is around it; ``home`` is what nothing may touch."""

    root: Path
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def map(self) -> Path:
        return self.root / "site.gsmap"

    @property
    def tiles(self) -> Path:
        return self.root / "tiles"

    @property
    def home(self) -> Path:
        return self.root / "home"

    @property
    def captures(self) -> Path:
        return self.root / "captures"

    @classmethod
    def copied(cls, good: Path, root: Path) -> World:
        shutil.copytree(good, root, dirs_exist_ok=True)
        shutil.copytree(root / "home" / "mine.gsmap", root / "into.gsmap")
        return cls(root)

    def id_of(self, name: str = "a") -> str:
        with self.sql() as connection:
            found = connection.execute("SELECT id FROM scenes WHERE name = ?", (name,)).fetchone()
        return str(found[0])

    def group(self, kind: str = "scenes") -> Path:
        """A scene's or a graph's folder."""
        with self.sql() as connection:
            table = "scenes" if kind == "scenes" else "results WHERE kind = 'graphs'"
            found = connection.execute(f"SELECT group_id FROM {table}").fetchone()
        return self.map / "arrays" / kind / str(found[0])

    def older_form(self, kind: str = "scenes") -> list[Path]:
        """Make all groups of a kind folders of a file for every key, as schema 0006 has them; their folders."""
        groups = sorted((self.map / "arrays" / kind).iterdir())
        for group in groups:
            with zipfile.ZipFile(group / array_archive.FILE) as archive:
                archive.extractall(group)
                names = archive.namelist()
            (group / array_archive.FILE).unlink()
            self.set("DELETE FROM files WHERE group_id = ?", group.name)
            for name in names:
                self.restated(group / name)
        return groups

    @contextlib.contextmanager
    def sql(self) -> Iterator[sqlite3.Connection]:
        """The catalog with every guard off."""
        connection = sqlite3.connect(self.map / "map.sqlite", isolation_level=None)
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute("PRAGMA ignore_check_constraints = ON")
        try:
            yield connection
        finally:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.close()
            page_digests.write_digests(self.map / "map.sqlite")  # a stranger has gsmap, too

    def set(self, statement: str, *values: object) -> None:
        with self.sql() as connection:
            connection.execute(statement, values)

    def loosen(self, table: str, old: str = "STRICT", new: str = "") -> None:
        """Change the text of a table's definition behind SQLite's back."""
        with self.sql() as connection:
            connection.execute("PRAGMA writable_schema = ON")
            query = "UPDATE sqlite_master SET sql = replace(sql, ?, ?) WHERE name = ?"
            assert connection.execute(query, (old, new, table)).rowcount == 1
            connection.execute("PRAGMA writable_schema = RESET")

    def replaced(self, path: Path, target: Path) -> None:
        """Put a link in the place of a file or folder."""
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        path.symlink_to(target)

    def restated(self, path: Path) -> None:
        """Have the catalog name a file of a group as it is now, so that only what it holds can give it away."""
        group, relative = path.relative_to(self.map / "arrays").parts[1], path.relative_to(self.map / "arrays")
        data = path.read_bytes()
        inside = "/".join(relative.parts[2:])
        with self.sql() as connection:
            connection.execute("DELETE FROM files WHERE group_id = ? AND path = ?", (group, inside))
            row = (group, inside, len(data), hashlib.sha256(data).hexdigest())
            connection.execute("INSERT INTO files (group_id, path, size_bytes, sha256) VALUES (?, ?, ?, ?)", row)


Plant = Callable[[World], None]


@dataclass(frozen=True)
class Case:
    """Something bad to plant, what gsmap is then asked to do, and what it must say of it.

    Args:
        verbs: lines of the command line, with MAP, TILES, HOME and CAPTURES for the places; those of `VERBS` if empty.
        says: what some verb must say (a regular expression); empty where the planted thing is harmless as it is.
        works: lines that must succeed all the same.
    """

    name: str
    plant: Plant
    says: str = ""
    verbs: tuple[str, ...] = ()
    works: tuple[str, ...] = ()


VERBS = (
    "list MAP scenes",
    "show MAP a",
    "models list MAP",
    "check MAP",
    "remove MAP b",
    "prune MAP --keep-revisions 0",
    "export MAP TILES --tile-size 0 --merge voxel",
)
ALL = (
    *VERBS,
    "list MAP edges",
    "list MAP revisions",
    "list MAP tiles",
    "status MAP",
    "poses MAP",
    "settings MAP",
    "diff MAP 1 2",
    "look MAP",
    "check MAP --json",
    "prune MAP --dry-run",
    "migrate MAP",
    "edit MAP a --note dry",
    "changes MAP",
    "show MAP c1",
    "confirm MAP c1",
    "settings MAP --set merge.method=union",
    "export MAP TILES",
)
CASES: list[Case] = []


def case(says: str = "", *, verbs: tuple[str, ...] = (), works: tuple[str, ...] = ()) -> Callable[[Plant], Plant]:
    """Adds a function that plants something to the cases."""

    def add(plant: Plant) -> Plant:
        CASES.append(Case(plant.__name__.strip("_"), plant, says, verbs, works))
        return plant

    return add
