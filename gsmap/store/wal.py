"""SQLite's write-ahead log, read without SQLite: which pages it holds, and whether it lost anything that was committed.

https://www.sqlite.org/fileformat2.html#walformat. SQLite takes the frames up to the first that fails its checksum and
silently drops the rest: right for the torn end that a power cut leaves, wrong for a flipped bit in the middle.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

_HEADER = 32
_FRAME = 24
_MAGIC = 0x377F0682  # the last bit says that checksums are taken over big-endian words
_BLOCK_BYTES = 4 << 20
_INDEX_VERSION = 3_007_000


@dataclass(frozen=True)
class Log:
    """What a log holds.

    Args:
        frames: by page number (from 1), where its newest committed content begins in the log's file.
        num_pages: of the database after the last commit; 0 where nothing is committed.
        problem: what was committed and cannot be read any more, in words; empty for a sound log.
    """

    frames: dict[int, int] = field(default_factory=dict)
    num_pages: int = 0
    problem: str = ""


@dataclass(frozen=True)
class Noted:
    """What the log's index (``-shm``) says: how many frames are committed in the log that has this salt."""

    salt: bytes
    num_frames: int


def log_of(file: Path) -> Path:
    """Where the log of a database lies."""
    return file.with_name(file.name + "-wal")


def index_note(file: Path) -> Noted | None:
    """What the index of a database's log says of it; None where there is none, or one that says nothing.

    Only for a process that has no connection to the database: closing the index drops the locks of all of them.
    """
    try:
        content = file.with_name(file.name + "-shm").read_bytes()[:96]
    except OSError:
        return None
    if len(content) < 96 or content[:48] != content[48:]:
        return None
    version, _, _, is_init = struct.unpack("=IIIB", content[:13])
    (num_frames,) = struct.unpack("=I", content[16:20])
    return Noted(content[32:40], num_frames) if version == _INDEX_VERSION and is_init else None


def read_log(path: Path, noted: Noted | None = None, *, at_most: int | None = None) -> Log:
    """Read a log's every frame.

    A log has lost something where a commit beyond the first bad frame was followed by a later frame (which is written
    only once that commit is on the disk), or where its index has more frames than can be read. A torn end is no loss.

    Args:
        noted: what `index_note` said before anybody connected.
        at_most: look at so many frames only. What follows them may be of a commit whose fsync failed: it is whole, and
            taken back all the same.
    """
    try:
        with open(path, "rb", buffering=0) as opened:
            size = os.fstat(opened.fileno()).st_size
            return _read(opened.fileno(), size, noted, size if at_most is None else at_most)
    except FileNotFoundError:
        return Log()


def _read(handle: int, size: int, noted: Noted | None, at_most: int) -> Log:
    head = os.pread(handle, _HEADER, 0)
    if len(head) < _HEADER or not any(head):
        return Log()
    magic, version, page_size, _, salt, seed = struct.unpack(">IIII8s8s", head)
    big = magic & 1
    words = np.frombuffer(head, ">u4" if big else "<u4").astype(np.uint32)
    sound = magic & ~1 == _MAGIC and version == _INDEX_VERSION and 512 <= page_size <= 65536
    if not sound or _summed(words[None, :6])[0].tolist() != list(struct.unpack(">II", seed)):
        return Log(problem="its header is damaged" if size > _HEADER else "")
    committed = noted.num_frames if noted is not None and noted.salt == salt else 0

    frames: dict[int, int] = {}
    ahead: dict[int, int] = {}  # of a transaction whose commit has not been seen yet
    num_pages = good = at = 0
    broken = lost = False
    last = np.frombuffer(seed, ">u4").astype(np.uint32)
    computed = last
    last_commits = False
    for block in _blocks(handle, size, page_size):
        heads = block[:, :6].astype(np.uint32)  # big-endian words
        body = block[:, [0, 1, *range(6, block.shape[1])]]
        body = body.astype(np.uint32) if big else body.view("<u4").astype(np.uint32)
        own = _summed(body)
        seeds = np.concatenate([last[None], heads[:-1, 4:6]])
        sums = own + _advanced(seeds, body.shape[1] // 2)
        links = (sums == heads[:, 4:6]).all(1)
        ours = (heads[:, 2:4] == np.frombuffer(salt, ">u4")).all(1)
        for i, (page, after) in enumerate(heads[:, :2].tolist()):
            if at + i >= at_most:
                return Log(frames, num_pages)
            if not broken and links[i] and ours[i]:
                ahead[page] = _HEADER + (at + i) * (_FRAME + page_size) + _FRAME
                if after:
                    frames |= ahead
                    ahead.clear()
                    num_pages, good = after, at + i + 1
            else:
                chained = links[i]
                if broken and not chained:  # its stored checksum may be what is damaged
                    chained = (_advanced(computed[None], body.shape[1] // 2)[0] + own[i] == heads[i, 4:6]).all()
                lost |= bool(broken and last_commits and ours[i] and chained)
                broken = True
            last_commits, computed = after != 0, sums[i]
        last = heads[-1, 4:6]
        at += len(block)
    if lost or committed > good:
        return Log(frames, num_pages, f"its frame {good + 1} or one after it is damaged, and what follows is lost")
    return Log(frames, num_pages)


def _blocks(handle: int, size: int, page_size: int) -> Iterator[np.ndarray]:
    """The whole frames of a log in order, as rows of big-endian words."""
    step = _FRAME + page_size
    many = max(1, _BLOCK_BYTES // step)
    offset = _HEADER
    while offset + step <= size:
        content = os.pread(handle, step * many, offset)
        count = len(content) // step
        if not count:
            return
        yield np.frombuffer(content, ">u4", count * step // 4).reshape(count, step // 4)
        offset += count * step


def _summed(words: np.ndarray) -> np.ndarray:
    """(N, 2) checksums of N rows of words, each begun at 0."""
    weights = _weights(words.shape[1] // 2)
    return np.stack([(words * weights[i]).sum(1, dtype=np.uint32) for i in range(2)], axis=1)


def _advanced(seeds: np.ndarray, num_pairs: int) -> np.ndarray:
    """What (N, 2) checksums become after so many pairs of zeros."""
    (a, b), (c, d) = _power(num_pairs)
    return np.stack([seeds[:, 0] * a + seeds[:, 1] * b, seeds[:, 0] * c + seeds[:, 1] * d], axis=1)


@lru_cache(maxsize=8)
def _weights(num_pairs: int) -> np.ndarray:
    """(2, 2 * num_pairs) how much each word counts in the two sums.

    A pair (x, y) turns the sums (s, t) into (s + t + x, s + 2 t + x + y), modulo 2**32; that is linear, so that all
    frames are summed at once instead of word by word.
    """
    out = np.zeros((2, 2 * num_pairs), np.uint32)
    a, b, c, d = 1, 0, 0, 1  # the power of ((1, 1), (1, 2)) that the later pairs amount to
    for i in reversed(range(num_pairs)):
        out[:, 2 * i] = (a + b) & 0xFFFFFFFF, (c + d) & 0xFFFFFFFF
        out[:, 2 * i + 1] = b, d
        a, b, c, d = (v & 0xFFFFFFFF for v in (a + b, a + 2 * b, c + d, c + 2 * d))
    return out


@lru_cache(maxsize=8)
def _power(num_pairs: int) -> tuple[tuple[np.uint32, np.uint32], tuple[np.uint32, np.uint32]]:
    a, b, c, d = 1, 0, 0, 1
    for _ in range(num_pairs):
        a, b, c, d = (v & 0xFFFFFFFF for v in (a + b, a + 2 * b, c + d, c + 2 * d))
    return (np.uint32(a), np.uint32(b)), (np.uint32(c), np.uint32(d))
