"""Compile this package's CUDA files when they are first used, and launch their kernels. NVRTC comes with torch."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

import torch

_KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')


def launch(
    file: str, kernel: str, blocks: int, threads: int, *arguments: Any, shared: int = 0, num_sh: int | None = None
) -> None:
    """Launch a kernel on torch's current stream.

    Args:
        file: name of a file beside this one.
        arguments: tensors on the GPU, and int32.
        shared: bytes of shared memory.
        num_sh: constant ``NUM_SH`` that the file is compiled with.
    """
    _kernels(file, num_sh)[kernel]((blocks, 1, 1), (threads, 1, 1), list(arguments), shared)


@functools.cache
def _kernels(file: str, num_sh: int | None) -> dict[str, Any]:
    from torch.cuda._utils import _cuda_load_module, _nvrtc_compile

    torch.cuda.init()
    source = Path(__file__).with_name(file).read_text()
    names = _KERNEL.findall(source)
    binary, _ = _nvrtc_compile(source, names[0], nvcc_options=[] if num_sh is None else [f"-DNUM_SH={num_sh}"])
    return dict(_cuda_load_module(binary, names))  # type: ignore[arg-type]
