"""Match photos to cameras by the tails of their paths, and by folders named as scenes.

Cameras of different scenes, or of a rig, often share file names: a drone numbers every card from 1. A photo is known by
as much of its path as tells it from other photos, a camera has one photo, and what stays ambiguous is refused.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from gsmap.errors import InputError

_Camera = tuple[str, int]
_Rank = tuple[bool, bool, int, bool]
"""Rank of a photo for a camera, higher is better: a folder above the photo has the scene's name; no folder contradicts
the camera's name; number of path parts that agree; the suffix agrees.
"""


@dataclass(frozen=True, eq=False)
class PhotoMatches:
    """Photos matched to cameras.

    Args:
        cameras: scene name and camera row, by photo.
        left_out: photos that only share a file name with a camera, with the photo that takes precedence.
        by_file_name: photos matched by file name alone, without evidence for the scene.
    """

    cameras: dict[str, _Camera]
    left_out: dict[str, str]
    by_file_name: tuple[str, ...]


def match_photos(photos: Collection[str], names: Mapping[str, Sequence[str]], where: Mapping[str, str]) -> PhotoMatches:
    """Match photos to the cameras of scenes.

    A photo is a camera where the file name, with or without suffix, is the same. If several are, the one counts whose
    scene is a folder above the photo, and then the one with which more of the path agrees. In a scene whose photos lie
    in a folder of its name, or of which folders tell the cameras apart, photos of other folders do not count; and where
    folders are called as scenes, a photo in another folder is no camera by its file name alone.

    Args:
        photos: paths, as long as they are known; ``/`` and ``\\`` part folders.
        names: camera names of each scene, by scene name.
        where: source of each photo's name, for error messages.

    Raises:
        InputError: a photo may be several cameras, or several photos may be one.
    """
    by_stem: dict[str, list[_Camera]] = {}
    for scene, cameras in names.items():
        for row, camera in enumerate(cameras):
            by_stem.setdefault(_stem(_parts(camera)[-1]), []).append((scene, row))
    folders = {tuple(_parts(scene)): scene for scene in names}
    ranked: dict[str, dict[_Camera, _Rank]] = {}
    for photo in photos:
        parts = _parts(photo)
        found = by_stem.get(_stem(parts[-1]), [])
        own = _scene_of(parts[:-1], folders) if found else None
        mine = [camera for camera in found if own is None or camera[0] == own]
        ranks = {(s, k): (own is not None, *_agreement(parts, _parts(names[s][k]))) for s, k in mine}
        if ranks:
            ranked[photo] = ranks
    left_out = _drop_other_folders(ranked)

    chosen: dict[str, _Camera] = {}
    for photo, ranks in ranked.items():
        best = max(ranks.values())
        several = [camera for camera, rank in ranks.items() if rank == best]
        if len(several) > 1:
            one, other = (f"{scene}/{names[scene][row]}" for scene, row in several[:2])
            raise InputError(
                f"{where[photo]}: {photo} may be the camera {one} or {other}: give the photo with more of its path, so "
                "that it ends in one of these (a folder that is called as the scene is enough where scenes differ)",
                code="photo_ambiguous",
            )
        chosen[photo] = several[0]
    left_out |= _one_photo_each(chosen, ranked, names, where)
    bare = tuple(photo for photo, camera in chosen.items() if _is_bare(photo, camera[0], ranked[photo][camera]))
    return PhotoMatches(chosen, left_out, bare)


def rows_of_photo(names: Sequence[str], photo: str) -> list[int]:
    """Return the rows of a scene's cameras that a photo may belong to; one row if its name is unambiguous."""
    exact = [row for row, name in enumerate(names) if name == photo]
    if exact:
        return exact
    parts, stem = _parts(photo), _stem(_parts(photo)[-1])
    cameras = {row: _parts(name) for row, name in enumerate(names)}
    ranks = {row: _agreement(parts, camera) for row, camera in cameras.items() if _stem(camera[-1]) == stem}
    return [row for row, rank in ranks.items() if rank == max(ranks.values())]


def _drop_other_folders(ranked: dict[str, dict[_Camera, _Rank]]) -> dict[str, str]:
    """Remove from ``ranked`` the photos that folders exclude; return each with a photo in the expected folder."""
    best: dict[str, tuple[tuple[bool, bool], str]] = {}
    for photo, ranks in ranked.items():
        for (scene, _), rank in ranks.items() if len(_parts(photo)) > 1 else ():
            if scene not in best or rank[:2] > best[scene][0]:
                best[scene] = rank[:2], photo
    in_scene = next((photo for (own, _), photo in best.values() if own), None)  # here folders are called as scenes
    left_out = {}
    for photo, ranks in list(ranked.items()):
        if len(_parts(photo)) == 1:
            continue  # no folder, so nothing that speaks against any
        near = {camera: rank for camera, rank in ranks.items() if rank[:2] == best[camera[0]][0]}
        kept = {c: rank for c, rank in near.items() if in_scene is None or not _is_bare(photo, c[0], rank)}
        if kept:
            ranked[photo] = kept
        else:
            left_out[photo] = in_scene or best[max(ranks, key=lambda camera: ranks[camera])[0]][1]
            del ranked[photo]
    return left_out


def _is_bare(photo: str, scene: str, rank: _Rank) -> bool:
    """Return true if neither a folder nor the file name identifies the scene of a photo."""
    return not rank[0] and rank[2] == 1 and scene not in _parts(photo)[-1]


def _one_photo_each(
    chosen: dict[str, _Camera],
    ranked: Mapping[str, Mapping[_Camera, _Rank]],
    names: Mapping[str, Sequence[str]],
    where: Mapping[str, str],
) -> dict[str, str]:
    """Keep the best photo of each camera in ``chosen``; return each removed photo with the photo that was kept."""
    photos_of: dict[_Camera, list[str]] = {}
    for photo, camera in chosen.items():
        photos_of.setdefault(camera, []).append(photo)
    left_out = {}
    for camera, photos in photos_of.items():
        first = max(photos, key=lambda photo: ranked[photo][camera])
        for other in photos:
            if other == first or _is_same_photo(_parts(first), _parts(other)):
                continue
            if ranked[other][camera] == ranked[first][camera]:
                scene, row = camera
                raise InputError(
                    f"{where[other]}: {first} and {other} may both be the camera {scene}/{names[scene][row]}: leave "
                    "out the photos of one of their folders, or call the right folder as the scene",
                    code="photo_ambiguous",
                )
            left_out[other] = first
            del chosen[other]
    return left_out


def _is_same_photo(a: Sequence[str], b: Sequence[str]) -> bool:
    """Return true if two paths name the same photo: one path is the tail of the other, apart from a missing suffix."""
    whole, _, same = _agreement(a, b)
    return whole and (same or _stem(a[-1]) in (a[-1], b[-1]))


def _agreement(photo: Sequence[str], camera: Sequence[str]) -> tuple[bool, int, bool]:
    """Return whether all folders agree, the number of agreeing parts from the end, and whether the suffix agrees."""
    tail = 1
    while tail < min(len(photo), len(camera)) and photo[-tail - 1] == camera[-tail - 1]:
        tail += 1
    return tail in (len(photo), len(camera)), tail, photo[-1] == camera[-1]


def _scene_of(folders: Sequence[str], scenes: Mapping[tuple[str, ...], str]) -> str | None:
    """Return the scene with the name of the deepest possible folder; None without one."""
    sizes = sorted({len(name) for name in scenes}, reverse=True)
    for end in range(len(folders), 0, -1):
        for size in sizes:
            if size <= end and (scene := scenes.get(tuple(folders[end - size : end]))) is not None:
                return scene
    return None


def _parts(path: str) -> list[str]:
    """Split a path into folders and file name."""
    return [part for part in path.replace("\\", "/").split("/") if part not in ("", ".")] or [path]


def _stem(base: str) -> str:
    stem, dot, suffix = base.rpartition(".")
    return stem if dot and stem and len(suffix) <= 5 and not suffix.isdigit() else base
