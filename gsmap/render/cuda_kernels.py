"""Compile this package's CUDA files when they are first used, and launch their kernels.

NVRTC, which torch brings, compiles them; no CUDA toolkit is needed.
"""

from __future__ import annotations

import ctypes
import functools
import re
from pathlib import Path
from typing import Any

import torch

from gsmap.errors import MissingDependencyError

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

    Raises:
        MissingDependencyError: the file could not be compiled.
    """
    _kernels(file, num_sh)[kernel]((blocks, 1, 1), (threads, 1, 1), list(arguments), shared)


@functools.cache
def _kernels(file: str, num_sh: int | None) -> dict[str, Any]:
    from torch.cuda._utils import _cuda_load_module

    torch.cuda.init()
    source = Path(__file__).with_name(file).read_text()
    options = [f"--gpu-architecture=sm_{''.join(map(str, torch.cuda.get_device_capability()))}"]
    if num_sh is not None:
        options.append(f"-DNUM_SH={num_sh}")
    return dict(_cuda_load_module(compiled(source, options), _KERNEL.findall(source)))  # type: ignore[arg-type]


def compiled(source: str, options: list[str]) -> bytes:
    """Compile CUDA source for one architecture; return the binary.

    Raises:
        MissingDependencyError: NVRTC is missing or cannot compile the source.
    """
    try:
        from torch.cuda._utils import _get_gpu_rtc_library

        nvrtc = _get_gpu_rtc_library()
    except (ImportError, OSError) as error:
        raise MissingDependencyError(f"torch {torch.__version__} brings no NVRTC: {error}", extra="cuda") from error
    program = ctypes.c_void_p()
    given = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
    failed = nvrtc.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"gsmap.cu", 0, None, None)
    failed = failed or nvrtc.nvrtcCompileProgram(program, len(options), given)
    if failed:
        log = _read(nvrtc, program, "ProgramLog").decode(errors="replace") if program else ""
        raise MissingDependencyError(f"NVRTC could not compile gsmap's kernels: error {failed} {log}", extra="cuda")
    binary = _read(nvrtc, program, "CUBIN")
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return binary


def _read(nvrtc: Any, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size))
    text = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{what}")(program, text)
    return text.raw
