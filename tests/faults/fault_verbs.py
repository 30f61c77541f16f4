"""What the harness runs: small captures, the maps that verbs begin from, and the verbs, as tables to add lines to."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.change import recipe_key
from gsmap.cli import app
from gsmap.types import Change, ChangeReport, Gaussians
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation
from tools.make.tiny_encoder import image_encoder

EXPORT = "export MAP OUT --format ply --merge union --tile-size 3"
EXPORT_3DTILES = EXPORT.replace("ply", "3dtiles")


@dataclass(frozen=True)
class Verb:
    """A command whose every change of the disk is met once.

    Args:
        name: how it is called in tables and on the command line of the sweep.
        base: the map it begins with, of `BASES`.
        line: its arguments. MAP, OUT and IN stand for the map, the folder of an export and that of the samples.
        done_says: what the repeated verb may say where the first run had come to its end.
        also: lines that are run first, undisturbed and unwatched.
        needs: a package without which there is no such verb.
        then: lines that must work once it has come to its end, the first time and the second.
        forgets: a text that no file below the folder holds once it has come to its end.
    """

    name: str
    base: str
    line: str
    done_says: str = ""
    also: tuple[str, ...] = ()
    needs: str = ""
    then: tuple[str, ...] = ()
    forgets: str = ""

    @property
    def possible(self) -> bool:
        here = not self.needs or importlib.util.find_spec(self.needs) is not None
        return here and self.line.split()[0] in app.verbs()


BASES = {
    "nothing": ("", ()),
    "empty": ("nothing", ("init MAP",)),
    "ingested": ("empty", ("ingest MAP IN/a.ply IN/b.ply",)),
    "described": ("ingested", ("describe MAP",)),
    "registered": ("described", ("register MAP", "edge MAP a:b --pose IN/pose.txt --sigma 1,0.1")),
    "placed": ("registered", ("optimize MAP",)),
    "exported": ("placed", (EXPORT,)),
    # Poses, a scene and with it tiles that are no longer planned.
    "moved": (
        "exported",
        ("ingest MAP IN/c.ply", "edge MAP a:b --pose IN/pose2.txt --sigma 0.1,0.01", "optimize MAP"),
    ),
    "shrunk": ("exported", ("remove MAP b", "optimize MAP")),
    "removed": ("placed", ("remove MAP b",)),
    "levelled": ("placed", (EXPORT_3DTILES,)),
    "modelled": ("placed", ("models add MAP clip IN/encoder.onnx --preset unit",)),
    # Everything that prune takes: a removed scene with its graph, revisions, an orphan, what a dead writer left.
    "littered": ("placed", ("remove MAP b", "optimize MAP", "*litter")),
    "kept": ("placed", ("backup MAP HERE/kept",)),
    "grown": ("kept", ("ingest MAP IN/c.ply",)),
    "branched": ("placed", ("branch MAP what-if", "edit MAP@what-if a --note later")),
    # One room on two days, and on the second a box is gone.
    "visited": (
        "empty",
        (
            "ingest MAP IN/then.ply --captured-at 2026-01-01 --scale known",
            "ingest MAP IN/now.ply --captured-at 2026-02-01 --scale known",
            "edge MAP then:now --pose IN/same.txt --sigma 0.1,0.001",
            "optimize MAP",
        ),
    ),
    "compared": ("visited", ("*compared",)),
    # Described and compared: what thinning has to keep beside the Gaussians.
    "seen-again": (
        "compared",
        (
            "settings MAP --set describe.landmarks=false --set describe.objects=false",
            "describe MAP",
            "settings MAP --set thin.min_seen_again=0.5 --set thin.min_fidelity_db=0",
        ),
    ),
    "two": ("placed", ("init HERE/other.gsmap", "ingest HERE/other.gsmap IN/a.ply IN/c.ply")),
    # A map that has everything: dated, thinned and superseded captures, objects with names, reviewed changes, a kept
    # photo, survey data, a branch, a tag, a backup, and an export of every kind.
    "complete": (
        "empty",
        (
            "settings MAP --set thin.min_seen_again=0.5 --set thin.min_fidelity_db=0",
            "ingest MAP IN/then.ply --captured-at 2026-01-01 --scale known",
            "ingest MAP IN/now.ply --captured-at 2026-02-01 --scale known",
            "describe MAP",
            "edge MAP then:now --pose IN/same.txt --sigma 0.1,0.001",
            "optimize MAP",
            "georeference MAP --gcp IN/gcp_list.txt --crs EPSG:32632",
            "georeference MAP --scale-bar then:0,0,0 then:4,0,0 4",
            "changes MAP",
            "*photo",
            "graph MAP HERE/graph.json",
            "edit MAP o1 --name crate --label box",
            "confirm MAP c1",
            "branch MAP what-if",
            "edit MAP@what-if then --note later",
            "tag MAP handover",
            "thin MAP --keep-days 0",
            "ingest MAP IN/again.ply --supersedes now",
            "update MAP",
            "changes MAP",
            "graph MAP HERE/graph.json",
            EXPORT,
            "export MAP HERE/small --for localize",
            "view MAP --export HERE/www",
            "report MAP HERE/report.html",
        ),
    ),
}
"""Maps by name: the one that each is made from, and the lines that make it (``*`` calls a function of this module)."""

RESTORED = ("restore HERE/kept HERE/proof.gsmap", "check HERE/proof.gsmap")

VERBS = {
    verb.name: verb
    for verb in (
        Verb("init", "nothing", "init MAP", done_says="is a map already"),
        Verb("ingest", "placed", "ingest MAP IN/c.ply"),
        Verb("ingest-two", "empty", "ingest MAP IN/a.ply IN/b.ply"),
        Verb("describe", "ingested", "describe MAP a"),
        Verb("register", "described", "register MAP"),
        Verb("optimize", "registered", "optimize MAP"),
        Verb("update", "nothing", "update MAP IN/a.ply IN/b.ply"),
        Verb("update-one", "placed", "update MAP IN/c.ply"),
        Verb("export", "placed", EXPORT),
        Verb("export-moved", "moved", EXPORT),
        Verb("export-shrunk", "shrunk", EXPORT),
        Verb("export-3dtiles", "placed", EXPORT_3DTILES),
        Verb("prune", "littered", "prune MAP --keep-revisions 1"),
        Verb("remove", "placed", "remove MAP b", done_says="no scene is called"),
        Verb("purge", "exported", "remove MAP b --purge", done_says="no scene is called", forgets="samples/b.ply"),
        Verb(
            "purge-3dtiles", "levelled", "remove MAP b --purge", done_says="no scene is called", forgets="samples/b.ply"
        ),
        Verb("restore-scene", "removed", "restore-scene MAP b", done_says="was not removed"),
        Verb("restore-from", "two", "restore-scene MAP c --from HERE/other.gsmap"),
        Verb("models-add", "placed", "models add MAP clip IN/encoder.onnx --preset unit", needs="onnx"),
        Verb("models-again", "modelled", "models add MAP clip IN/encoder2.onnx --preset unit", needs="onnx"),
        Verb("migrate", "branched", "migrate MAP"),
        Verb("confirm", "placed", "confirm MAP a:b"),
        Verb("reject", "placed", "reject MAP a:b"),
        Verb("changes", "visited", "changes MAP"),
        Verb("thin", "seen-again", "thin MAP --keep-days 0"),
        Verb("supersede", "visited", "ingest MAP IN/again.ply --supersedes now", done_says="is in the map already"),
        Verb("confirm-change", "compared", "confirm MAP c1 --note seen"),
        Verb("edge", "placed", "edge MAP a:b --pose IN/pose2.txt --sigma 1,0.1"),
        Verb("prior", "placed", "prior MAP a --anchor"),
        Verb("edit", "placed", "edit MAP a --captured-at 2024-05-31 --note wet --tag hall"),
        Verb("settings", "placed", "settings MAP --set export.max_shift_m=0.01"),
        Verb("backup", "placed", "backup MAP HERE/kept", then=RESTORED),
        Verb("backup-again", "grown", "backup MAP HERE/kept", then=RESTORED),
        Verb("backup-keep", "grown", "backup MAP HERE/kept --keep 1", then=RESTORED),
        Verb("restore", "kept", "restore HERE/kept HERE/back.gsmap", done_says="exists already"),
        Verb("clone", "placed", "clone MAP HERE/copy.gsmap", done_says="exists already"),
        Verb("branch", "placed", "branch MAP what-if", done_says="exists already"),
        Verb("branch-write", "branched", "edit MAP@what-if a --note wet --tag hall"),
        Verb("branch-delete", "branched", "branch MAP what-if --delete", done_says="no branch"),
        Verb("tag", "placed", "tag MAP handover", done_says="exists already"),
        Verb("merge", "two", "merge MAP HERE/other.gsmap"),
        Verb("split", "placed", "split MAP HERE/part.gsmap --scenes a", done_says="exists already"),
        *(
            Verb(f"complete-{name}", "complete", line, **more)
            for name, line, more in (
                ("ingest", "ingest MAP IN/b.ply", {}),
                ("update", "update MAP IN/b.ply", {}),
                ("supersede", "ingest MAP IN/later.ply --supersedes now", {"done_says": "is in the map already"}),
                ("optimize", "optimize MAP", {}),
                ("edge", "edge MAP then:now --pose IN/same.txt --sigma 0.2,0.002", {}),
                ("reject", "reject MAP then:now", {}),
                ("changes", "changes MAP", {"also": ("settings MAP --set change.min_area_m2=0.02",)}),
                ("reject-change", "reject MAP c2 --note no", {}),
                ("graph", "graph MAP HERE/graph.json", {"also": ("reject MAP c2",)}),
                ("edit-object", "edit MAP o1 --name chest", {}),
                ("bar", "georeference MAP --scale-bar now:0,0,0 now:0,3,0 3", {}),
                ("bar-remove", "georeference MAP --remove", {}),
                ("photo-remove", "remove MAP p1 --photo", {"done_says": "no photo"}),
                ("remove", "remove MAP then", {"done_says": "no scene is called"}),
                (
                    "purge",
                    "remove MAP then --purge --branches",
                    {"done_says": "no scene is called", "forgets": "samples/then.ply"},
                ),
                ("prune", "prune MAP --keep-revisions 1", {}),
                ("export-static", EXPORT + " --static", {}),
                ("small", "export MAP HERE/small2 --for localize", {"done_says": "exists"}),
                ("site", "view MAP --export HERE/www", {}),
                ("report", "report MAP HERE/report.html", {}),
                ("backup", "backup MAP HERE/kept", {"then": RESTORED}),
                (
                    "backup-keep",
                    "backup MAP HERE/kept --keep 1",
                    {"also": ("backup MAP HERE/kept", "edit MAP o1 --name chest"), "then": RESTORED},
                ),
                ("clone", "clone MAP HERE/copy.gsmap", {"done_says": "exists already"}),
                ("merge-branch", "merge MAP MAP@what-if", {}),
                ("branch-delete", "branch MAP what-if --delete", {"done_says": "no branch"}),
                ("tag", "tag MAP second", {"done_says": "exists already"}),
                ("split", "split MAP HERE/part.gsmap --scenes then", {"done_says": "exists"}),
                ("settings", "settings MAP --set export.max_shift_m=0.01", {}),
            )
        ),
    )
}
"""Verbs by name. A verb that is new is one line here."""


def words(line: str, folder: Path, samples: Path) -> list[str]:
    """The arguments of a line, in a folder that holds the map and the export."""
    places = {
        "MAP": str(folder / "site.gsmap"),
        "MAP@what-if": str(folder / "site.gsmap@what-if"),
        "OUT": str(folder / "out"),
        "IN": str(samples),
        "HERE": str(folder),
    }
    out = []
    for word in line.split():
        first, slash, rest = word.partition("/")
        out.append(places.get(first, first) + slash + rest)
    return out


# --- what bases need that no verb makes ----------------------------------------------------------------------------


def litter(site: Path) -> None:
    """What crashes leave."""
    for folder in (site / "arrays" / "scenes" / ("0" * 32), site / "arrays" / "staging" / ("1" * 32) / "means"):
        folder.mkdir(parents=True)
        (folder / "zarr.json").write_text("{}")


def compared(site: Path) -> None:
    """A change, whatever finds changes finds."""
    box, rows = np.array([[2.0, 1.2, 0], [2.6, 1.8, 1]]), np.arange(9, dtype=np.int32)
    gone = Change("disappeared", box, box.astype(np.float32), rows, rows[:0], confidence=0.75)
    with gsmap.map.open(site) as m:
        older, newer = (m.pose_graph().poses[scene.id] for scene in m.scenes())
        key = recipe_key(m.settings.change).of(older.scene, newer.scene)
        where = {"S_newer_older": newer.S_map_scene.inverse() @ older.S_map_scene, "S_frame_newer": newer.S_map_scene}
        report = ChangeReport((gone,), 0.75, np.ones(3))
        m.store.changes.save(report, key, older=older.scene, newer=newer.scene, **where)


def kept_photo(site: Path) -> None:
    """A localized photo that shows that the box is gone."""
    things = (PhotoObjectObservation(np.array([2.3, 1.5, 0.5]), "absent", 0.75),)
    with gsmap.map.open(site) as m:
        photo = LocalizedPhoto(
            digest=f"{1:064x}",
            name="photo.jpg",
            scene=m["now"].id,
            T_scene_camera=np.eye(4),
            covariance=np.eye(6) * 1e-4,
            intrinsics_px=np.array([30.0, 30, 32, 24]),
            size_px=(64, 48),
            things=things,
            captured_at="2026-02-03T12:00:00+00:00",
            probability=0.99,
        )
        m.store.photos.add(photo, b"\xff\xd8\xff\xe0 a small picture \xff\xd9")


# --- captures --------------------------------------------------------------------------------------------------------


def write_samples(folder: Path) -> None:
    """Three captures of a few hundred Gaussians, poses for ``gsmap edge``, and models where onnx is installed."""
    folder.mkdir(parents=True)
    for seed, name in enumerate("abc"):
        formats.write(folder / f"{name}.ply", capture(seed))
        (folder / f"{name}.cameras.json").write_text(json.dumps(_frames(name)))
    for name, gaussians in (
        ("then", room(True)),
        ("now", room(False)),
        ("again", room(False, opacity=4.5)),
        ("later", room(False, opacity=4.6)),
    ):
        formats.write(folder / f"{name}.ply", gaussians)
        (folder / f"{name}.cameras.json").write_text(json.dumps(_looks(name)))
    (folder / "gcp_list.txt").write_text(_control_points("now"))
    for name, x in (("pose", 5.0), ("pose2", 5.1), ("same", 0.0)):
        pose = np.eye(4)
        pose[0, 3] = x
        np.savetxt(folder / f"{name}.txt", pose)
    if importlib.util.find_spec("onnx") is not None:
        for name, window in (("encoder", 16), ("encoder2", 8)):
            (folder / f"{name}.onnx").write_bytes(image_encoder(window))


def capture(seed: int, count: int = 400) -> Gaussians:
    """Gaussians on the sides of a box of 4 x 3 x 2 m, of one texture."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    points *= [4.0, 3.0, 2.0]
    colours = np.sin(points * [3.0, 4.0, 5.0])[:, None]
    flat = np.full((count, 3), np.log(0.05))
    return Gaussians(points, np.tile([1.0, 0, 0, 0], (count, 1)), flat, np.full(count, 3.0), colours)


def room(with_box: bool, opacity: float = 5.0) -> Gaussians:
    """The same box from the inside, closed, in it one to be missed; ``opacity`` is the logit of each."""
    points, sizes = [_sides((0, 0, 0), (4, 3, 2), 0.2)], [0.09]
    if with_box:
        points.append(_sides((2, 1.2, 0), (2.6, 1.8, 1), 0.1))
        sizes.append(0.05)
    scales = np.concatenate([np.full((len(part), 3), np.log(size)) for part, size in zip(points, sizes, strict=True)])
    every = np.concatenate(points)
    count, colours = len(every), np.sin(every * [3.0, 4.0, 5.0])[:, None]
    return Gaussians(every, np.tile([1.0, 0, 0, 0], (count, 1)), scales, np.full(count, opacity), colours)


def _sides(low: tuple[float, ...], high: tuple[float, ...], step: float) -> np.ndarray:
    """(N, 3) points on the six sides of a box."""
    sides = []
    for axis in range(3):
        grid = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
        for end in (low[axis], high[axis]):
            grid[axis] = np.array([end])
            sides.append(np.stack(np.meshgrid(*grid), -1).reshape(-1, 3))
    return np.concatenate(sides)


def _looks(name: str) -> list[dict[str, object]]:
    """Cameras around the middle, which they see."""
    frames = []
    for i, (x, y) in enumerate(((0.6, 0.6), (3.4, 0.6), (3.4, 2.4), (0.6, 2.4), (2.3, 0.4), (0.5, 1.5))):
        ahead = np.array([2.3 - x, 1.5 - y, -0.4])
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead], 1)
        frames.append(
            {"id": i, "img_name": f"{name}_{i}.jpg", "width": 64, "height": 48, "position": [x, y, 1.4]}
            | {"rotation": axes.tolist(), "fx": 30.0, "fy": 30.0}
        )
    return frames


def _control_points(name: str) -> str:
    """Corners of the room as surveyed in EPSG:32632, each marked in all photos of a capture that show it."""
    lines = ["EPSG:32632"]
    for corner in np.stack(np.meshgrid([0.0, 4.0], [0.0, 3.0], [0.0, 2.0]), -1).reshape(-1, 3):
        east, north, up = corner + np.array([500000.0, 5400000.0, 100.0])
        for frame in _looks(name):
            x, y, z = (corner - frame["position"]) @ np.array(frame["rotation"])
            column, row = 30 * x / z + 32, 30 * y / z + 24
            if z > 0 and 0 < column < 64 and 0 < row < 48:
                lines.append(f"{east} {north} {up} {column:.4f} {row:.4f} {frame['img_name']}")
    return "\n".join(lines)


def _frames(name: str) -> list[dict[str, object]]:
    return [
        {"id": i, "img_name": f"{name}_{i}", "width": 32, "height": 24, "position": [2.0, 1.5, 1.0]}
        | {"rotation": [[0, 0, way], [-way, 0, 0], [0, -1, 0]], "fx": 20.0, "fy": 20.0}
        for i, way in enumerate((1, -1))
    ]


FUNCTIONS = {"*photo": kept_photo, "*litter": litter, "*compared": compared}


def copy_map(source: Path, target: Path) -> None:
    """A copy to break: files of arrays are linked, since what is in its place is never written again."""

    def copy(there: str, here: str) -> None:
        if "/arrays/" in there:
            os.link(there, here)
        else:
            shutil.copy2(there, here)

    shutil.copytree(source, target, copy_function=copy, symlinks=True, dirs_exist_ok=True)
