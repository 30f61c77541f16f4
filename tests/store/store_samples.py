"""Small scenes for the store's tests."""

import numpy as np

from gsmap.methods import RecipeKey
from gsmap.store.objects import ComputedObjects, ObjectSet
from gsmap.types import Cameras, Change, ChangeReport, Gaussians, MapObject, ObjectObservation, Sim3
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation
from gsmap.types.prepared_scene import PreparedScene


def key(stage: str, *inputs: str, **settings: object) -> RecipeKey:
    return RecipeKey(stage, "test", {stage: 1}, settings, "native", inputs)


def make_gaussians(n: int = 500, seed: int = 0, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-5, 5, size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(size=(n, 3)) - 4,
        rng.normal(size=n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )


def make_cameras(n: int = 3) -> Cameras:
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, 0, 3] = np.arange(n)
    return Cameras(pose, np.tile([100.0, 100, 32, 24], (n, 1)), np.tile([64, 48], (n, 1)), tuple("äbcdefgh"[:n]))


def made_change(box, kind="moved", n=4, **more):
    """A change whose arrays are of some length."""
    moved = Sim3(np.eye(3), np.array([1.0, 0, 0])) if kind == "moved" else None
    fields = {"S_after_before": moved, "symmetry": "half", "confidence": 0.75, "evidence": {"through": 0.1 + 0.2}}
    fields |= {"voxels": np.linspace(*np.asarray(box, float), n).astype(np.float32)}
    fields |= {"before": np.arange(n, dtype=np.int32), "after": np.arange(2 * n, dtype=np.int32)}
    return Change(kind, np.asarray(box, np.float64), **(fields | more))


def save_comparison(store, older, newer, *found, version=1, S=None, S_frame_newer=None, notes=(), counted=None):
    """Keep what a comparison of two scenes (by id) found."""
    report = ChangeReport(tuple(found), 0.625, np.array([1.0, 0.5, 2.0]), tuple(notes))
    identity = Sim3.identity()
    made = key("change", older, newer, version=version)
    poses = {"S_newer_older": S or identity, "S_frame_newer": S_frame_newer or identity}
    return store.changes.save(report, made, older=older, newer=newer, num_at_comparison=counted, **poses)


JPEG = b"\xff\xd8\xff\xe0" + bytes(range(200))


def made_prepared(scene: str, cells: int = 5) -> PreparedScene:
    """A prepared scene of made cells and two views of 4 x 3 pixels."""
    rng = np.random.default_rng(cells)
    cameras = Cameras(np.tile(np.eye(4), (2, 1, 1)), np.tile([4.0, 4, 2, 1.5], (2, 1)), np.tile([4, 3], (2, 1)))
    return PreparedScene(
        scene=scene,
        unit_m=0.5,
        centre=rng.normal(size=3),
        is_surface=rng.uniform(size=21) > 0.5,
        points=rng.normal(size=(cells, 3)).astype(np.float32),
        colours=rng.uniform(size=(cells, 3)).astype(np.float16),
        normals=rng.normal(size=(cells, 3)).astype(np.float32),
        sides=rng.integers(-1, 2, cells).astype(np.int8),
        sample=rng.normal(size=(3, 3)).astype(np.float32),
        cameras=cameras,
        num_own=1,
        image_colours=rng.integers(0, 256, (24, 3)).astype(np.uint8),
        image_depths=np.append(rng.uniform(1, 2, 23), np.inf).astype(np.float16),
    )


def kept_photo(scene: str, number: int = 0, **values) -> LocalizedPhoto:
    """A photograph of a scene; others by number."""
    pose = np.eye(4)
    pose[:3, 3] = [1.0, 2.0, number]
    told = {"captured_at": "2026-03-01T12:00:00+00:00", "probability": 0.99}
    things = (PhotoObjectObservation(np.array([0.5, 0.25, 1.0]), "absent", 0.75),)
    lens = np.array([500.0, 500, 320, 240])
    return LocalizedPhoto(
        digest=f"{number:064x}",
        name=f"photo{number}.jpg",
        scene=scene,
        T_scene_camera=pose,
        covariance=np.eye(6) * 1e-4,
        intrinsics_px=lens,
        size_px=(640, 480),
        things=things,
        **told | values,
    )


def keep_objects(store, *places, seed="") -> list[str]:
    """Keep objects that captures show in these boxes of their own frames; their ids."""
    return [thing.id for thing in store.objects.save([computed(*places, seed=seed)])[0].objects]


def computed(*places, seed="") -> ComputedObjects:
    """Objects of a component that captures show in these boxes of their own frames."""
    boxes = [{scene: np.array(box, np.float64) for scene, box in one.items()} for one in places]
    scenes = list(dict.fromkeys(scene for one in boxes for scene in one))
    found = [
        MapObject(
            "f" * 8,
            0,
            next(iter(one.values())),
            np.zeros(3),
            np.zeros(3, np.float32),
            tuple(
                ObjectObservation(scene, "seen", i, one[scene])
                if scene in one
                else ObjectObservation(scene, "absent", -1, None, 0.75, next(iter(one)))
                for scene in scenes
            ),
        )
        for i, one in enumerate(boxes)
    ]
    recipe = key("objects", *scenes, seed)
    known = dict.fromkeys(scenes, Sim3.identity())
    made = ObjectSet(recipe.digest, recipe.recipe, 1.0, known, dict.fromkeys(scenes, "0"), tuple(found))
    return ComputedObjects(made, boxes, recipe)
