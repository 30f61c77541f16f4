"""``map.sqlite.digests``: a digest of every page of the catalog's file, kept beside it.

SQLite has no checksums of its own. The file changes only when the log is folded in, under the writer lock, and what it
will be then is in the log. So the digests are written first, those from before and those from afterwards, and a page
may be either until the log is folded in: killed anywhere, what is there is verified, and damage is never taken for
something that was written. There is no time and no place in it, so that a copy of the map is verified as well.
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
from gsmap.store.handles import Handle
from gsmap.store.wal import Log, log_of, read_log

_MAGIC = b"gsmap page digests 1\n"
_SIZE = 16  # bytes of BLAKE2b: nobody forges them here, a disk that errs is to be found out
WHOLE_BYTES = 256 << 20
"""A longer file is read through by ``gsmap check`` alone, not whenever it is opened or written: that takes seconds."""
_BLOCK_BYTES = 1 << 20
_HEADER = struct.Struct("<4I")
_ENTRY = struct.Struct("<I16s")


@dataclass(frozen=True)
class Digests:
    """What the file's pages are.

    Args:
        page_size: in bytes.
        pages: a digest of each page, one after the other.
        next_count: how many pages there will be once the log is folded in; 0 where nobody is folding it in.
        next: the digests of pages that this changes, by number (from 1).
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


def digests_of(file: Path) -> Path:
    """Where the digests of a database lie."""
    return file.with_name(file.name + ".digests")


def older_digest_of(file: Path) -> Path:
    """Where gsmap before schema 0003 noted one digest of the whole file."""
    return file.with_name(file.name + ".sha256")


def load(file: Path) -> Digests | None:
    """The digests of a database; None where there are none.

    Raises:
        CorruptError: they are damaged themselves.
    """
    path = digests_of(file)
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
            return Digests(page_size, body[start:end], next_count, dict(_ENTRY.iter_unpack(body[end:])))
    raise CorruptError(
        f"{path} is damaged, so that the catalog cannot be verified: restore it from a backup, or take the catalog as "
        f"it is with gsmap check {file.parent} --accept-catalog",
        code="catalog_damaged",
    )


def save(file: Path, digests: Digests) -> None:
    """Replace the digests of a database, durably; the note of an older gsmap goes, and what a kill left of an attempt.

    One at a time: under the writer lock, or where nobody else knows of the database yet.
    """
    for left in file.parent.glob(f".{digests_of(file).name}.*"):
        left.unlink()
    head = _HEADER.pack(digests.page_size, digests.count, digests.next_count, len(digests.next))
    body = b"".join([_MAGIC, head, digests.pages, *(_ENTRY.pack(*entry) for entry in sorted(digests.next.items()))])
    write_whole(digests_of(file), lambda staged: staged.write_bytes(body + _digest(body)))
    older_digest_of(file).unlink(missing_ok=True)
    older_digest_of(file).with_name(f".{older_digest_of(file).name}").unlink(missing_ok=True)


def note(file: Path) -> None:
    """Take a database that has no log and that nobody else uses for what was written (one that was just made)."""
    with contextlib.closing(Handle(file)) as handle:
        save(file, _of_file(handle))


def is_backup(file: Path, handle: Handle) -> Digests | None:
    """The digests of the backup that lies in the place of a database, if it is one of those beside it (``*.bak``)."""
    for path in sorted(file.parent.glob(f"{file.name}.*.bak.digests")):
        noted = load(path.with_suffix(""))
        if noted is not None and _of_file(handle, noted).pages == noted.pages:
            return noted
    return None


def problems(file: Path, handle: Handle, noted: Digests | None, log: Log) -> list[str]:
    """What in a database's file or log differs from what was written; nothing is said of a file without digests.

    Args:
        log: what its log holds. Pages that the log is about to write again may be torn, if somebody is folding it in.
    """
    return _found(file, handle, noted, log, _of_file(handle, noted))


def differing(now: bytes, noted: Digests, covered: Collection[int] = ()) -> list[int]:
    """Numbers of the pages that are neither what they were nor what they are about to be.

    Args:
        now: the digests of the file as it is.
        covered: pages that the log holds, which are read from there and will be written again.
    """
    if now == noted.pages:
        return []
    seen = len(now) // _SIZE
    found = []
    for number in range(1, seen + 1):
        digest = now[(number - 1) * _SIZE : number * _SIZE]
        if digest != noted.page(number) and not _may_be(noted, number, digest, covered):
            found.append(number)
    expected = max(noted.count, noted.next_count)
    return found + [number for number in range(seen + 1, expected + 1) if not _may_lack(noted, number, covered)]


def _found(file: Path, handle: Handle, noted: Digests | None, log: Log, now: Digests) -> list[str]:
    out = [f"in its log {log.problem}"] if log.problem else []
    if noted is None:
        return out + _older_problems(file, handle)
    found = differing(now.pages, noted, log.frames)
    verb = "differs" if len(found) == 1 else "differ"
    return out + ([f"{pages(found)} of {file.name} {verb} from what gsmap wrote"] if found else [])


def accept(file: Path, handle: Handle) -> None:
    """Take a file that has no log as it is for what was written; only under the writer lock."""
    save(file, _of_file(handle))


def fold(
    file: Path, handle: Handle, begin: Callable[[], int], finish: Callable[[], bool], *, accept: bool = False
) -> None:
    """Fold the log in, and keep the digests true of the file at every moment; only under the writer lock.

    Args:
        begin: lets SQLite do what it can at once; how many frames of the log it holds for committed;
            below 0 where another process kept it from looking.
        finish: lets it do the rest and empty the log; False where readers kept it from getting to the end.
        accept: take the pages that are there for what was written, whatever they are.

    Raises:
        CorruptError: the file or the log is not what was written. Nothing was folded in, so that nothing is lost.
    """
    log = read_log(log_of(file), handle.index)
    noted = None if accept else load(file)
    if noted is None or noted.next_count or os.fstat(handle.number).st_size <= WHOLE_BYTES:
        before = _of_file(handle, noted)
    else:  # pages that stay as they are keep their digests, right or wrong
        before = _renewed(handle, noted, log.frames)
    if not accept:
        found = _found(file, handle, noted, log, before)
        if found:
            raise CorruptError(damaged(file, found), code="catalog_damaged")
    changed = _of_log(file, log, before.page_size)
    save(file, Digests(before.page_size, before.pages, log.num_pages or before.count, changed))
    num_frames = begin()
    committed = read_log(log_of(file), handle.index, at_most=num_frames) if num_frames >= 0 else log
    if committed != log:  # a commit could not be synchronised, and SQLite has taken it back
        log, changed = committed, _of_log(file, committed, before.page_size)
    if finish():
        save(file, _after(handle, before, log, changed))


def _of_log(file: Path, log: Log, page_size: int) -> dict[int, bytes]:
    """The digests of the pages that a log holds."""
    found = {}
    if log.frames:
        with open(log_of(file), "rb") as opened:
            for number, offset in log.frames.items():
                opened.seek(offset)
                found[number] = _digest(opened.read(page_size))
    return found


def damaged(file: Path, found: Iterable[str]) -> str:
    """The line for a person whose catalog is not what was written."""
    return (
        f"{file.parent}: the catalog is damaged: {'; '.join(found)}: restore {file.name} from a backup (or take it as "
        f"it is: gsmap check {file.parent} --accept-catalog)"
    )


def pages(numbers: list[int]) -> str:
    """Page numbers in words, runs as one."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    words = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    listed = ", ".join(words[:8]) + (f" and {len(words) - 8} more places" if len(words) > 8 else "")
    return f"{'page' if len(numbers) == 1 else 'pages'} {listed}"


def _may_be(noted: Digests, number: int, digest: bytes, covered: Collection[int]) -> bool:
    """Whether a page may have this digest because the log is being folded in."""
    if not noted.next_count:
        return False
    new = noted.next.get(number)
    if new is None:  # SQLite leaves out a page that holds nothing
        return noted.count < number <= noted.next_count
    return digest == new or number in covered


def _may_lack(noted: Digests, number: int, covered: Collection[int]) -> bool:
    """Whether a page may be beyond the end of the file."""
    if not noted.next_count:
        return False
    return number > noted.next_count or (number > noted.count and (number not in noted.next or number in covered))


def _of_file(handle: Handle, noted: Digests | None = None) -> Digests:
    """The digests of a file as it is."""
    size = noted.page_size if noted is not None else page_size(handle)
    many = max(1, _BLOCK_BYTES // size) * size
    digests: list[bytes] = []
    while content := os.pread(handle.number, many, len(digests) * size):
        block = memoryview(content)
        digests += [_digest(block[i : i + size]) for i in range(0, len(content), size)]
    return Digests(size, b"".join(digests))


def _renewed(handle: Handle, noted: Digests, numbers: Iterable[int]) -> Digests:
    """Digests with those of some pages taken anew from the file."""
    renewed = bytearray(noted.pages)
    for number in numbers:
        if number <= noted.count:
            content = os.pread(handle.number, noted.page_size, (number - 1) * noted.page_size)
            renewed[(number - 1) * _SIZE : number * _SIZE] = _digest(content)
    return Digests(noted.page_size, bytes(renewed))


def _after(handle: Handle, before: Digests, log: Log, changed: dict[int, bytes]) -> Digests:
    """The digests once the log was folded in, by what was to be written; what nobody wrote is taken as it is."""
    count = log.num_pages or before.count
    digests = [before.page(i + 1) for i in range(min(count, before.count))] + [b""] * (count - before.count)
    for number, digest in changed.items():
        if number <= count:
            digests[number - 1] = digest
    for i, digest in enumerate(digests):
        if not digest:
            digests[i] = _digest(os.pread(handle.number, before.page_size, i * before.page_size))
    return Digests(before.page_size, b"".join(digests))


def page_size(handle: Handle) -> int:
    """Of a database, from its header."""
    size = int.from_bytes(os.pread(handle.number, 2, 16), "big")
    return 65536 if size == 1 else size or 4096


def _digest(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=_SIZE).digest()


def _older_problems(file: Path, handle: Handle) -> list[str]:
    """By the note of an older gsmap, as long as nothing has touched the file since (a bad disk leaves its time)."""
    path = older_digest_of(file)
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
