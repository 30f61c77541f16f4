"""What must survive a power cut, and what must not happen outside a folder.

Names in a folder that last, files that appear whole or not at all, and deleting, looking and opening below a folder
without ever following a link that lies in it: such a folder may come from a stranger. A path that a person names as
output is another matter: `write_output` follows its links and writes to pipes and devices.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from gsmap.errors import BusyError, CorruptError, InputError


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

    For files of gsmap's own folders: a link at ``path`` is replaced and never followed. See `write_output`.

    Raises:
        OSError: what the system says; the file that was there before stays as it was.
    """
    _replace(path, path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}"), write)


def write_output(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill the output file that a person named.

    A file is replaced whole or not at all, and of a symbolic link the file that it leads to. A pipe, a character device
    and an open file of this process (``/dev/stdout``) get the bytes once all are there. Nothing else is replaced.

    Args:
        write: fills the file at the path it gets, whose name ends with that of ``path``.

    Raises:
        InputError: a folder, a socket or a block device.
        OSError: what the system says; the file that was there before stays as it was.
    """
    if is_stream(path):
        with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
            staged = Path(folder, path.name)
            write(staged)
            with open(staged, "rb") as whole, _opened_stream(path) as out:
                shutil.copyfileobj(whole, out)
        return
    with contextlib.suppress(FileNotFoundError):
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"cannot write {path}: it is a folder; name a file in it", code="target_is_a_folder")
        if not stat.S_ISREG(mode):
            raise InputError(
                f"cannot write {path}: it is a socket or a block device; name a file, or a pipe", code="not_writable"
            )
    target = Path(os.path.realpath(path))
    # A name that nobody can have put a link at, with the suffix that was asked for.
    _replace(target, target.with_name(f".{uuid.uuid4().hex[:8]}.{path.name}"), write)


def write_text_output(path: Path, text: str) -> None:
    """Write a text (UTF-8) to the output file that a person named; see `write_output`."""
    write_output(path, lambda staged: staged.write_bytes(text.encode("utf-8")))


def is_stream(path: Path) -> bool:
    """Whether bytes written to a path go to a pipe, a character device or an open file of this process."""
    if _descriptor(path) is not None:
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)


def _descriptor(path: Path) -> int | None:
    """The number of this process's open file that a path names (``/dev/stdout``, ``/dev/fd/63``); None where none.

    Opening such a path anew would cut what a shell redirects to, and replacing it would replace another process's file.
    """
    own = {os.path.realpath(folder) for folder in ("/proc/self/fd", "/dev/fd")}
    for _ in range(40):  # as many links as the system follows
        folder = os.path.realpath(path.parent)
        if folder in own and path.name.isdecimal():
            return int(path.name)
        if not path.is_symlink():
            return None
        path = Path(folder, os.readlink(path))
    return None


def _opened_stream(path: Path) -> BinaryIO:
    """A pipe, a device or an open file of this process, to be written to; never makes or cuts a file."""
    number = _descriptor(path)
    return open(os.open(path, os.O_WRONLY | os.O_NOCTTY | os.O_CLOEXEC) if number is None else os.dup(number), "wb")


def _replace(path: Path, staged: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill ``staged``, and put it in the place of ``path``."""
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
                raise BusyError(f"{busy} for {patience_s:g} s; try again later", code="lock_busy") from None
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
        raise CorruptError(
            f"{path} is no plain file (a link, folder, pipe or device): gsmap made none; remove it",
            code="not_a_plain_file",
        )
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
        raise CorruptError(
            f"{name!r} is not the name of anything in {root}: nothing is done with it", code="invalid_stored_name"
        )
    return name


def _is_a_link(path: Path) -> CorruptError:
    return CorruptError(
        f"{path} is a link: gsmap makes none and follows none here; put what it names in its place", code="link_refused"
    )
