"""Search files, folders and outputs of trainers for captures."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from gsmap import formats
from gsmap.errors import MALFORMED, GsmapError, InputError, NotFoundError
from gsmap.formats import scans

MAX_DEPTH = 5
# Generic file names of trainers; the folder has a better name.
_GENERIC = re.compile(
    r"(point_cloud|splat|scene|gaussians|model|output|export|meta|ckpt|step|chkpnt)([_-]?\d+)?(_rank\d+)?",
    re.IGNORECASE,
)
_GENERIC_FOLDER = re.compile(
    r"(iteration_\d+|point_cloud|ply|ckpts|nerfstudio_models|exports?|splat|outputs?|results?)", re.IGNORECASE
)
_WHOLE = "tileset.json", "lod-meta.json", "meta.json"  # files by which a folder is one scene
_CHECKPOINTS = (".pt", ".pth", ".ckpt")
_SFM_POINTS = ("input.ply", "points3D.ply")  # trainers leave them beside a splat, and in a COLMAP model
_PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic", ".heif", ".dng")
_VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv")


@dataclass(frozen=True)
class CaptureFiles:
    """The files of one capture.

    Args:
        path: the file of Gaussians.
        cameras: the file or folder of its cameras, or None.
        name: name of the file, or of the folder if the file has a generic name.
        note: reason why nearby cameras were not used, or empty.
        names: names of the capture, each with its folder: the file without suffix, and folders above generic names.
        alone: true if no other capture lies in its folder.
    """

    path: Path
    cameras: Path | None
    name: str
    note: str = ""
    names: tuple[tuple[Path, str], ...] = ()
    alone: bool = True


@dataclass(frozen=True)
class SkippedPath:
    """A file or folder that the search skipped, with the reason.

    Args:
        reason: one line that names it.
    """

    path: Path
    reason: str


@dataclass(frozen=True)
class SearchResult:
    """The result of a search for captures.

    Args:
        captures: captures in the order of the input; those of a folder by name.
        skipped: files that hold something other than Gaussians, and folders without captures.
        unreadable: folders that the system refused to list, and links to files that are missing.
    """

    captures: list[CaptureFiles] = field(default_factory=list)
    skipped: list[SkippedPath] = field(default_factory=list)
    unreadable: list[SkippedPath] = field(default_factory=list)


def find_captures(paths: Iterable[str | os.PathLike[str]]) -> list[CaptureFiles]:
    """Find all captures in files and folders; see `search_captures`."""
    return search_captures(paths).captures


def search_captures(paths: Iterable[str | os.PathLike[str]]) -> SearchResult:
    """Search files and folders for captures.

    A folder is the output of gaussian-splatting (its last iteration is taken), of gsplat (the last ``.ply``), or of
    nerfstudio, or it holds files and folders of captures. SfM points of COLMAP models, maps and exports in it are
    passed over.

    Raises:
        NotFoundError: no such file or folder.
        InputError: a pipe or a device, or nothing that could be a capture: an unknown suffix, folders without captures.
    """
    search, given = SearchResult(), [Path(path) for path in paths]
    num_splats_in = cache(lambda folder: len(_splats(folder)))
    for path in given:
        if not path.exists():
            raise NotFoundError(f"no such file or folder: {path}", code="file_not_found")
        if path.is_dir():
            _search_folder(path, search)
        elif not path.is_file():
            raise InputError(
                f"{path} is a pipe or a device, not a file: save its data to a file first", code="not_a_plain_file"
            )
        elif formats.suffix_of(path) is None:
            search.skipped.append(SkippedPath(path, _unknown(path)))
        else:
            search.captures.append(_file(path, alone=num_splats_in(path.parent) <= 1))
    if given and not search.captures and not search.unreadable:
        raise InputError(_why_nothing(given, search.skipped), code="no_captures")
    return search


def _search_folder(path: Path, search: SearchResult) -> None:
    """Add the captures in a folder that the user named to the search, or the reason why it has none."""
    if (folder := _product(path)) == "a gsmap map":
        search.skipped.append(SkippedPath(path, f"{path} is {folder}, no capture: gsmap merge adds its scenes"))
        return
    num_skipped, num_unreadable = len(search.skipped), len(search.unreadable)
    found = _folder(path.resolve() if path.name in ("", "..") else path, MAX_DEPTH, set(), search)
    search.captures.extend(found)
    if not found and num_unreadable == len(search.unreadable):
        why = _why_none(path, is_empty=num_skipped == len(search.skipped))
        if why:
            search.skipped.insert(num_skipped, SkippedPath(path, f"{path} holds {why}"))


def _folder(folder: Path, depth: int, seen: set[Path], search: SearchResult) -> list[CaptureFiles]:
    """Return the captures in a folder and below; visit each folder once, even if several links lead to it."""
    if folder.resolve() in seen:
        return []
    seen.add(folder.resolve())
    try:
        return _captures(folder, depth, seen, search)
    except OSError as error:
        search.unreadable.append(SkippedPath(folder, f"cannot read {folder}: {error.strerror or error}"))
        return []


def _captures(folder: Path, depth: int, seen: set[Path], search: SearchResult) -> list[CaptureFiles]:
    """Return the captures in a folder and below."""
    whole = _last(folder.glob("point_cloud/iteration_*/point_cloud.*")) or _last(folder.glob("ply/point_cloud_*.*"))
    if whole is None:  # what lies below it are parts of one scene
        whole = next((folder / name for name in _WHOLE if _is_whole(folder / name)), None)
    if whole is not None:
        return [_file(whole, alone=True)]
    files = _splats(folder, search)
    newest = None if files else _checkpoint(folder)
    if newest is not None:
        return [_file(newest, alone=True)]
    out = [_file(path, alone=len(files) == 1) for path in files]
    if depth > 0:
        for child in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
            if (product := _product(child)) is not None:
                search.skipped.append(SkippedPath(child, f"{child} is {product}: name it to ingest what lies in it"))
            else:
                out.extend(_folder(child, depth - 1, seen, search))
    return out


def _product(folder: Path) -> str | None:
    """Return the kind of gsmap output that a folder is; None for other folders."""
    if (folder / "map.sqlite").is_file() or (folder / "catalog.url").is_file():
        return "a gsmap map"
    if (folder / "tiles.json").is_file() and any(folder.glob("component_*")):
        return "an export of gsmap"
    return None


def exported_scenes(path: Path) -> set[str]:
    """Return the ids of the scenes from which gsmap exported a file, by the export's ``tiles.json``; empty for other
    files."""
    path = path.resolve()
    for folder in path.parents[:2]:
        try:
            tiles = json.loads((folder / "tiles.json").read_bytes())["tiles"]
            return {str(s) for tile in tiles if folder / tile["path"] == path for s in tile["S_map_scene"]}
        except (OSError, *MALFORMED):
            continue
    return set()


def _checkpoint(folder: Path) -> Path | None:
    """Return the newest checkpoint in a trainer's output; None if several GPUs each wrote a part."""
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
    """Return true if the whole folder of a file is one capture; a ``meta.json`` may also belong to another format."""
    return path.is_file() and (path.name != "meta.json" or any(path.parent.glob("means_l*.webp")))


def _splats(folder: Path, search: SearchResult | None = None) -> list[Path]:
    """Return the splat files in a folder, including damaged files, but not the SfM points that trainers leave.

    Args:
        search: receives files with the suffix of a splat that are no splats.
    """
    out, search = [], search or SearchResult()
    for path in sorted(p for p in folder.iterdir() if not p.is_dir() and _readable(p)):
        if path.name in (*_SFM_POINTS, *_WHOLE) or path.suffix.lower() in _CHECKPOINTS:
            continue
        if not path.exists():
            search.unreadable.append(SkippedPath(path, f"cannot read {path}: it is a link to a missing file"))
        elif not path.is_file():
            search.skipped.append(SkippedPath(path, f"{path} is a pipe or a device, not a file"))
        elif _may_hold_gaussians(path):
            out.append(path)
        else:
            search.skipped.append(
                SkippedPath(path, f"{path} is a point cloud or a mesh, not a splat (gsmap localize reads it)")
            )
    return out


def _may_hold_gaussians(path: Path) -> bool:
    """Return true if a file's header promises Gaussians, or is damaged, which is reported when the file is read."""
    try:
        return path.suffix.lower() not in scans.SUFFIXES or scans.holds_splat(path)
    except (GsmapError, OSError):
        return True


def _readable(path: Path) -> bool:
    return formats.suffix_of(path) is not None and not path.name.startswith(".")


def _last(paths: Iterable[Path]) -> Path | None:
    """Return the path with the highest number in its last two parts, such as ``iteration_30000``."""
    numbered = [(int(m[-1]), p) for p in paths if _readable(p) and (m := re.findall(r"\d+", "/".join(p.parts[-2:])))]
    return max(numbered, default=(0, None))[1]


def _file(path: Path, *, alone: bool) -> CaptureFiles:
    suffix = formats.suffix_of(path)
    if suffix is None:
        raise InputError(_unknown(path), code="unsupported_format")
    stem = path.name[: -len(suffix)]
    names = _names(path, stem)
    name = stem if _tells_nothing(names[-1][1]) else names[-1][1]
    own = path.with_name(f"{stem}.cameras.json")
    if own.is_file():
        return CaptureFiles(path, own, name, names=names, alone=alone)
    shared = _shared_cameras(path)
    if shared is None or alone:
        return CaptureFiles(path, shared, name, names=names, alone=alone)
    rename = f"rename it to {own.name}, or " if shared.suffix == ".json" else ""
    note = f"{shared.name} was not used, as several captures lie beside it ({rename}pass --cameras)"
    return CaptureFiles(path, None, name, note, names, alone)


def _names(path: Path, stem: str) -> tuple[tuple[Path, str], ...]:
    """Return the names that describe a capture; see `CaptureFiles`."""
    out = [(path.parent, stem)]
    folder = path.resolve().parent
    while _tells_nothing(out[-1][1]) and folder.name:
        out.append((folder.parent, folder.name))
        folder = folder.parent
    return tuple(out)


def _tells_nothing(name: str) -> bool:
    return not name or bool(_GENERIC.fullmatch(name) or _GENERIC_FOLDER.fullmatch(name))


def _shared_cameras(path: Path) -> Path | None:
    """Return the camera file beside a splat, or two folders above gaussian-splatting's ``iteration_N``."""
    folder = path.resolve().parent
    places = [folder]
    if re.fullmatch(r"iteration_\d+", folder.name) and folder.parent.name == "point_cloud":
        places.append(folder.parent.parent)
    from gsmap.formats.cameras import find as find_cameras  # imported here, as verbs that read no file do not need it

    return next((found for place in places if (found := find_cameras(place)) is not None), None)


def _unknown(path: Path) -> str:
    """Return the reason why a given file is not a capture."""
    for kind in _kind(path):
        return f"{path} is a {kind}, not a splat: {_TRAIN}, or localize it: gsmap localize MAP {path}"
    return f"{path} has the unknown suffix {path.suffix!r}: gsmap can read {', '.join(formats.known('read'))}"


def _why_none(folder: Path, *, is_empty: bool) -> str:
    """Describe the content of a folder without captures, with advice.

    Args:
        is_empty: say so where there is neither a checkpoint nor a photograph; else the answer is empty.
    """
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    if any(path.suffix in _CHECKPOINTS for path in files):
        where = "not where trainers put the checkpoint of a single GPU"
        return f"no captures; it has checkpoints, but {where}: name the file, or export a .ply"
    if (told := _photographed(Counter(kind for path in files for kind in _kind(path)))) is not None:
        return f"{told}, but no splat: {_TRAIN}, or localize them: gsmap localize MAP {folder}/*"
    if any(path.name in _SFM_POINTS for path in files):
        return f"the points of a COLMAP model, but no splat: {_TRAIN}"
    return f"no captures: none of its files ends with {', '.join(formats.known('read'))}" if is_empty else ""


def _why_nothing(given: list[Path], skipped: list[SkippedPath]) -> str:
    """Return one line that explains why none of the given paths is a capture."""
    kinds = Counter(kind for path in given if path.is_file() for kind in _kind(path))
    if sum(kinds.values()) == len(given) > 1:
        return f"{_photographed(kinds)}, but no splat: {_TRAIN}, or localize them: gsmap localize MAP FILE..."
    more = f" (and {len(skipped) - 1} more without a capture)" if len(skipped) > 1 else ""
    return f"{skipped[0].reason}{more}"


_TRAIN = "train a splat from them first (docs/start.md names trainers)"


def _kind(path: Path) -> list[str]:
    """Return ``photograph`` or ``video`` by the suffix, or an empty text."""
    suffix = path.suffix.lower()
    return ["photograph"] if suffix in _PHOTOGRAPHS else ["video"] if suffix in _VIDEOS else []


def _photographed(kinds: Counter[str]) -> str | None:
    """Return the numbers of photos and videos as text; None without photos and videos."""
    told = [f"{n} {kind}{'s' * (n != 1)}" for kind in ("photograph", "video") if (n := kinds[kind])]
    return " and ".join(told) or None
