"""Read checkpoints of trainers: gsplat's ``.pt``, nerfstudio's ``.ckpt``, gaussian-splatting's ``.pth``.

Read by ``torch.load(weights_only=True)``, which runs no code of the file, and mapped: what is not asked for is not
read. Frames are the trainer's own, right-down-front; nerfstudio turns and scales a capture before it trains
(``dataparser_transforms.json``), and so do what its checkpoints hold.
"""

from __future__ import annotations

import os
import pickle
import struct
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, InputError, NotGaussiansError
from gsmap.formats.quantise import check_size
from gsmap.geometry.origins import centred
from gsmap.types import FileInfo, Gaussians
from gsmap.types.tensors import require_torch

VERSION = 2

_MAX_PICKLE_BYTES = 32 << 20
_MAX_DEPTH = 6  # of tables in tables that are looked through
_FIELDS = {
    "means": ("means", "xyz"),
    "quats": ("quats", "rotation"),
    "log_scales": ("scales", "scaling"),
    "logit_opacities": ("opacities", "opacity"),
    "sh0": ("sh0", "features_dc"),
    "shN": ("shN", "features_rest"),
}
_TUPLE = ("", "xyz", "features_dc", "features_rest", "scaling", "rotation", "opacity")  # gaussian-splatting's capture()
_REQUIRED = ("means", "quats", "log_scales", "logit_opacities", "sh0")


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the Gaussians of a checkpoint.

    Raises:
        InputError: Not a checkpoint in torch's ZIP layout, content other than weights, no Gaussians, or
            tensors that do not fit together.
    """
    found = _tensors(path, _loaded(path))
    missing = [name for name in _REQUIRED if name not in found]
    if missing:
        held = ", ".join(sorted(found)) or "none of the tensors of a splat"
        raise NotGaussiansError(f"{path} holds no Gaussians: it has {held} and lacks {', '.join(missing)}")
    n = len(found["means"])
    size = os.path.getsize(path)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh0": (1, 3)}
    arrays = {}
    for name, shape in shapes.items():
        arrays[name] = _array(path, name, found[name], n, shape, size)
    sh = arrays["sh0"]
    if "shN" in found:
        rest = _array(path, "shN", found["shN"], n, (-1, 3), size)
        if rest.shape[1] not in (0, 3, 8, 15):
            raise InputError(
                f"{path}: {rest.shape[1]} SH coefficients; gsmap reads degrees 0 to 3 (0, 3, 8 or 15)",
                code="unsupported_sh_degree",
            )
        sh = np.concatenate([sh, rest], axis=1)
    means, origin = centred(arrays["means"])
    return Gaussians(means, arrays["quats"], arrays["log_scales"], arrays["logit_opacities"], sh, origin)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return a note that the frame of a nerfstudio checkpoint differs from the frame of its camera file."""
    if Path(path).suffix.lower() != ".ckpt":
        return FileInfo()
    return FileInfo(
        notes=(
            f"{Path(path).name} is in the frame of nerfstudio's dataparser, not in that of the cameras: see "
            "dataparser_transforms.json",
        )
    )


def _loaded(path: str | os.PathLike[str]) -> Any:
    """Load a checkpoint with ``torch.load(weights_only=True)``, after checking its container."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, EOFError, *MALFORMED) as error:
        raise InputError(
            f"{path} is not a checkpoint in the ZIP layout of torch 1.6 or newer ({error}); "
            "load it with torch and save it again, or export a .ply",
            code="wrong_file_type",
        ) from error
    for entry in entries:
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
            raise InputError(
                f"{path}: {entry.filename!r} is compressed, which torch never does: damaged or hostile",
                code="file_damaged",
            )
        if entry.filename.endswith(".pkl") and entry.file_size > _MAX_PICKLE_BYTES:
            raise InputError(
                f"{path}: its {entry.filename!r} is more than {_MAX_PICKLE_BYTES >> 20} MiB", code="file_too_large"
            )
    if not any(entry.filename.endswith("/data.pkl") for entry in entries):
        raise InputError(f"{path} is a ZIP file, but no torch checkpoint: it has no data.pkl", code="wrong_file_type")
    torch = require_torch("checkpoints")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (
        struct.error,
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        AssertionError,
        ImportError,
        *MALFORMED,
    ) as error:
        text = str(error).split("\n")[0]
        raise InputError(
            f"{path} contains more than weights, and gsmap does not run code from files: {text}; export a .ply",
            code="unsupported_pickle",
        ) from error


def _tensors(path: str | os.PathLike[str], loaded: Any) -> dict[str, Any]:
    """Find the tensors of the Gaussians in a checkpoint; return them by field of `Gaussians`."""
    if isinstance(loaded, tuple | list) and loaded and isinstance(loaded[0], tuple | list):  # (capture(), iteration)
        loaded = dict(zip(_TUPLE, loaded[0], strict=False))
    names = {name: ours for ours, all_names in _FIELDS.items() for name in all_names}
    found: dict[str, Any] = {}
    todo: list[tuple[Any, int]] = [(loaded, 0)]
    while todo:
        table, depth = todo.pop(0)
        if not isinstance(table, Mapping) or depth > _MAX_DEPTH:
            continue
        for name, value in table.items():
            if not isinstance(name, str) or name in ("optimizers", "schedulers", "scalers"):
                continue
            ours = names.get(name.rsplit(".", 1)[-1])
            if ours is not None and hasattr(value, "stride"):
                if ours in found:
                    raise InputError(
                        f"{path} holds {name!r} twice, so it has more than one splat: export one splat as .ply",
                        code="unsupported_feature",
                    )
                found[ours] = value
            elif isinstance(value, Mapping):
                todo.append((value, depth + 1))
    return found


def _array(
    path: str | os.PathLike[str], name: str, tensor: Any, n: int, shape: tuple[int, ...], size: int
) -> np.ndarray:
    """Return a tensor as an array (n, *shape), where -1 matches any size; check its size against that of the file."""
    import torch

    if tensor.layout != torch.strided or not tensor.is_floating_point() or tensor.dtype.itemsize not in (2, 4, 8):
        raise InputError(
            f"{path}: {name} is a {tensor.layout} tensor of {tensor.dtype}, expected dense numbers",
            code="wrong_tensor_type",
        )
    given = tuple(tensor.shape)
    if name == "logit_opacities" and given == (n, 1):
        given, tensor = (n,), tensor[:, 0]
    if name == "sh0" and given == (n, 3):
        given, tensor = (n, 1, 3), tensor[:, None]
    if (
        len(given) != 1 + len(shape)
        or given[0] != n
        or any(b not in (-1, a) for a, b in zip(given[1:], shape, strict=True))
    ):
        wanted = ", ".join(["N", *("K" if one < 0 else str(one) for one in shape)])
        raise InputError(
            f"{path}: {name} has the shape {given} for {n} Gaussians, expected ({wanted})", code="count_mismatch"
        )
    if not n:
        raise InputError(f"{path} has no Gaussians", code="no_gaussians")
    if tensor.numel() * tensor.dtype.itemsize > size:  # a stride of 0 makes a splat of any size out of one number
        check_size(path, tensor.numel() * 4, 0)
        raise InputError(
            f"{path}: {name} has {tensor.numel()} numbers, more than fit into the file", code="decompression_bomb"
        )
    return tensor.detach().to(torch.float64 if name == "means" else torch.float32).numpy().copy()
