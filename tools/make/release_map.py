"""Write the small map that a release commits: every later gsmap opens, migrates, checks and exports it.

    python -m tools.make.release_map [tests/store/releases/VERSION.tar.xz]

The installed gsmap writes it, through its Python interface and its store. In it: four tiny scenes, one of them removed;
a graph of each; edges that were accepted, refused, measured by hand, confirmed, rejected, and adopted again; a prior
and an up direction; facts with their history; a model; settings; revisions, one of them dropped; an export; changes
with a word on one, one comparison of a pair superseded by another, a tag and a branch.
"""

from __future__ import annotations

import os
import sys
import tarfile
import tempfile
from io import BytesIO
from itertools import combinations
from pathlib import Path
from unittest import mock

import numpy as np
from PIL import Image

import gsmap.map
from gsmap.map import Map
from gsmap.map.stages.describe import graph_keys
from gsmap.register import recipe_key, view_cache
from gsmap.types import Cameras, Gaussians, Prior, Registration, Sim3
from gsmap.version import __version__
from tools.harness import argument_parser
from tools.make.tiny_encoder import image_encoder

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("hall", "stairs", "attic", "shed")
LIMIT_KB = 200


def main() -> int:
    parser = argument_parser(__doc__)
    default = ROOT / "tests" / "store" / "releases" / f"{__version__}.tar.xz"
    parser.add_argument("out", type=Path, nargs="?", default=default)
    out = parser.parse_args().out.absolute()
    os.environ["GSMAP_WORKERS"] = "1"  # this process alone: a patch below does not reach others
    with tempfile.TemporaryDirectory(prefix="release_") as folder:
        os.chdir(folder)
        write(Path("release.gsmap"))
        pack(Path("release.gsmap"), out)
    size = out.stat().st_size / 1e3
    print(f"{out.name}: {size:.0f} kB, written by gsmap {__version__}")
    return 0 if size < LIMIT_KB else 1


def write(path: Path) -> None:
    with gsmap.map.create(path) as m:
        m.change_settings({"merge.mergers.tto.steps": 2, "register.fallback": "never"})
        Path("encoder.onnx").write_bytes(image_encoder())
        m.add_model("clip", "encoder.onnx", preset="unit")
        for k, name in enumerate(NAMES):
            gaussians, cameras = room(k)
            dated = f"2026-01-0{k + 1}T03:04:05Z"
            m.ingest(gaussians, cameras=cameras, name=name, captured_at=dated, scale="known")
        m.edit("hall", note="scanned in the morning", tags=["ground floor", "north"])
        m.edit("attic", metres_per_unit=1.02)
        m.edit("stairs", name="stairwell", captured_at="2026-01-02T03:05:00Z")
        with mock.patch.object(view_cache, "_MIN_OWN_SHARE", 0.0):  # views of own cameras alone, which are small
            m.describe()
        register(m)
        m.optimize()
        m.export("tiles", tile_size_m=0, merge="voxel")
        m.set_prior(Prior("hall", Sim3.identity(), np.array([0.01] * 3 + [0.02] * 3 + [np.inf])))
        m.set_prior(Prior("stairwell", Sim3.identity(), np.full(7, np.inf), np.array([0.0, 0, 1]), 0.02))
        m.optimize()
        m.confirm("hall:stairwell", "looked at it")
        m.reject("stairwell:attic", "another door")
        m.reject("hall:attic", "in doubt")
        m.reject("hall:attic", withdraw=True)
        m.add_edge("hall:shed", Sim3(np.eye(3), np.array([4.0, 0, 0])), np.full(7, 0.05), "tape measure")
        m.optimize()
        compare(m)
        keep_photo(m)
        keep_objects(m)
        m.remove("shed")
        m.optimize()
        m.prune(keep_revisions=3)
        m.tag("handed-over")
        m.branch("what-if")


def room(seed: int, n: int = 250) -> tuple[Gaussians, Cameras]:
    """The walls of a box of 4 m, and cameras in the middle of it. Numbers of few digits pack well."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-2, 2, (n, 3))
    side = rng.integers(0, 3, n)
    means[np.arange(n), side] = rng.choice([-2.0, 2.0], n)
    gaussians = Gaussians(
        means.round(2),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), -2.0),
        np.full(n, 2.0),
        rng.normal(0, 0.5, (n, 1, 3)).round(1),
    )
    turns = np.arange(4) * np.pi / 2
    poses = np.tile(np.eye(4), (4, 1, 1))
    # x to the right, y down, z ahead; the world's z is up.
    poses[:, :3, 0] = np.c_[np.sin(turns), -np.cos(turns), 0 * turns]
    poses[:, :3, 1] = [0.0, 0, -1]
    poses[:, :3, 2] = np.c_[np.cos(turns), np.sin(turns), 0 * turns]
    names = tuple(f"{k}.png" for k in range(4))
    return gaussians, Cameras(poses, np.tile([30.0, 30, 32, 24], (4, 1)), np.tile([64, 48], (4, 1)), names)


def register(m: Map) -> None:
    """Edges as a registration might have found them: the scenes stand a metre apart, and the shed matches nothing."""
    keys = graph_keys(m.store, m.scenes(), m.settings)
    recipe = recipe_key(m.settings.register)
    at = {scene.id: np.array([float(k), 0, 0]) for k, scene in enumerate(m.scenes())}
    names = {scene.id: scene.name for scene in m.scenes()}
    for a, b in combinations(sorted(at), 2):
        key = recipe.of(keys[a].digest, keys[b].digest)
        if "shed" in (names[a], names[b]):
            m.store.registrations.save(Registration(a, b, "no_match", "no pose proposed"), key)
            continue
        first = 0
        for turn, more in enumerate((0.0, 0.25)):  # of two recipes, the second of which is gone back from
            found = Registration(
                target=a,
                source=b,
                status="accepted",
                S_target_source=Sim3(np.eye(3), at[b] - at[a] + 0.01 * more),
                information=np.diag([1e4] * 3 + [1e3] * 3 + [1e8]),
                num_inliers=20,
                num_correspondences=30,
                overlap=0.5 - more,
                proposer="graph:landmarks",
                seconds={"match": 0.5, "refine": 0.25, "verdict": 0.125},
                evidence={"log_nfa": -9.5, "free_space_violation": 0.25},
                notes=("few nodes",) if turn else (),
            )
            saved = m.store.registrations.save(found, recipe.of(*key.inputs, "another") if turn else key)
            first = first or saved.number
        m.store.registrations.adopt(first)


def compare(m: Map) -> None:
    """Changes as a comparison might have found them; the hall and the stairwell are compared twice."""
    from gsmap.change import recipe_key as change_recipe
    from gsmap.types import Change, ChangeReport

    box, rows = np.array([[0.0, 0, 0], [0.5, 0.5, 1]]), np.arange(5, dtype=np.int32)
    moved = Sim3(np.eye(3), np.array([1.0, 0, 0]))
    chair = Change("moved", box, box.astype(np.float32), rows, rows[:3], moved, "half", 0.875, {"through": 6.0})
    wall = Change("recoloured", box + 2, box.astype(np.float32) + 2, rows, rows, confidence=0.5)
    recipe, placed = change_recipe(m.settings.change), m.pose_graph().poses
    for older, newer, found in (("hall", "stairwell", (chair, wall)), ("stairwell", "attic", ())) * 2:
        a, b = (m.store.scenes.get(name).id for name in (older, newer))
        S_newer_older = placed[b].S_map_scene.inverse() @ placed[a].S_map_scene
        where = {"S_newer_older": S_newer_older, "S_frame_newer": placed[b].S_map_scene}
        report = ChangeReport(found, 0.75, np.array([1.0, 1.125, 0.875]), ("it was dark",))
        if not m.store.changes.current():  # the first one is of another recipe
            key = change_recipe(type(m.settings.change)(min_confidence=0.125)).of(a, b)
        else:
            key = recipe.of(a, b)
        m.store.changes.save(report, key, older=a, newer=b, **where)
    m.confirm("c1", "I moved it")


def keep_objects(m: Map) -> None:
    """Two objects, one of them seen in two captures and named; a room."""
    from gsmap.objects import recipe_key as object_recipe
    from gsmap.store.objects import ComputedObjects, ObjectSet
    from gsmap.types import MapObject, ObjectObservation, Room

    placed = m.pose_graph().poses
    a, b = (m.store.scenes.get(name).id for name in ("hall", "stairwell"))
    box = np.array([[0.0, 0, 0], [1.0, 0.5, 0.75]])
    seen, none = ObjectObservation(a, "seen", 0, box), ObjectObservation(b, "absent", -1, None, 0.75, a)
    grey = np.array([50.0, 0, 0], np.float32)
    sofa = MapObject("0" * 8, 0, box, box.mean(0), grey, (seen, ObjectObservation(b, "seen", 1, box)))
    lamp = MapObject("1" * 8, 0, box + 2, box.mean(0) + 2, grey, (ObjectObservation(a, "seen", 1, box + 2), none))
    cells = np.ones((20, 30), bool)
    cells[:5, :5] = False
    room = Room(np.array([-1.0, -1.5]), cells, 0.125, 0.0, 2.5)
    key = object_recipe(m.settings.objects).of(a, b)
    poses = {scene: placed[scene].S_map_scene for scene in (a, b)}
    made = ObjectSet(key.digest, key.recipe, 1.0, poses, dict.fromkeys((a, b), "0" * 32), (sofa, lamp), rooms=(room,))
    m.store.objects.save([ComputedObjects(made, [{a: box, b: box}, {a: box + 2}], key)])
    m.store.objects.edit(1, name="grandmother's sofa", label="sofa", note="oak")
    m.store.objects.edit(2, same_as=1, author="ann")


def keep_photo(m: Map) -> None:
    """A photograph as it might have been localised in the hall, and one that was taken back."""
    from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation

    for number in (1, 2):
        sighting = LocalizedPhoto(
            digest=f"{number:064x}",
            name=f"phone{number}.jpg",
            captured_at="2026-01-05T03:04:05+00:00",
            scene=m.store.scenes.get("hall").id,
            T_scene_camera=np.eye(4),
            covariance=np.eye(6) * 1e-4,
            intrinsics_px=np.array([500.0, 500, 320, 240]),
            size_px=(640, 480),
            probability=0.984375,
            things=(PhotoObjectObservation(np.array([1.0, 0.5, 0.25]), "absent", 0.75),),
        )
        content = BytesIO()
        Image.new("RGB", (64, 48), (200, 180, 20 * number)).save(content, "JPEG")
        m.store.photos.add(sighting, content.getvalue())
    m.store.photos.remove(2)


def pack(path: Path, out: Path) -> None:
    def nobody(entry: tarfile.TarInfo) -> tarfile.TarInfo | None:
        if entry.name.endswith("-shm") or (entry.name.endswith("-wal") and entry.size == 0):
            return None  # nothing that a closed map needs
        entry.uid = entry.gid = 0
        entry.uname = entry.gname = ""
        return entry

    out.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(out, "w:xz", preset=9) as archive:
        archive.add(path, filter=nobody)


if __name__ == "__main__":
    sys.exit(main())
