"""Serve a limited number of local connections with timeouts, on Linux from the same user only."""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import threading
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from gsmap import platform

# A browser opens six; this suffices for a second window and a reload. Each occupies a thread.
MAX_CONNECTIONS = 16
# Timeout for a whole request, or the next one; a browser on this machine is faster.
REQUEST_S = 10.0

Address = tuple[str, int]


@dataclass(eq=False)
class Connection:
    """The connection of one client.

    Args:
        socket: Socket of the client.
        waiting_since: `time.monotonic` since which the server waits for a request, or for the client to read a part of
            the answer; None while it computes one.
    """

    socket: socket.socket
    waiting_since: float | None = field(default_factory=time.monotonic)

    def drop(self) -> None:
        """Shut the connection down, which also ends blocked reads."""
        with contextlib.suppress(OSError):  # it has ended already
            self.socket.shutdown(socket.SHUT_RDWR)


class LocalServer(HTTPServer):
    """An HTTP server with at most `MAX_CONNECTIONS` connections, each in a thread of its own.

    A further connection replaces the one whose client has kept the server waiting for longest, so that neither
    incomplete requests nor clients that do not read their answers block the page.
    """

    request_queue_size = 64

    def __init__(self, port: int, handler: type[BaseHTTPRequestHandler]) -> None:
        self.open: dict[socket.socket, Connection] = {}
        self._lock = threading.Lock()
        self._accepted: queue.SimpleQueue[tuple[socket.socket, Any] | None] = queue.SimpleQueue()
        super().__init__(("127.0.0.1", port), handler)
        for _ in range(MAX_CONNECTIONS):
            threading.Thread(target=self._work, daemon=True).start()

    def verify_request(self, request: object, client_address: Any) -> bool:
        """Return true if the client may be answered; called before anything is read."""
        return not is_of_another_user(client_address, ("127.0.0.1", self.server_port))

    def process_request(self, request: object, client_address: Any) -> None:
        assert isinstance(request, socket.socket)
        with self._lock:
            if len(self.open) >= MAX_CONNECTIONS:
                waiting = [c for c in self.open.values() if c.waiting_since is not None]
                if not waiting:
                    self.shutdown_request(request)
                    return
                self._forget(min(waiting, key=lambda c: c.waiting_since or 0.0))
            self.open[request] = Connection(request)
        self._accepted.put((request, client_address))

    def service_actions(self) -> None:
        """Drop connections that have been idle for too long; `serve_forever` calls this twice a second."""
        with self._lock:
            late = time.monotonic() - REQUEST_S
            for one in [c for c in self.open.values() if c.waiting_since is not None and c.waiting_since < late]:
                self._forget(one)

    def handle_error(self, request: object, client_address: Any) -> None:
        """Ignore errors: a client that disconnects is not an error."""

    def server_close(self) -> None:
        super().server_close()
        with self._lock:
            for one in list(self.open.values()):
                self._forget(one)
        for _ in range(MAX_CONNECTIONS):
            self._accepted.put(None)

    def _forget(self, one: Connection) -> None:
        del self.open[one.socket]
        one.drop()

    def _work(self) -> None:
        while (accepted := self._accepted.get()) is not None:
            request, client_address = accepted
            try:
                self.finish_request(request, client_address)
            except Exception:
                self.handle_error(request, client_address)
            finally:
                with self._lock:
                    self.open.pop(request, None)
                self.shutdown_request(request)


def is_of_another_user(client: Address, server: Address) -> bool:
    """Return true if the client of a local connection belongs to another user, except root.

    Returns false if unknown: outside Linux, or for a socket that is closing.
    """
    user = platform.user_of_connection(client, server)
    return user is not None and user not in (0, os.getuid(), os.geteuid())
