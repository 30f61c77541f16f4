"""An HTTP server on this machine's own address, for one page and for those who were told its address."""

from __future__ import annotations

import gzip
import hmac
import json
import secrets
import threading
import time
from functools import cached_property
from http import HTTPStatus
from http.client import LineTooLong
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler
from importlib import resources
from typing import Any, BinaryIO
from urllib.parse import parse_qs

from gsmap.errors import ConfigError, GsmapError
from gsmap.view.connections import LocalServer
from gsmap.view.content import ViewMap

_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/viewer.js": ("viewer.js", "text/javascript; charset=utf-8"),
    "/scene.js": ("scene.js", "text/javascript; charset=utf-8"),
    "/sort.js": ("sort.js", "text/javascript; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
}
_SECURITY = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; worker-src 'self'; connect-src 'self'; "
    "style-src 'self'; img-src data:",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_MAX_HEADER_BYTES = 16 << 10
_SEND_S = 30.0  # for a browser to take one part of an answer
_PART_BYTES = 1 << 20


class ViewServer:
    """Serves a `ViewMap` on 127.0.0.1 until it is closed; a context manager.

    Only who knows the token in `url`, new with every server, is answered; the first answer is a cookie that stands for
    it. On Linux other users' connections are closed unread. Requests must name this machine as their host, so no other
    site can read the map through the visitor's browser.

    Args:
        port: 0 takes a free one.

    Raises:
        ConfigError: the port is taken or not allowed.
    """

    def __init__(self, view: ViewMap, *, port: int = 0) -> None:
        self.token = secrets.token_hex(16)
        handler = type("Handler", (_Handler,), {"view": view, "token": self.token})
        try:
            self._http = LocalServer(port, handler)
        except (OSError, OverflowError) as error:
            raise ConfigError(f"cannot serve on port {port}: {error}; try another --port, or 0") from error
        self._thread: threading.Thread | None = None

    @cached_property
    def port(self) -> int:
        return self._http.server_port

    @cached_property
    def url(self) -> str:
        """The page's address with the token that opens it."""
        return f"http://127.0.0.1:{self.port}/?token={self.token}"

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
    token: str
    server: LocalServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gsmap", ""
    timeout = _SEND_S

    def setup(self) -> None:
        super().setup()
        self.rfile: Any = _Bounded(self.rfile)

    def handle_one_request(self) -> None:
        self.rfile.left = _MAX_HEADER_BYTES
        self._waits_since(time.monotonic())
        try:
            super().handle_one_request()
        except (LineTooLong, ConnectionError, TimeoutError):
            self.close_connection = True

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        self._waits_since(None)
        if "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self.send_error(HTTPStatus.BAD_REQUEST, "A request here has no body")
            return
        host = self.headers.get("Host", "").rsplit(":", 1)[0].lower()
        path, _, query = self.path.partition("?")
        told = self._is_token(parse_qs(query).get("token", [""])[0])
        if host not in ("127.0.0.1", "localhost") or not (told or self._is_token(self._cookie())):
            self.send_error(HTTPStatus.FORBIDDEN, "Open the address that gsmap view printed")
            return
        try:
            if path == "/" and told:
                self._welcome()
            elif path in _PAGE:
                name, kind = _PAGE[path]
                self._answer(resources.files("gsmap.view").joinpath("page", name).read_bytes(), kind)
            elif path == "/map.json":
                self._answer(_json(self.view.summary()), "application/json")
            else:
                self._scene(path)
        except GsmapError as error:
            self._answer(_json({"error": str(error)}), "application/json", HTTPStatus.INTERNAL_SERVER_ERROR)

    def _waits_since(self, when: float | None) -> None:
        connection = self.server.open.get(self.connection)
        if connection is not None:
            connection.waiting_since = when

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())

    @property
    def _cookie_name(self) -> str:
        """Browsers send a cookie to every port of a host, so each server has a name of its own."""
        return f"gsmap_view_{self.server.server_port}"

    def _cookie(self) -> str:
        try:
            found = SimpleCookie(self.headers.get("Cookie", "")).get(self._cookie_name)
        except CookieError:
            return ""
        return "" if found is None else found.value

    def _welcome(self) -> None:
        """The token becomes a cookie, and leaves the address bar."""
        self.send_response(HTTPStatus.SEE_OTHER)
        self.send_header("Location", "/")
        self.send_header("Set-Cookie", f"{self._cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/")
        self.send_header("Content-Length", "0")
        self.end_headers()

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
        self.end_headers()
        if self.command != "HEAD":
            for start in range(0, len(body), _PART_BYTES):
                self.wfile.write(memoryview(body)[start : start + _PART_BYTES])

    def end_headers(self) -> None:
        for name, value in _SECURITY.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, *_: object) -> None:
        """Nothing below the command line prints."""


class _Bounded:
    """A stream of requests of which each may be so long and no longer."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.left = 0

    def readline(self, limit: int = -1) -> bytes:
        line = self._stream.readline(self.left + 1 if limit < 0 else min(limit, self.left + 1))
        self.left -= len(line)
        if self.left < 0:
            raise LineTooLong("request")
        return line

    def close(self) -> None:
        self._stream.close()

    @property
    def closed(self) -> bool:
        return self._stream.closed


def _json(value: object) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
