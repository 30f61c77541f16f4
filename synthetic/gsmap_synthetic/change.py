"""Truth about change: what each pixel shows at any time, and what changed between two times of a place.

States and changes are plain dictionaries, as they are written to JSON and read back by those who score.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gsmap.types import Cameras
from gsmap_synthetic.place import Place

PIXEL_KINDS = ("same", "new", "recoloured", "vacated")
"""What `pixel_kinds` tells apart, by index."""

State = Mapping[str, Any]
_SAME_POSE = 1e-6


def sight(place: Place, cameras: Cameras, shut: Iterable[int] = ()) -> tuple[np.ndarray, np.ndarray]:
    """What cameras in the place's frame look at: object ids (C, H, W) int16 and depths in metres (C, H, W) float32.

    Ids are -1 and depths 0 where there is nothing. All cameras are of one size.
    """
    skin = place.skin.with_shut(shut)
    width, height = (int(n) for n in cameras.sizes_px[0])
    ids = np.empty((len(cameras), height, width), np.int16)
    depths_m = np.empty((len(cameras), height, width), np.float32)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for i, (pose, (fx, fy, cx, cy)) in enumerate(zip(cameras.T_frame_camera, cameras.intrinsics_px, strict=True)):
        rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1).reshape(-1, 3)
        directions = np.einsum("nj,ij->ni", rays, pose[:3, :3])
        distance, quads, *_ = skin.cast(np.broadcast_to(pose[:3, 3], rays.shape), directions)
        hit = np.isfinite(distance)
        ids[i] = np.where(hit, skin.owners[quads], -1).reshape(height, width)
        depths_m[i] = np.where(hit, distance, 0).reshape(height, width)
    return ids, depths_m


def states(place: Place, shut: Iterable[int] = ()) -> list[dict[str, Any]]:
    """The state of every object that ever was in the place, by id; the leaves of open doors are not there.

    Each has ``id, name, kind, room, present, paint, symmetry, replaces, T_place_object`` and, where it is there,
    ``box_m`` (its low and high corner, place frame) and ``middle_m`` (of its footprint: what a symmetric one turns
    about).
    """
    shut = set(shut)
    owners, leaves = np.array(place.surfaces.owners), np.array(place.surfaces.leaves)
    out = []
    for thing in place.objects:
        quads = np.flatnonzero(owners == thing.id)
        present = thing.present and len(quads) > 0
        if present and thing.kind == "door":
            present = bool(np.isin(leaves[quads], list(shut)).all())
        state: dict[str, Any] = {
            "id": thing.id,
            "name": thing.name,
            "kind": thing.kind,
            "room": thing.room,
            "present": present,
            "paint": thing.paint,
            "symmetry": thing.symmetry,
            "replaces": thing.replaces,
            "T_place_object": thing.T_place_object.tolist(),
        }
        if present:
            corners = np.concatenate([place.surfaces.corners[q] for q in quads])
            middle = thing.T_place_object @ [0.0, thing.size_m[1] / 2, 0.0, 1.0]
            state |= {"box_m": [corners.min(0).tolist(), corners.max(0).tolist()], "middle_m": middle[:3].tolist()}
        out.append(state)
    return out


def true_changes(before: Iterable[State], after: Iterable[State]) -> list[dict[str, Any]]:
    """What changed between two lists of `states` of one place.

    Each change has ``kind`` (appeared, disappeared, moved, recoloured, replaced), ``before`` and ``after`` (ids of its
    object at each time, None where there is none), ``name, symmetry``, ``box_before_m, box_after_m`` (place frame),
    and, where something moved, ``S_after_before`` (4 x 4 in the place's frame) and ``middle_m`` (before).
    """
    old = {s["id"]: s for s in before if s["present"]}
    new = {s["id"]: s for s in after if s["present"]}
    out = []
    replaced = {s["replaces"] for s in new.values() if s["id"] not in old and s["replaces"] in old}
    for i in sorted(old.keys() | new.keys()):
        a, b = old.get(i), new.get(i)
        extra: dict[str, Any] = {}
        if a and b:
            if _moved(a, b):
                S = np.array(b["T_place_object"]) @ np.linalg.inv(np.array(a["T_place_object"]))
                kind, extra = "moved", {"S_after_before": S.tolist(), "middle_m": a["middle_m"]}
            elif a["paint"] != b["paint"]:
                kind = "recoloured"
            else:
                continue
        elif b:
            stood = old.get(b["replaces"])
            kind, a = ("replaced", stood) if stood and b["replaces"] not in new else ("appeared", None)
        elif i in replaced:
            continue
        else:
            kind = "disappeared"
        one: State = b or a or {}
        change = {
            "kind": kind,
            "before": a["id"] if a else None,
            "after": b["id"] if b else None,
            "name": one["name"],
            "symmetry": one["symmetry"],
            "box_before_m": a["box_m"] if a else None,
            "box_after_m": b["box_m"] if b else None,
        }
        out.append(change | extra)
    return out


def pixel_kinds(ids: np.ndarray, then: np.ndarray, now: Iterable[State], past: Iterable[State]) -> np.ndarray:
    """Indices into `PIXEL_KINDS` of pixels that show the objects ``ids`` now and would have shown ``then`` in the past.

    "new" shows what was not there or elsewhere, "recoloured" what had other colours, "vacated" what something hid that
    has gone since.
    """
    here = {s["id"]: s for s in now if s["present"]}
    there = {s["id"]: s for s in past if s["present"]}
    stayed = {i for i in here.keys() & there.keys() if not _moved(there[i], here[i])}
    painted = [i for i in stayed if here[i]["paint"] != there[i]["paint"]]
    out = np.zeros(ids.shape, np.uint8)
    out[np.isin(then, [i for i in there if i not in stayed])] = 3
    out[np.isin(ids, painted)] = 2
    out[np.isin(ids, [i for i in here if i not in stayed])] = 1
    return out


def _moved(a: State, b: State) -> bool:
    return bool(np.abs(np.array(a["T_place_object"]) - np.array(b["T_place_object"])).max() > _SAME_POSE)
