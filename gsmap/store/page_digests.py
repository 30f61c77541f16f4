"""Keep ``map.sqlite.digests``, which has a digest of every page of the catalog file beside it.

SQLite has no page checksums of its own. The file changes only in a checkpoint, under the writer lock, and its new
content is in the write-ahead log. So the digests from before and after are written first, and until the checkpoint ends
a page may match either: killed at any time, the file is verifiable, and damage is never taken for written data. The
digests hold no time or path, so that a copy of the map is verifiable as well.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import struct
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from gsmap.durable import write_whole
from gsmap.errors import CorruptError
from gsmap.store.file_handles import FileHandle
from gsmap.store.wal import WalContent, read_log, wal_path

_MAGIC = b"gsmap page digests 1\n"
_SIZE = 16  # bytes of BLAKE2b: detects disk errors, not forgery
WHOLE_BYTES = 256 << 20
"""Largest size of a file that is verified when it is opened or written; only ``gsmap check`` verifies longer files."""
_BLOCK_BYTES = 1 << 20
_HEADER = struct.Struct("<4I")
_ENTRY = struct.Struct("<I16s")


@dataclass(frozen=True)
class PageDigests:
    """Digests of the pages of a catalog file.

    Args:
        page_size: in bytes.
        pages: digest of each page, concatenated.
        next_count: number of pages after the checkpoint in progress; 0 if none is in progress.
        next: digests of the pages that the checkpoint changes, by number (from 1).
    """

    page_size: int
    pages: bytes
    next_count: int = 0
    next: dict[int, bytes] = field(default_factory=dict)

    @property
    def count(self) -> int:
        return len(self.pages) // _SIZE

    def page(self, number: int) -> bytes:
        return self.pages[(number - 1) * _SIZE : number * _SIZE]


def digests_path(file: Path) -> Path:
    """Return the path of the digests of a database."""
    return file.with_name(file.name + ".digests")


def legacy_digest_path(file: Path) -> Path:
    """Return the path of the digest of a whole database, as gsmap before schema 0003 wrote it."""
    return file.with_name(file.name + ".sha256")


def load(file: Path) -> PageDigests | None:
    """Load the page digests of a database; None without page digests.

    Raises:
        CorruptError: the digests are damaged.
    """
    path = digests_path(file)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    body, own = content[:-_SIZE], content[-_SIZE:]
    start = len(_MAGIC) + _HEADER.size
    if body.startswith(_MAGIC) and _digest(body) == own and len(body) >= start:
        page_size, count, next_count, changed = _HEADER.unpack_from(body, len(_MAGIC))
        end = start + count * _SIZE
        if len(body) == end + changed * _ENTRY.size:
            return PageDigests(page_size, body[start:end], next_count, dict(_ENTRY.iter_unpack(body[end:])))
    raise CorruptError(
        f"{path} is damaged, so the catalog cannot be verified: restore it from a backup, or accept the catalog as "
        f"it is with gsmap check {file.parent} --accept-catalog",
        code="catalog_damaged",
    )


def save(file: Path, digests: PageDigests) -> None:
    """Replace the digests of a database durably; delete digests of older releases and leftovers of killed processes.

    Requires the writer lock, or a database that no other process uses yet.
    """
    for left in file.parent.glob(f".{digests_path(file).name}.*"):
        left.unlink()
    head = _HEADER.pack(digests.page_size, digests.count, digests.next_count, len(digests.next))
    body = b"".join([_MAGIC, head, digests.pages, *(_ENTRY.pack(*entry) for entry in sorted(digests.next.items()))])
    write_whole(digests_path(file), lambda staged: staged.write_bytes(body + _digest(body)))
    legacy_digest_path(file).unlink(missing_ok=True)
    legacy_digest_path(file).with_name(f".{legacy_digest_path(file).name}").unlink(missing_ok=True)


def write_digests(file: Path) -> None:
    """Write the digests of a new database that has no log and no other users."""
    with contextlib.closing(FileHandle(file)) as handle:
        save(file, _digest_file(handle))


def find_backup_digests(file: Path, handle: FileHandle) -> PageDigests | None:
    """Return the digests of the ``*.bak`` file that a person put in place of the database; None if there is none."""
    for path in sorted(file.parent.glob(f"{file.name}.*.bak.digests")):
        stored = load(path.with_suffix(""))
        if stored is not None and _digest_file(handle, stored).pages == stored.pages:
            return stored
    return None


def problems(file: Path, handle: FileHandle, stored: PageDigests | None, log: WalContent) -> list[str]:
    """Return a message for each difference between a database or its log and the digests; empty without digests.

    Args:
        log: content of the log. Pages in it may be torn in the file while a checkpoint is in progress.
    """
    return _problems(file, handle, stored, log, _digest_file(handle, stored))


def differing_pages(now: bytes, stored: PageDigests, in_wal: Collection[int] = ()) -> list[int]:
    """Return the numbers of pages that match neither the digests before the checkpoint nor the digests after it.

    Args:
        now: digests of the file as it is.
        in_wal: pages in the log, which are read from there and will be written again.
    """
    if now == stored.pages:
        return []
    seen = len(now) // _SIZE
    found = []
    for number in range(1, seen + 1):
        digest = now[(number - 1) * _SIZE : number * _SIZE]
        if digest != stored.page(number) and not _may_have_digest(stored, number, digest, in_wal):
            found.append(number)
    expected = max(stored.count, stored.next_count)
    return found + [number for number in range(seen + 1, expected + 1) if not _may_be_missing(stored, number, in_wal)]


def _problems(
    file: Path, handle: FileHandle, stored: PageDigests | None, log: WalContent, now: PageDigests
) -> list[str]:
    out = [f"in its log {log.problem}"] if log.problem else []
    if stored is None:
        return out + _legacy_problems(file, handle)
    found = differing_pages(now.pages, stored, log.frames)
    verb = "differs" if len(found) == 1 else "differ"
    return out + ([f"{format_pages(found)} of {file.name} {verb} from what gsmap wrote"] if found else [])


def accept(file: Path, handle: FileHandle) -> None:
    """Write digests of a file in its current state, which must have no log; the caller must hold the writer lock."""
    save(file, _digest_file(handle))


def fold(
    file: Path, handle: FileHandle, begin: Callable[[], int], finish: Callable[[], bool], *, accept: bool = False
) -> None:
    """Checkpoint the log while the digests stay valid at every moment; the caller must hold the writer lock.

    Args:
        begin: runs a passive checkpoint and returns the number of committed frames in the log; negative if another
            process prevented it.
        finish: completes the checkpoint and empties the log; returns False if readers prevented it.
        accept: accept the pages as they are.

    Raises:
        CorruptError: the file or the log differs from its digests. The log is kept, so that nothing is lost.
    """
    log = read_log(wal_path(file), handle.index)
    stored = None if accept else load(file)
    if stored is None or stored.next_count or os.fstat(handle.number).st_size <= WHOLE_BYTES:
        before = _digest_file(handle, stored)
    else:  # unchanged pages keep their digests, right or wrong
        before = _update_digests(handle, stored, log.frames)
    if not accept:
        found = _problems(file, handle, stored, log, before)
        if found:
            raise CorruptError(damage_message(file, found), code="catalog_damaged")
    changed = _digest_wal(file, log, before.page_size)
    save(file, PageDigests(before.page_size, before.pages, log.num_pages or before.count, changed))
    num_frames = begin()
    committed = read_log(wal_path(file), handle.index, at_most=num_frames) if num_frames >= 0 else log
    if committed != log:  # a commit failed to synchronize, and SQLite rolled it back
        log, changed = committed, _digest_wal(file, committed, before.page_size)
    if finish():
        save(file, _digests_after_checkpoint(handle, before, log, changed))


def _digest_wal(file: Path, log: WalContent, page_size: int) -> dict[int, bytes]:
    """Compute the digests of the pages in a log."""
    found = {}
    if log.frames:
        with open(wal_path(file), "rb") as opened:
            for number, offset in log.frames.items():
                opened.seek(offset)
                found[number] = _digest(opened.read(page_size))
    return found


def damage_message(file: Path, found: Iterable[str]) -> str:
    """Return the message for a damaged catalog."""
    return (
        f"{file.parent}: the catalog is damaged: {'; '.join(found)}: restore {file.name} from a backup (or "
        f"accept it as it is: gsmap check {file.parent} --accept-catalog)"
    )


def format_pages(numbers: list[int]) -> str:
    """Format page numbers, runs of consecutive numbers as ranges."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    words = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    listed = ", ".join(words[:8]) + (f" and {len(words) - 8} more places" if len(words) > 8 else "")
    return f"{'page' if len(numbers) == 1 else 'pages'} {listed}"


def _may_have_digest(stored: PageDigests, number: int, digest: bytes, in_wal: Collection[int]) -> bool:
    """Return True if a page may have this digest because a checkpoint is in progress."""
    if not stored.next_count:
        return False
    new = stored.next.get(number)
    if new is None:  # SQLite omits unused pages
        return stored.count < number <= stored.next_count
    return digest == new or number in in_wal


def _may_be_missing(stored: PageDigests, number: int, in_wal: Collection[int]) -> bool:
    """Return True if a page may be missing at the end of the file because a checkpoint is in progress."""
    if not stored.next_count:
        return False
    return number > stored.next_count or (number > stored.count and (number not in stored.next or number in in_wal))


def _digest_file(handle: FileHandle, stored: PageDigests | None = None) -> PageDigests:
    """Compute the digests of a file in its current state."""
    size = stored.page_size if stored is not None else page_size(handle)
    many = max(1, _BLOCK_BYTES // size) * size
    digests: list[bytes] = []
    while content := os.pread(handle.number, many, len(digests) * size):
        block = memoryview(content)
        digests += [_digest(block[i : i + size]) for i in range(0, len(content), size)]
    return PageDigests(size, b"".join(digests))


def _update_digests(handle: FileHandle, stored: PageDigests, numbers: Iterable[int]) -> PageDigests:
    """Recompute the digests of some pages from the file."""
    renewed = bytearray(stored.pages)
    for number in numbers:
        if number <= stored.count:
            content = os.pread(handle.number, stored.page_size, (number - 1) * stored.page_size)
            renewed[(number - 1) * _SIZE : number * _SIZE] = _digest(content)
    return PageDigests(stored.page_size, bytes(renewed))


def _digests_after_checkpoint(
    handle: FileHandle, before: PageDigests, log: WalContent, changed: dict[int, bytes]
) -> PageDigests:
    """Return the digests after the checkpoint: of pages in the log from there, others from ``before`` or the file."""
    count = log.num_pages or before.count
    digests = [before.page(i + 1) for i in range(min(count, before.count))] + [b""] * (count - before.count)
    for number, digest in changed.items():
        if number <= count:
            digests[number - 1] = digest
    for i, digest in enumerate(digests):
        if not digest:
            digests[i] = _digest(os.pread(handle.number, before.page_size, i * before.page_size))
    return PageDigests(before.page_size, b"".join(digests))


def page_size(handle: FileHandle) -> int:
    """Return the page size of a database, from its header."""
    size = int.from_bytes(os.pread(handle.number, 2, 16), "big")
    return 65536 if size == 1 else size or 4096


def _digest(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=_SIZE).digest()


def _legacy_problems(file: Path, handle: FileHandle) -> list[str]:
    """Compare the file with the digest of an older release, unless its size or time changed since."""
    path = legacy_digest_path(file)
    try:
        then = json.loads(path.read_text())
        stamp = then["size_bytes"], then["mtime_ns"]
        sha256 = str(then["sha256"])
    except FileNotFoundError:
        return []
    except (ValueError, KeyError, TypeError):
        return [f"{path.name} is damaged"]
    found = os.fstat(handle.number)
    if (found.st_size, found.st_mtime_ns) != stamp:
        return []
    now = hashlib.sha256()
    at = 0
    while content := os.pread(handle.number, _BLOCK_BYTES, at):
        now.update(content)
        at += len(content)
    return [] if now.hexdigest() == sha256 else [f"{file.name} differs from what gsmap wrote"]
