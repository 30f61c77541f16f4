"""What must survive a power cut, and what must not happen outside a folder.

Names in a folder that last, files that appear whole or not at all, and deleting, looking and opening below a folder
without ever following a link that lies in it: such a folder may come from a stranger.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

from gsmap.errors import BusyError, CorruptError


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file(path: Path) -> None:
    """Make a file's bytes survive a power cut."""
    handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(path: Path) -> None:
    """Make a folder, and what it lies in, so that it survives a power cut; nothing where it is there."""
    if path.is_dir():
        return
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync_folder(path.parent)


def write_text_whole(path: Path, text: str) -> None:
    """Replace a text file (UTF-8) in one step; see `write_whole`."""
    write_whole(path, lambda staged: staged.write_bytes(text.encode("utf-8")))


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a file under a passing name, synchronise it, and put it in its place by one rename.

    Raises:
        OSError: what the system says; the file that was there before stays as it was.
    """
    staged = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    try:
        write(staged)
        sync_file(staged)
        os.replace(staged, path)
    finally:
        staged.unlink(missing_ok=True)
    sync_folder(path.parent)


def lock_within(handle: int, how: int, patience_s: float, busy: str) -> None:
    """Lock an open file or folder (``how``: `fcntl.LOCK_EX`, `fcntl.LOCK_SH`); the kernel frees it with the process.

    Raises:
        BusyError: others kept it for so long; ``busy`` says what they have been doing.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(handle, how | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise BusyError(f"{busy} for {patience_s:g} s; try again later") from None
            time.sleep(0.01)


# --- below a folder that may come from a stranger ---------------------------------------------------------------------
# ``root`` itself may be a link (the person named it); what lies below it may not. ``names`` are the parts of a path.


def remove_tree(root: Path, *names: str) -> None:
    """Delete a folder and all in it, or a file; links in it are deleted and what they name is not. Nothing if missing.

    Raises:
        CorruptError: a folder on the way down is a link, or a name is none.
        OSError: the system refused.
    """
    with _parent_of(root, names) as parent:
        if parent is None or (mode := _mode(names[-1], parent)) is None:
            return
        if stat.S_ISDIR(mode):
            try:
                shutil.rmtree(names[-1], dir_fd=parent)  # by open folders: follows no link, whatever is swapped in
            except RecursionError as error:
                raise OSError(f"{root.joinpath(*names)} is too deep to be deleted: remove it by hand") from error
        else:
            os.unlink(names[-1], dir_fd=parent)


def remove_file(root: Path, *names: str) -> None:
    """Delete a file, or a link and not what it names. Nothing if missing.

    Raises:
        CorruptError: a folder on the way down is a link, or a name is none.
        OSError: the system refused, or it is a folder.
    """
    with _parent_of(root, names) as parent:
        if parent is not None:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(names[-1], dir_fd=parent)


def remove_empty_folder(root: Path, *names: str) -> None:
    """Delete a folder that has nothing in it; any other stays."""
    with _parent_of(root, names) as parent, contextlib.suppress(OSError):
        if parent is not None:
            os.rmdir(names[-1], dir_fd=parent)


def refuse_links(root: Path, *names: str) -> None:
    """Refuse a path any part of which is a link; parts that are missing are none.

    Raises:
        CorruptError: a part is a link, or a name is none.
    """
    at = root
    for name in names:
        at = at / _checked_name(root, name)
        try:
            mode = at.lstat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            return
        if stat.S_ISLNK(mode):
            raise _is_a_link(at)


def is_folder(path: Path) -> bool:
    """Whether it is a folder itself, not a link to one."""
    return _is(path, stat.S_ISDIR)


def is_file(path: Path) -> bool:
    """Whether it is a plain file itself: not a link to one, a pipe or a device."""
    return _is(path, stat.S_ISREG)


def files_below(folder: Path) -> dict[str, os.stat_result]:
    """What lies in a folder and the folders in it, by relative path: files, and whatever else is no folder.

    A link is listed as itself; nothing is looked at through one. Empty where the folder is missing or a link.
    """
    out: dict[str, os.stat_result] = {}
    todo = [""] if is_folder(folder) else []
    while todo:
        below = todo.pop()
        with contextlib.suppress(FileNotFoundError):  # others may be deleting it
            for name in os.listdir(folder / below):
                path = f"{below}{name}"
                with contextlib.suppress(FileNotFoundError):
                    found = os.lstat(folder / path)
                    if stat.S_ISDIR(found.st_mode):
                        todo.append(f"{path}/")
                    else:
                        out[path] = found
    return out


def open_file(path: Path) -> int:
    """Open a plain file to read it; never a link, and without waiting at a pipe.

    Raises:
        CorruptError: it is something else.
        OSError: the system refused.
    """
    if not is_file(path):
        path.lstat()  # says so where it is missing
        raise CorruptError(f"{path} is no plain file (a link, folder, pipe or device): gsmap made none; remove it")
    return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)


def _is(path: Path, kind: Callable[[int], bool]) -> bool:
    try:
        return kind(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


@contextlib.contextmanager
def _parent_of(root: Path, names: tuple[str, ...]) -> Iterator[int | None]:
    """The folder of a path below ``root``, held open, reached without a link; None where it is missing."""
    for name in names:
        _checked_name(root, name)
    handle: int | None = None
    try:
        handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        at = root
        for name in names[:-1]:
            at = at / name
            mode = _mode(name, handle)
            if mode is not None and stat.S_ISLNK(mode):
                raise _is_a_link(at)
            below = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=handle)
            os.close(handle)
            handle = below
        found = handle
    except FileNotFoundError:
        found = None
    except BaseException:
        if handle is not None:
            os.close(handle)
        raise
    try:
        yield found
    finally:
        if handle is not None:
            os.close(handle)


def _mode(name: str, folder: int) -> int | None:
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode
    except FileNotFoundError:
        return None


def _checked_name(root: Path, name: str) -> str:
    if name in ("", ".", "..") or "/" in name or "\0" in name:
        raise CorruptError(f"{name!r} is not the name of anything in {root}: nothing is done with it")
    return name


def _is_a_link(path: Path) -> CorruptError:
    return CorruptError(f"{path} is a link: gsmap makes none and follows none here; put what it names in its place")
