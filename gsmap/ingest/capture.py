"""Read one capture: Gaussians, cameras and metadata."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.errors import ConfigError, GsmapError, InputError, NotPinholesError
from gsmap.formats.precision import about_origin, format_origin, rounded_to
from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.transforms import transform_cameras
from gsmap.ingest.capture_search import CaptureFiles, find_captures
from gsmap.ingest.dates import find_date, given_date
from gsmap.ingest.validate import validate_cameras, validate_gaussians
from gsmap.stream import clamp_infinities
from gsmap.types import Cameras, Gaussians, GaussianSource, Sim3
from gsmap.types.progress import Progress
from gsmap.types.scene import SCALE_POLICIES
from gsmap.types.source import origin_of_source


@dataclass(frozen=True, eq=False)
class Capture:
    """A checked capture, ready for the store.

    Args:
        content: its Gaussians, in the capture's own frame; perhaps still in their file. Where the coordinates of
            their file are too large for single precision, they are about an origin, and so is the capture's frame.
        cameras: in the same frame, less that origin; ``cameras.synthesised`` where the source had none.
        name: from the file or folder, or as given.
        source: the file it was read from.
        captured_at: ISO 8601 with zone, or None.
        dated_by: what said so; empty where a person did.
        scale_policy: ``auto``, ``known`` or ``unknown``.
        antialiased: trained with the 2D Mip filter.
        notes: remarks.
    """

    content: GaussianSource
    cameras: Cameras
    name: str
    source: str = ""
    captured_at: str | None = None
    scale_policy: str = "auto"
    antialiased: bool = False
    notes: tuple[str, ...] = ()
    dated_by: str = ""

    @cached_property
    def gaussians(self) -> Gaussians:
        """Return the Gaussians of the capture and keep them in memory."""
        return self.content.load()


def read_captures(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    cameras: str | os.PathLike[str] | None = None,
    name: str | None = None,
    captured_at: str | datetime | None = None,
    scale_policy: str = "auto",
    progress: Progress | None = None,
) -> list[Capture]:
    """Read all captures in files and folders at once; for many large ones, loop over `find_captures` instead.

    Args:
        cameras, name: for a single capture only.
        captured_at: of all of them, ISO 8601; UTC where it has no zone. None finds it beside each (`find_date`).

    Raises:
        NotFoundError: no such file or folder.
        InputError: what cannot be read or makes no capture; see `gsmap.ingest.validate`.
        ConfigError: options that make no sense together.
    """
    found = find_captures([paths] if isinstance(paths, (str, os.PathLike)) else paths)
    if len(found) > 1 and (cameras is not None or name is not None):
        raise ConfigError(
            f"cameras and name apply to one capture, but {len(found)} captures were found: ingest them one by one",
            code="many_captures",
        )
    out = []
    for i, one in enumerate(found):
        if progress:
            progress(i / len(found), one.name)
        out.append(read_capture(one, cameras=cameras, name=name, captured_at=captured_at, scale_policy=scale_policy))
    return out


def read_capture(
    found: CaptureFiles,
    *,
    cameras: str | os.PathLike[str] | None = None,
    name: str | None = None,
    captured_at: str | datetime | None = None,
    scale_policy: str = "auto",
    clean: bool = False,
    bbox: Sequence[float] | None = None,
) -> Capture:
    """Read and check a capture from `find_captures`; see `read_captures` and `take_capture`."""
    from gsmap.formats.cameras import is_of_trainer  # imported here, as verbs that read no file do not need it

    given_date(captured_at)  # refuses what is none before a large file is read
    gaussians = formats.stream(found.path)
    about = formats.info(found.path)
    source = Path(cameras) if cameras is not None else found.cameras
    lens_note = ""
    # Files that only lie beside a splat, and may be of another program or frame, are left out with a note.
    may_be_foreign = cameras is None and source is not None and not is_of_trainer(source)
    try:
        given = None if source is None else formats.read_cameras(source)
    except GsmapError as error:
        if cameras is not None or not (may_be_foreign or isinstance(error, NotPinholesError)):
            raise
        given, lens_note = None, str(error)
    take = partial(
        take_capture,
        gaussians,
        name=name or found.name,
        captured_at=captured_at,
        scale_policy=scale_policy,
        clean=clean,
        bbox=bbox,
        source=str(found.path),
        cameras_source="" if source is None else str(source),
    )
    try:
        capture = take(given)
    except InputError as error:
        if not may_be_foreign or error.code not in ("cameras_see_nothing", "invalid_camera"):
            raise
        given, lens_note = None, str(error)
        capture = take(None)
    notes = (*about.notes, *(note for note in (found.note, lens_note) if note), *capture.notes)
    capture = replace(capture, antialiased=about.antialiased, notes=notes)
    if captured_at is not None:
        return capture
    date = find_date(found, source, () if given is None else capture.cameras.names)
    notes = (*notes, *([date.note] if date.note else []))
    return replace(capture, captured_at=date.when, dated_by=date.source, notes=notes)


def take_capture(
    gaussians: GaussianSource,
    cameras: Cameras | None = None,
    *,
    name: str,
    captured_at: str | datetime | None = None,
    scale_policy: str = "auto",
    clean: bool = False,
    bbox: Sequence[float] | None = None,
    source: str = "",
    cameras_source: str = "",
) -> Capture:
    """Check a capture in memory; missing cameras are synthesized.

    Args:
        gaussians, cameras: in one frame; see `Capture` on its origin.
        clean: remove what is no surface first (`gsmap.ingest.clean`).
        bbox: with ``clean``, remove everything outside this box, too; x0 y0 z0 x1 y1 z1 in coordinates of the source.

    Raises:
        InputError: what makes no capture; see `gsmap.ingest.validate`.
        ConfigError: an unknown scale policy, a date that is none, or a box without ``clean``.
    """
    check_scale(scale_policy)
    if bbox is not None and not clean:
        raise ConfigError("--bbox needs --clean, which removes what lies outside", code="option_not_applicable")
    date = given_date(captured_at)
    where = source or f"capture {name!r}"
    if isinstance(gaussians, Gaussians):
        gaussians = about_origin(where, clamp_infinities(gaussians))
    notes = []
    if clean:
        from gsmap.ingest import clean as cleaning

        cleaned = cleaning.clean(gaussians.load(), bbox, where=where)
        gaussians = cleaned.gaussians
        notes.append(cleaned.note)
    notes += validate_gaussians(gaussians, where)
    notes += [] if cameras is None else cameras.notes
    origin = origin_of_source(gaussians)
    if origin.any():
        cameras = None if cameras is None else transform_cameras(cameras, Sim3(np.eye(3), -origin))
        notes += _origin_notes(gaussians, origin)
    if cameras is None:
        cameras = synthesise_cameras(gaussians)
        notes.append(f"no cameras were found for the capture: {len(cameras)} were synthesised in its free space")
    else:
        notes += validate_cameras(cameras, gaussians, f"{where} with {cameras_source}" if cameras_source else where)
    notes += [date.note] if date.note else []
    return Capture(gaussians, cameras, name, source, date.when, scale_policy, notes=tuple(notes))


def _origin_notes(gaussians: GaussianSource, origin: np.ndarray) -> list[str]:
    """Return notes on the origin and precision of a capture with large coordinates."""
    notes = [
        "the coordinates of the file are large: in the scene frame, all positions are reduced by "
        f"{format_origin(origin)}"
    ]
    step = rounded_to(gaussians)
    if step:
        notes.append(f"the file stores positions in single precision, which rounds them to {step:g} there")
    return notes


def check_scale(policy: str) -> None:
    """Raise an error for an unknown scale policy.

    Raises:
        ConfigError: not ``auto``, ``known`` or ``unknown``.
    """
    if policy not in SCALE_POLICIES:
        raise ConfigError(f"scale must be one of {', '.join(SCALE_POLICIES)}, got {policy!r}", code="invalid_choice")
