"""Read SQLite's write-ahead log; find its pages and any lost commits.

https://www.sqlite.org/fileformat2.html#walformat. SQLite reads frames up to the first with a wrong checksum and
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
class WalContent:
    """The content of a write-ahead log.

    Args:
        frames: offset of the newest committed content of each page in the log file, by page number (from 1).
        num_pages: of the database after the last commit; 0 if nothing is committed.
        problem: description of lost commits; empty for a sound log.
    """

    frames: dict[int, int] = field(default_factory=dict)
    num_pages: int = 0
    problem: str = ""


@dataclass(frozen=True)
class IndexHeader:
    """The header of the log's index (``-shm``): the number of committed frames of the log with some salt."""

    salt: bytes
    num_frames: int


def wal_path(file: Path) -> Path:
    """Return the path of the log of a database."""
    return file.with_name(file.name + "-wal")


def read_index_header(file: Path) -> IndexHeader | None:
    """Read the header of the index of a database's log; None if it is missing or not initialized.

    Only for a process without a connection to the database: closing the index drops the locks of all connections.
    """
    try:
        content = file.with_name(file.name + "-shm").read_bytes()[:96]
    except OSError:
        return None
    if len(content) < 96 or content[:48] != content[48:]:
        return None
    version, _, _, is_init = struct.unpack("=IIIB", content[:13])
    (num_frames,) = struct.unpack("=I", content[16:20])
    return IndexHeader(content[32:40], num_frames) if version == _INDEX_VERSION and is_init else None


def read_log(path: Path, header: IndexHeader | None = None, *, at_most: int | None = None) -> WalContent:
    """Read all frames of a log.

    A log has lost a commit if a later frame follows a commit beyond the first bad frame (frames are written only once
    the previous commit is on disk), or if its index has more frames than can be read. A torn end is no loss.

    Args:
        header: of the index, read before this process connected.
        at_most: number of frames to read. Later frames may be of a commit whose fsync failed, which is complete but
            rolled back.
    """
    try:
        with open(path, "rb", buffering=0) as opened:
            size = os.fstat(opened.fileno()).st_size
            return _read(opened.fileno(), size, header, size if at_most is None else at_most)
    except FileNotFoundError:
        return WalContent()


def _read(handle: int, size: int, header: IndexHeader | None, at_most: int) -> WalContent:
    head = os.pread(handle, _HEADER, 0)
    if len(head) < _HEADER or not any(head):
        return WalContent()
    magic, version, page_size, _, salt, seed = struct.unpack(">IIII8s8s", head)
    big = magic & 1
    words = np.frombuffer(head, ">u4" if big else "<u4").astype(np.uint32)
    sound = magic & ~1 == _MAGIC and version == _INDEX_VERSION and 512 <= page_size <= 65536
    if not sound or _summed(words[None, :6])[0].tolist() != list(struct.unpack(">II", seed)):
        return WalContent(problem="its header is damaged" if size > _HEADER else "")
    committed = header.num_frames if header is not None and header.salt == salt else 0

    frames: dict[int, int] = {}
    ahead: dict[int, int] = {}  # frames of a transaction without a commit so far
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
                return WalContent(frames, num_pages)
            if not broken and links[i] and ours[i]:
                ahead[page] = _HEADER + (at + i) * (_FRAME + page_size) + _FRAME
                if after:
                    frames |= ahead
                    ahead.clear()
                    num_pages, good = after, at + i + 1
            else:
                chained = links[i]
                if broken and not chained:  # its stored checksum may be the damaged part
                    chained = (_advanced(computed[None], body.shape[1] // 2)[0] + own[i] == heads[i, 4:6]).all()
                lost |= bool(broken and last_commits and ours[i] and chained)
                broken = True
            last_commits, computed = after != 0, sums[i]
        last = heads[-1, 4:6]
        at += len(block)
    if lost or committed > good:
        return WalContent(
            frames, num_pages, f"its frame {good + 1} or a later one is damaged, and the frames after it are lost"
        )
    return WalContent(frames, num_pages)


def _blocks(handle: int, size: int, page_size: int) -> Iterator[np.ndarray]:
    """Yield blocks of complete frames of a log in order, as rows of big-endian words."""
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
    """Compute the checksum of each of N rows of words by itself; return (N, 2)."""
    weights = _weights(words.shape[1] // 2)
    return np.stack([(words * weights[i]).sum(1, dtype=np.uint32) for i in range(2)], axis=1)


def _advanced(seeds: np.ndarray, num_pairs: int) -> np.ndarray:
    """Advance checksums (N, 2) by a number of pairs of zero words."""
    (a, b), (c, d) = _power(num_pairs)
    return np.stack([seeds[:, 0] * a + seeds[:, 1] * b, seeds[:, 0] * c + seeds[:, 1] * d], axis=1)


@lru_cache(maxsize=8)
def _weights(num_pairs: int) -> np.ndarray:
    """Compute the weights (2, 2 * num_pairs) of each word in the two sums.

    A pair (x, y) turns the sums (s, t) into (s + t + x, s + 2 t + x + y), modulo 2**32; that is linear, so that all
    frames are summed at once instead of word by word.
    """
    out = np.zeros((2, 2 * num_pairs), np.uint32)
    a, b, c, d = 1, 0, 0, 1  # power of ((1, 1), (1, 2)) for the later pairs
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
