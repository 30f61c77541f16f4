"""Read the ``.ksplat`` of mkkellogg's GaussianSplats3D: sections of buckets, in float32, half floats or bytes.

A header of 4096 bytes, one of 1024 for each section, then for each section the lengths of its partly filled buckets,
the centres of all buckets, and the splats. https://github.com/mkkellogg/GaussianSplats3D (src/loaders/SplatBuffer.js).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.quantise import logits_of_bytes
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Gaussians

VERSION = 1

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_MAX_SECTIONS = 1 << 14
_SH_VALUES = (0, 9, 24)  # of each degree that the format has
_SH_RANGE = 1.5  # half of it, where the file does not say
_TINY = np.finfo(np.float32).tiny
_HEADER = np.dtype(
    [
        ("version", "u1", 2),
        ("unused", "u1", 2),
        ("max_sections", "<u4"),
        ("sections", "<u4"),
        ("max_splats", "<u4"),
        ("splats", "<u4"),
        ("level", "<u2"),
        ("more", "<u2"),
        ("center", "<f4", 3),
        ("sh_range", "<f4", 2),
    ]
)
_SECTION = np.dtype(
    [
        ("splats", "<u4"),
        ("max_splats", "<u4"),
        ("bucket_size", "<u4"),
        ("buckets", "<u4"),
        ("block_size", "<f4"),
        ("bucket_bytes", "<u2"),
        ("unused", "<u2"),
        ("scale_range", "<u4"),
        ("bytes", "<u4"),
        ("full_buckets", "<u4"),
        ("partial_buckets", "<u4"),
        ("sh_degree", "<u2"),
    ]
)


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a ``.ksplat``; replace scales of zero by the smallest positive scale, and pad sections of lower SH degree.

    Raises:
        InputError: another version or compression level, truncated, or sections that do not fit the file.
    """
    size = Path(path).stat().st_size
    if size < _HEADER_BYTES:
        raise InputError(
            f"{path} is not a .ksplat: it has {size} bytes, fewer than the {_HEADER_BYTES} of the header",
            code="wrong_file_type",
        )
    header = np.fromfile(path, _HEADER, 1)[0]
    level, count = int(header["level"]), int(header["max_sections"])
    if tuple(header["version"]) != (0, 1) or level > 2:
        version = ".".join(map(str, header["version"]))
        raise InputError(
            f"{path}: .ksplat version {version}, compression level {level}; gsmap reads 0.1, levels 0 to 2",
            code="unsupported_version",
        )
    if not 0 < count <= _MAX_SECTIONS or _HEADER_BYTES + count * _SECTION_BYTES > size:
        raise InputError(
            f"{path}: {count} sections do not fit into its {size} bytes; it may be truncated", code="file_truncated"
        )
    low, high = (
        float(end) or standard for end, standard in zip(header["sh_range"], (-_SH_RANGE, _SH_RANGE), strict=True)
    )
    parts, at = [], _HEADER_BYTES + count * _SECTION_BYTES
    for i in range(count):
        begin = _HEADER_BYTES + i * _SECTION_BYTES
        section = _Section.of(path, np.fromfile(path, _SECTION, 1, offset=begin)[0], level)
        if at + section.num_bytes > size:
            raise InputError(
                f"{path}: section {i} would end at byte {at + section.num_bytes}, but the file has {size}; it may be "
                "truncated",
                code="file_truncated",
            )
        if section.splats:
            parts.append(section.read(path, np.fromfile(path, np.uint8, section.num_bytes, offset=at), (low, high)))
        at += section.num_bytes
    if not parts:
        raise InputError(f"{path} has no Gaussians", code="no_gaussians")
    if sum(map(len, parts)) != int(header["splats"]):
        raise InputError(
            f"{path}: its header promises {int(header['splats'])} Gaussians, its sections have {sum(map(len, parts))}",
            code="count_mismatch",
        )
    return Gaussians.concatenate(parts)


@dataclass(frozen=True)
class _Section:
    """The byte layout of a section."""

    level: int
    splats: int
    max_splats: int
    bucket_size: int
    buckets: int
    block_size: float
    bucket_bytes: int
    scale_range: int
    full_buckets: int
    partial_buckets: int
    sh_degree: int

    @classmethod
    def of(cls, path: str | os.PathLike[str], header: np.void, level: int) -> _Section:
        values = {name: header[name].item() for name in cls.__dataclass_fields__ if name != "level"}
        section = cls(level=level, **values)
        if section.sh_degree >= len(_SH_VALUES):
            raise InputError(
                f"{path}: SH degree {section.sh_degree}; a .ksplat has 0 to {len(_SH_VALUES) - 1}",
                code="unsupported_sh_degree",
            )
        if section.splats > section.max_splats:
            raise InputError(
                f"{path}: a section promises {section.splats} Gaussians, but has room for {section.max_splats}",
                code="count_mismatch",
            )
        if level and section.splats and not (section.bucket_bytes == 12 and section.buckets >= section.all_buckets > 0):
            raise InputError(
                f"{path}: {section.buckets} buckets of {section.bucket_bytes} bytes do not fit the Gaussians of their "
                "section",
                code="invalid_buckets",
            )
        return section

    @property
    def all_buckets(self) -> int:
        return self.full_buckets + self.partial_buckets

    @property
    def row(self) -> np.dtype:
        number = ("<f4", "<u2", "<u2")[self.level], ("<f4", "<f2", "<f2")[self.level], ("<f4", "<f2", "u1")[self.level]
        fields = [("mean", number[0], 3), ("scale", number[1], 3), ("quat", number[1], 4), ("rgba", "u1", 4)]
        return np.dtype([*fields, ("sh", number[2], _SH_VALUES[self.sh_degree])])

    @property
    def num_bytes(self) -> int:
        return 4 * self.partial_buckets + self.bucket_bytes * self.buckets + self.row.itemsize * self.max_splats

    def read(self, path: str | os.PathLike[str], data: np.ndarray, sh_range: tuple[float, float]) -> Gaussians:
        """Read the Gaussians in the bytes of a section."""
        begin = 4 * self.partial_buckets + self.bucket_bytes * self.buckets
        rows = data[begin : begin + self.row.itemsize * self.splats].view(self.row)
        means: np.ndarray = rows["mean"].astype(np.float32)
        if self.level:
            steps = self.scale_range or 32767
            means = (means - steps) * np.float32(self.block_size / 2 / steps) + self._centres(path, data)
        sh = np.zeros((self.splats, (self.sh_degree + 1) ** 2, 3), np.float32)
        rest: np.ndarray = rows["sh"].astype(np.float32)
        if self.level == 2:
            rest = rest / 255 * (sh_range[1] - sh_range[0]) + sh_range[0]
        sh[:, 0] = sh0_of_rgb(rows["rgba"][:, :3].astype(np.float32) / 255)
        for degree in range(1, self.sh_degree + 1):  # channel by channel within each degree
            a, b = _SH_VALUES[degree - 1], _SH_VALUES[degree]
            sh[:, degree**2 : (degree + 1) ** 2] = rest[:, a:b].reshape(self.splats, 3, -1).transpose(0, 2, 1)
        scales = rows["scale"].astype(np.float32)
        quats = rows["quat"].astype(np.float32)
        quats[~quats.any(1), 0] = 1
        log_scales = np.log(np.where(scales == 0, _TINY, scales))  # a negative one becomes NaN, which validation names
        return Gaussians(means, quats, log_scales, logits_of_bytes(rows["rgba"][:, 3]), sh)

    def _centres(self, path: str | os.PathLike[str], data: np.ndarray) -> np.ndarray:
        """Return the centre (N, 3) of each Gaussian's bucket; full buckets precede partly filled buckets."""
        partial = data[: 4 * self.partial_buckets].view("<u4").astype(np.int64)
        sizes = np.concatenate([np.full(self.full_buckets, self.bucket_size, np.int64), partial])
        if int(sizes.sum()) < self.splats or (sizes > self.splats).any():
            raise InputError(
                f"{path}: the buckets of a section hold {int(sizes.sum())} Gaussians, but it promises {self.splats}",
                code="invalid_buckets",
            )
        begin = 4 * self.partial_buckets
        centres = data[begin : begin + 12 * len(sizes)].view("<f4").reshape(-1, 3)
        return np.repeat(centres, sizes, axis=0)[: self.splats]
