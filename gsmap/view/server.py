"""An HTTP server on this machine's own address, for one page."""

from __future__ import annotations

import gzip
import json
import threading
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources

from gsmap.errors import ConfigError, GsmapError
from gsmap.view.content import ViewMap

_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/viewer.js": ("viewer.js", "text/javascript; charset=utf-8"),
    "/scene.js": ("scene.js", "text/javascript; charset=utf-8"),
    "/sort.js": ("sort.js", "text/javascript; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
}
_POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; connect-src 'self'; style-src 'self'; img-src data:"
)


class ViewServer:
    """Serves a `ViewMap` on 127.0.0.1 until it is closed; a context manager.

    Only requests that name this machine as their host are answered, so no other site can read the map through the
    visitor's browser.

    Args:
        port: 0 takes a free one.

    Raises:
        ConfigError: the port is taken or not allowed.
    """

    def __init__(self, view: ViewMap, *, port: int = 0) -> None:
        handler = type("Handler", (_Handler,), {"view": view})
        try:
            self._http = ThreadingHTTPServer(("127.0.0.1", port), handler)
        except (OSError, OverflowError) as error:
            raise ConfigError(f"cannot serve on port {port}: {error}; try another --port, or 0") from error
        self._http.daemon_threads = True
        self._thread: threading.Thread | None = None

    @cached_property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._http.server_address[1]}/"

    def start(self) -> ViewServer:
        """Serve from a thread of its own."""
        self._thread = threading.Thread(target=self._http.serve_forever, daemon=True)
        self._thread.start()
        return self

    def serve_forever(self) -> None:
        """Serve from the calling thread until it is interrupted."""
        try:
            self._http.serve_forever()
        except KeyboardInterrupt:
            return

    def close(self) -> None:
        if self._thread is not None:
            self._http.shutdown()
            self._thread.join()
            self._thread = None
        self._http.server_close()

    def __enter__(self) -> ViewServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Handler(BaseHTTPRequestHandler):
    view: ViewMap
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in ("127.0.0.1", "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        path = self.path.split("?", 1)[0]
        try:
            if path in _PAGE:
                name, kind = _PAGE[path]
                self._answer(resources.files("gsmap.view").joinpath("page", name).read_bytes(), kind)
            elif path == "/map.json":
                self._answer(_json(self.view.summary()), "application/json")
            else:
                self._scene(path)
        except GsmapError as error:
            self._answer(_json({"error": str(error)}), "application/json", HTTPStatus.INTERNAL_SERVER_ERROR)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the page was closed while it loaded

    def _scene(self, path: str) -> None:
        """``/scenes/INDEX/splats`` and ``/scenes/INDEX/extras``."""
        words = path.split("/")
        known = len(words) == 4 and words[1] == "scenes" and words[2].isdecimal() and len(words[2]) < 9
        if not known or int(words[2]) >= len(self.view.scenes) or words[3] not in ("splats", "extras"):
            self.send_error(HTTPStatus.NOT_FOUND)
        elif words[3] == "splats":
            self._answer(self.view.splats(int(words[2])), "application/octet-stream")
        else:
            self._answer(_json(self.view.extras(int(words[2]))), "application/json")

    def _answer(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        zipped = kind != "application/octet-stream" and "gzip" in self.headers.get("Accept-Encoding", "")
        if zipped:
            body = gzip.compress(body, 5)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        if zipped:
            self.send_header("Content-Encoding", "gzip")
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing below the command line prints."""


def _json(value: object) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
