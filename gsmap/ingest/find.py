"""Where the captures are: files, folders of files, and the output folders of trainers."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gsmap import formats
from gsmap.errors import InputError, NotFoundError
from gsmap.formats import colmap

MAX_DEPTH = 5
# What a trainer calls every one of its files, so the folder tells more.
_GENERIC = re.compile(
    r"(point_cloud|splat|scene|gaussians|model|output|export|meta|ckpt|step|chkpnt)([_-]?\d+)?(_rank\d+)?",
    re.IGNORECASE,
)
_GENERIC_FOLDER = re.compile(
    r"(iteration_\d+|point_cloud|ply|ckpts|nerfstudio_models|exports?|splat|outputs?|results?)", re.IGNORECASE
)
_WHOLE = "tileset.json", "lod-meta.json", "meta.json"  # files by which a folder is one scene
_CHECKPOINTS = (".pt", ".pth", ".ckpt")


@dataclass(frozen=True)
class Found:
    """One capture on disk.

    Args:
        path: the file of Gaussians.
        cameras: the file or folder of its cameras, or None.
        name: from the file, or from the folder where the file is called as every other.
        note: why cameras that lie near were not taken; else empty.
        names: what it goes by, each with the folder that this lies in: its file without the suffix, and the folders
            around where those above are called as every other.
        alone: whether no other capture lies in its folder.
    """

    path: Path
    cameras: Path | None
    name: str
    note: str = ""
    names: tuple[tuple[Path, str], ...] = ()
    alone: bool = True


def find_captures(paths: Iterable[str | os.PathLike[str]]) -> list[Found]:
    """All captures in files and folders, in the order given; a folder's in the order of their names.

    A folder is the output of gaussian-splatting (its last iteration is taken), of gsplat (the last ``.ply``), or of
    nerfstudio, or it holds files and folders of captures.

    Raises:
        NotFoundError: no such file or folder.
        InputError: an unknown suffix, or a folder without captures.
    """
    out: list[Found] = []
    for path in map(Path, paths):
        if not path.exists():
            raise NotFoundError(f"no such file or folder: {path}")
        if not path.is_dir():
            if not path.is_file():
                raise InputError(f"{path} is a pipe or a device, not a file: save what comes from it first")
            out.append(_file(path, alone=len(_splats(path.parent)) <= 1))
            continue
        found = _folder(path.resolve() if path.name in ("", "..") else path, MAX_DEPTH, set())
        if not found:
            raise InputError(f"{path} holds no captures: {_why_none(path)}")
        out.extend(found)
    return out


def _folder(folder: Path, depth: int, seen: set[Path]) -> list[Found]:
    """The captures of a folder and of those in it, each of which is looked at once, however many links lead to it."""
    if folder.resolve() in seen:
        return []
    seen.add(folder.resolve())
    whole = _last(folder.glob("point_cloud/iteration_*/point_cloud.*")) or _last(folder.glob("ply/point_cloud_*.*"))
    if whole is None:  # what lies below it are parts of one scene
        whole = next((folder / name for name in _WHOLE if _is_whole(folder / name)), None)
    if whole is not None:
        return [_file(whole, alone=True)]
    files = _splats(folder)
    newest = None if files else _checkpoint(folder)
    if newest is not None:
        return [_file(newest, alone=True)]
    out = [_file(path, alone=len(files) == 1) for path in files]
    if depth > 0:
        for child in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
            out.extend(_folder(child, depth - 1, seen))
    return out


def _checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint of a trainer's output; none where several GPUs have a part each."""
    found = [
        *folder.glob("nerfstudio_models/step-*.ckpt"),
        *folder.glob("ckpts/ckpt_*.pt"),
        *folder.glob("chkpnt*.pth"),
    ]
    if any("_rank" in path.name and not path.name.endswith("_rank0.pt") for path in found):
        return None
    numbered = [(int(m[0]), path) for path in found if (m := re.findall(r"\d+", path.name))]
    return max(numbered, default=(0, None))[1]


def _is_whole(path: Path) -> bool:
    """Whether a file makes its folder one scene; a ``meta.json`` may be anybody's."""
    return path.is_file() and (path.name != "meta.json" or any(path.parent.glob("means_l*.webp")))


def _splats(folder: Path) -> list[Path]:
    """Files with a suffix that can be read; not the SfM points that trainers leave as ``input.ply``."""
    files = (p for p in folder.iterdir() if p.is_file() and _readable(p))
    return sorted(p for p in files if p.name not in ("input.ply", *_WHOLE) and p.suffix.lower() not in _CHECKPOINTS)


def _readable(path: Path) -> bool:
    return formats.suffix_of(path) is not None and not path.name.startswith(".")


def _last(paths: Iterable[Path]) -> Path | None:
    """The one with the highest number in its path's last two parts (``iteration_30000``)."""
    numbered = [(int(m[-1]), p) for p in paths if _readable(p) and (m := re.findall(r"\d+", "/".join(p.parts[-2:])))]
    return max(numbered, default=(0, None))[1]


def _file(path: Path, *, alone: bool) -> Found:
    suffix = formats.suffix_of(path)
    if suffix is None:
        raise InputError(
            f"{path} has the unknown suffix {path.suffix!r}: gsmap can read {', '.join(formats.known('read'))}"
        )
    stem = path.name[: -len(suffix)]
    names = _names(path, stem)
    name = stem if _tells_nothing(names[-1][1]) else names[-1][1]
    own = path.with_name(f"{stem}.cameras.json")
    if own.is_file():
        return Found(path, own, name, names=names, alone=alone)
    shared = _shared_cameras(path)
    if shared is None or alone:
        return Found(path, shared, name, names=names, alone=alone)
    note = f"{shared.name} was not taken: several captures lie beside it (call it {own.name}, or pass --cameras)"
    return Found(path, None, name, note, names, alone)


def _names(path: Path, stem: str) -> tuple[tuple[Path, str], ...]:
    """What a capture goes by; see `Found`."""
    out = [(path.parent, stem)]
    folder = path.resolve().parent
    while _tells_nothing(out[-1][1]) and folder.name:
        out.append((folder.parent, folder.name))
        folder = folder.parent
    return tuple(out)


def _tells_nothing(name: str) -> bool:
    return not name or bool(_GENERIC.fullmatch(name) or _GENERIC_FOLDER.fullmatch(name))


def _shared_cameras(path: Path) -> Path | None:
    """Cameras beside the file; above it only in gaussian-splatting's ``point_cloud/iteration_N``."""
    folder = path.resolve().parent
    places = [folder]
    if re.fullmatch(r"iteration_\d+", folder.name) and folder.parent.name == "point_cloud":
        places.append(folder.parent.parent)
    for place in places:
        for name in ("cameras.json", "transforms.json"):
            if (place / name).is_file():
                return place / name
        model = colmap.find_model(place)
        if model is not None:
            return model
    return None


def _why_none(folder: Path) -> str:
    if any(p.suffix in _CHECKPOINTS for p in folder.rglob("*")):
        return "it has checkpoints, but not where trainers put those of one GPU: name the file, or export a .ply"
    return f"no file of it ends with {', '.join(formats.known('read'))}"
