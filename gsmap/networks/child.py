"""Script of the process that runs one ONNX model, with limits on memory and files; it ends with its parent.

It imports `gsmap.platform` alone, and exchanges messages with `gsmap.networks.process` over one socket. Headers are
JSON; arrays are in shared memory or, if they do not fit there, follow their header. Received data are never executed.
"""

from __future__ import annotations

import json
import mmap
import os
import socket
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

_MAX_HEADER_BYTES = 1 << 20
_ALIGNED = 64


class Channel:
    """One end of the socket between the model process and its parent.

    Args:
        link: socket to the other end.
        shared: file of the shared memory.
    """

    def __init__(self, link: socket.socket, shared: int) -> None:
        self.link, self.shared = link, shared
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self._size = 0

    def reserve(self, size: int) -> None:
        """Enlarge the shared memory to at least this size; only the end whose files are not limited may call it."""
        if size > self._size:
            os.ftruncate(self.shared, size)

    def send(self, header: dict[str, Any], arrays: list[np.ndarray]) -> None:
        """Write one message."""
        self._map()
        listed, streamed, at = [], [], 0
        for array in (np.asarray(a, order="C") for a in arrays):
            place = at if at + array.nbytes <= self._size else None
            listed.append({"dtype": array.dtype.str, "shape": array.shape, "at": place})
            if place is None:
                streamed.append(array)
            elif array.size:
                self._array(array.dtype, array.shape, place)[...] = array
                at += -(-array.nbytes // _ALIGNED) * _ALIGNED
        text = json.dumps(header | {"arrays": listed}).encode()
        self.link.sendall(struct.pack("<I", len(text)) + text)
        for array in streamed:
            if array.size:
                self.link.sendall(array.reshape(-1).view(np.uint8).data)

    def receive(self, max_bytes: int, deadline: float | None = None) -> tuple[dict[str, Any], list[np.ndarray]]:
        """Read one message; its arrays are valid until the next message is sent.

        Raises:
            EOFError: the other process has ended.
            TimeoutError: `time.monotonic` has reached the deadline.
            ValueError: the data are no message, or the arrays have more bytes than ``max_bytes``.
        """
        (length,) = struct.unpack("<I", self._exactly(bytearray(4), deadline))
        if length > _MAX_HEADER_BYTES:
            raise ValueError(f"a message has a header of {length} bytes")
        header = json.loads(self._exactly(bytearray(length), deadline))
        self._map()
        arrays = []
        for listed in header.pop("arrays"):
            dtype, shape, place = np.dtype(listed["dtype"]), tuple(int(n) for n in listed["shape"]), listed["at"]
            size = dtype.itemsize
            for side in shape:
                size *= side
            max_bytes -= size
            if dtype.hasobject or min(shape, default=0) < 0 or max_bytes < 0:
                raise ValueError(f"a message has an invalid or too large array: {dtype} {shape}")
            if place is not None and size:
                if place < 0 or place + size > self._size:
                    raise ValueError(f"a message has an array at byte {place}, outside the shared memory")
                arrays.append(self._array(dtype, shape, place))
                continue
            arrays.append(np.empty(shape, dtype))
            if size:
                self._exactly(arrays[-1].reshape(-1).view(np.uint8), deadline)
        return header, arrays

    def _map(self) -> None:
        """Map the shared memory at its current size."""
        size = os.fstat(self.shared).st_size
        if size != self._size:
            self._memory, self._size = mmap.mmap(self.shared, size), size

    def _array(self, dtype: np.dtype, shape: tuple[int, ...], place: int) -> np.ndarray:
        return np.ndarray(shape, dtype, self._memory, place)

    def _exactly(self, buffer: Any, deadline: float | None) -> Any:
        """Read until the buffer is full."""
        view = memoryview(buffer)
        while len(view):
            self.link.settimeout(None if deadline is None else max(deadline - time.monotonic(), 1e-3))
            got = self.link.recv_into(view)
            if not got:
                raise EOFError("the other process has ended")
            view = view[got:]
        return buffer


def main(link: int, shared: int, path: str, memory_bytes: int) -> None:
    """Load the model, send the names of its inputs and outputs, then run it for every request."""
    from gsmap import platform

    channel = Channel(socket.socket(fileno=link), shared)
    _end_with_parent()
    platform.prefer_to_be_killed()
    try:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # no log messages, because errors are raised as well
        platform.limit_process(memory_bytes)
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        ends = session.get_inputs(), session.get_outputs()
        inputs, outputs = ([[t.name, list(t.shape), t.type] for t in end] for end in ends)
        channel.send({"inputs": inputs, "outputs": outputs}, [])
    except BaseException as error:
        channel.send(_problem(error), [])
        return
    while True:
        try:
            request, arrays = channel.receive(memory_bytes)
        except EOFError:
            return
        try:
            results = session.run(request["outputs"], dict(zip(request["names"], arrays, strict=True)))
            if not all(isinstance(value, np.ndarray) and value.dtype.kind in "biufc" for value in results):
                raise TypeError("an output is not an array of numbers")
            channel.send({}, results)
            del results, arrays
        except BaseException as error:
            channel.send(_problem(error), [])


def _end_with_parent() -> None:
    """End this process with its parent: the parent's end of the pipe closes in any case, even by SIGKILL."""
    from gsmap import platform

    platform.end_with_input()  # whatever the threads are doing

    def wait() -> None:
        os.read(0, 1)
        os._exit(0)

    threading.Thread(target=wait, daemon=True).start()


def _problem(error: BaseException) -> dict[str, Any]:
    text = str(error) or type(error).__name__
    lacks_memory = isinstance(error, MemoryError) or "bad_alloc" in text or "Failed to allocate memory" in text
    return {"error": text.splitlines()[0][:300], "lacks_memory": lacks_memory}


if __name__ == "__main__":
    sys.path.append(str(Path(__file__).parents[2]))  # where gsmap lies
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
