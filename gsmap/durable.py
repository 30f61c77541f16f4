"""Write files durably and atomically, and access files safely in folders that an untrusted source may have made.

Files appear whole or not at all and survive a power cut; deleting, inspecting and opening below a folder never follows
a link in it. An output path from the user is different: `write_output` follows its links and writes to pipes and
devices.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from gsmap import platform
from gsmap.errors import BusyError, CorruptError, DiskFullError, InputError, failed_path, of_system

_OWNER = 12  # characters of an owner's id in names of staged folders
_NO_MAP = "gsmap"  # owner of files that show no map


def sync_folder(folder: Path) -> None:
    """Make the entries of a folder durable on disk (fsync)."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file(path: Path) -> None:
    """Make the content of a file durable on disk (fsync)."""
    handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(path: Path) -> None:
    """Create a folder and its parents durably, unless it exists."""
    if path.is_dir():
        return
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync_folder(path.parent)


def write_text_whole(path: Path, text: str) -> None:
    """Replace a text file (UTF-8) atomically; see `write_whole`."""
    write_whole(path, lambda staged: staged.write_bytes(text.encode("utf-8")))


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a staged file, make that file durable (fsync), and rename it to ``path``.

    For files in gsmap's own folders: a link at ``path`` is replaced and never followed. See `write_output`.

    Raises:
        OSError: a system call failed; the previous file is unchanged.
    """
    _replace(path, path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}"), write)


def write_output(path: Path, write: Callable[[Path], object], owner: str = _NO_MAP) -> None:
    """Let ``write`` fill an output file that the user named.

    A file, or the target of a symbolic link, is replaced atomically. A pipe, a character device and an open file of
    this process (``/dev/stdout``) get the bytes once all are written. Nothing else is replaced.

    Args:
        write: fills the file at the path it gets, whose name is that of ``path``.
        owner: id of the map that the file shows, by which a purge, too, finds what a killed process left
            (`staged_folder`).

    Raises:
        InputError: a folder, a socket or a block device.
        OSError: a system call failed; the previous file is unchanged.
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
    with staged_folder(target, owner) as folder:
        _replace(target, folder / path.name, write)  # with the requested suffix; a link's target may have another


def write_text_output(path: Path, text: str, owner: str = _NO_MAP) -> None:
    """Write a text (UTF-8) to an output file that the user named; see `write_output`."""
    write_output(path, lambda staged: staged.write_bytes(text.encode("utf-8")), owner)


def write_owned(path: Path, owner: str, write: Callable[[Path], object]) -> None:
    """Replace a file atomically through a `staged_folder`; see `write_whole`."""
    with staged_folder(path, owner) as folder:
        _replace(path, folder / path.name, write)


@contextlib.contextmanager
def staged_folder(target: Path, owner: str) -> Iterator[Path]:
    """Yield a new locked folder beside ``target``, to fill and to rename, or files of it; deleted if it is still there.

    Its name carries the owner, and the lock lasts as long as this process: so whoever stages there next, and a purge
    (`remove_staged`), can delete what a killed process left.

    Args:
        owner: id of the map of which the content is.
    """
    remove_staged(target.parent, owner, target.name)
    staged, handle = make_locked_folder(target.with_name(f".{target.name}.{owner[:_OWNER]}"))
    try:
        with staged_for(staged, target):
            yield staged
    finally:
        with contextlib.suppress(OSError):
            remove_tree(staged.parent, staged.name)  # missing once renamed
        os.close(handle)


def remove_staged(parent: Path, owner: str, name: str | None = None) -> tuple[int, list[Path]]:
    """Delete what killed processes left of `staged_folder`.

    Args:
        parent: folder to search.
        owner: as in `staged_folder`.
        name: name of the target; None for all targets in ``parent``.

    Returns:
        Number of deleted files, and the folders that living processes still fill.

    Raises:
        OSError: a system call failed.
    """
    named = ".+" if name is None else re.escape(name)
    pattern = re.compile(rf"\.{named}\.{re.escape(owner[:_OWNER])}\.[0-9a-f]{{8}}", re.DOTALL)
    num_files = 0
    busy: list[Path] = []
    for entry in sorted(os.listdir(parent)) if parent.is_dir() else []:
        if not pattern.fullmatch(entry) or not is_folder(parent / entry):
            continue
        try:
            handle = lock_folder(parent / entry, wait=False)
        except BlockingIOError:
            busy.append(parent / entry)
            continue
        except FileNotFoundError:
            continue
        try:
            num_files += len(files_below(parent / entry))
            remove_tree(parent, entry)
        finally:
            os.close(handle)
    return num_files, busy


def make_locked_folder(path: Path) -> tuple[Path, int]:
    """Make a folder whose name begins with that of ``path``; return it and the descriptor of `lock_folder`."""
    while True:
        made = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}")
        made.mkdir()
        try:
            handle = lock_folder(made)
        except FileNotFoundError:
            continue  # removed as a leftover before it was locked
        if os.fstat(handle).st_nlink:
            return made, handle
        os.close(handle)


def lock_folder(folder: Path, *, wait: bool = True) -> int:
    """Open and lock a folder, not a link to one; return the descriptor, with which the lock goes.

    Raises:
        BlockingIOError: another process holds the lock, and ``wait`` is false.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        platform.lock(handle, wait=wait)
    except BaseException:
        os.close(handle)
        raise
    return handle


@contextlib.contextmanager
def staged_for(staged: Path, target: Path) -> Iterator[None]:
    """Context in which an OSError names the target, not the staged file or folder that its content is written to."""
    try:
        yield
    except OSError as error:
        failed = failed_path(error)
        inside = failed is not None and Path(failed).is_relative_to(staged)
        if inside or (failed is None and of_system(error) is DiskFullError):
            error.filename, error.filename2 = str(target), None
        raise


def is_stream(path: Path) -> bool:
    """Return True if a path is a pipe, a character device or an open file of this process."""
    if _descriptor(path) is not None:
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)


def _descriptor(path: Path) -> int | None:
    """Return the file descriptor of this process that a path such as ``/dev/stdout`` names; None for other paths.

    Opening such a path again would truncate a shell redirection, and replacing it would replace another process's file.
    """
    own = platform.descriptor_folders()
    for _ in range(40):  # the system's limit of links
        folder = os.path.realpath(path.parent)
        if folder in own and path.name.isdecimal():
            return int(path.name)
        if not path.is_symlink():
            return None
        path = Path(folder, os.readlink(path))
    return None


def _opened_stream(path: Path) -> BinaryIO:
    """Open a pipe, a device or an open file of this process for writing; never creates or truncates a file."""
    number = _descriptor(path)
    return open(os.open(path, os.O_WRONLY | os.O_NOCTTY | os.O_CLOEXEC) if number is None else os.dup(number), "wb")


def _replace(path: Path, staged: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill ``staged``, and rename it to ``path``."""
    try:
        with staged_for(staged, path):
            write(staged)
            sync_file(staged)
            os.replace(staged, path)
    finally:
        staged.unlink(missing_ok=True)
    sync_folder(path.parent)


def lock_within(handle: int, patience_s: float, busy: str, *, shared: bool = False) -> None:
    """Lock an open file or folder, waiting up to ``patience_s`` for it.

    Raises:
        BusyError: another process kept the lock for ``patience_s``; ``busy`` begins the message.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            platform.lock(handle, shared=shared, wait=False)
            return
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise BusyError(f"{busy} for {patience_s:g} s; try again later", code="lock_busy") from None
            time.sleep(0.01)


# --- below a folder that may be untrusted -----------------------------------------------------------------------------
# ``root`` itself may be a link (the user named it); entries below it may not. ``names`` are the parts of a path.


def remove_tree(root: Path, *names: str) -> None:
    """Delete a folder with its content, or a file, unless it is missing; delete links, never their targets.

    Raises:
        CorruptError: a folder on the path is a link, or a name is invalid.
        OSError: a system call failed.
    """
    with _parent_of(root, names) as parent:
        if parent is None or (mode := _mode(names[-1], parent)) is None:
            return
        if stat.S_ISDIR(mode):
            try:
                # By folder descriptors: follows no link, even if one is swapped in meanwhile.
                shutil.rmtree(names[-1], dir_fd=parent)
            except RecursionError as error:
                raise OSError(
                    f"{root.joinpath(*names)} has too many nested folders to be deleted: remove it by hand"
                ) from error
        else:
            os.unlink(names[-1], dir_fd=parent)


def remove_file(root: Path, *names: str) -> None:
    """Delete a file, or a link without its target, unless it is missing.

    Raises:
        CorruptError: a folder on the path is a link, or a name is invalid.
        OSError: a system call failed, or it is a folder.
    """
    with _parent_of(root, names) as parent:
        if parent is not None:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(names[-1], dir_fd=parent)


def remove_empty_folder(root: Path, *names: str) -> None:
    """Delete a folder if it is empty."""
    with _parent_of(root, names) as parent, contextlib.suppress(OSError):
        if parent is not None:
            os.rmdir(names[-1], dir_fd=parent)


def refuse_links(root: Path, *names: str) -> None:
    """Raise an error if any part of a path is a link; missing parts are allowed.

    Raises:
        CorruptError: a part is a link, or a name is invalid.
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
    """Return True for a folder, False for a link to a folder."""
    return _is(path, stat.S_ISDIR)


def is_file(path: Path) -> bool:
    """Return True for a plain file, False for a link to a file, a pipe or a device."""
    return _is(path, stat.S_ISREG)


def files_below(folder: Path) -> dict[str, os.stat_result]:
    """Return the `os.stat_result` of all entries below a folder except folders, by relative path.

    A link is listed as itself and not followed. Empty if the folder is missing or a link.
    """
    out: dict[str, os.stat_result] = {}
    todo = [""] if is_folder(folder) else []
    while todo:
        below = todo.pop()
        with contextlib.suppress(FileNotFoundError):  # may be deleted concurrently
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
    """Open a plain file for reading; never follow a link, and never wait for a pipe.

    Raises:
        CorruptError: not a plain file.
        OSError: a system call failed.
    """
    if not is_file(path):
        path.lstat()  # raises FileNotFoundError if it is missing
        raise CorruptError(
            f"{path} is not a regular file (but a link, folder, pipe or device): remove it",
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
    """Yield a descriptor of a path's parent folder below ``root``, opened without following links; None without one."""
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
            f"{name!r} is not a valid name of an entry in {root}; nothing was changed", code="invalid_stored_name"
        )
    return name


def _is_a_link(path: Path) -> CorruptError:
    return CorruptError(
        f"{path} is a link, and gsmap does not follow links here: replace it by the file or folder it points to",
        code="link_refused",
    )
