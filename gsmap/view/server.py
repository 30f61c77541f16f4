"""Local HTTP server of the page, protected by a token in its address."""

from __future__ import annotations

import gzip
import hmac
import json
import re
import secrets
import threading
import time
from collections.abc import Mapping
from functools import cached_property
from http import HTTPStatus
from http.client import LineTooLong
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import parse_qs

from gsmap.errors import (
    BusyError,
    ConfigError,
    GsmapError,
    InputError,
    NotFoundError,
    ReadOnlyError,
)
from gsmap.markup import policy_text
from gsmap.view.answers import Answer, Answers
from gsmap.view.built import built_page
from gsmap.view.connections import LocalServer
from gsmap.view.levels import Levels
from gsmap.view.page_source import PageSource
from gsmap.view.params import Params
from gsmap.view.site import CSP
from gsmap.view.tree_cache import TreeCache

_SECURITY = {
    "Content-Security-Policy": policy_text(CSP | {"frame-ancestors": "'none'"}),
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    # Purged content must not stay in the browser's cache.
    "Cache-Control": "no-store",
}
_MAX_HEADER_BYTES = 16 << 10
_MAX_BODY_BYTES = 64 << 10
_WORTH_BYTES = 1000  # minimum size of compressed responses
_ACTION = re.compile(r"/actions/([a-z_]{1,40})")
_FILE = re.compile(r"[A-Za-z0-9_-]{1,80}(\.[A-Za-z0-9_-]{1,80})+")
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
    ".svg": "image/svg+xml",
    ".wasm": "application/wasm",
}
_STATUS: Mapping[type[GsmapError], int] = {
    NotFoundError: HTTPStatus.NOT_FOUND,
    BusyError: HTTPStatus.CONFLICT,
    ReadOnlyError: HTTPStatus.FORBIDDEN,
    InputError: HTTPStatus.BAD_REQUEST,
    ConfigError: HTTPStatus.BAD_REQUEST,
}
_SEND_S = 30.0  # timeout for sending one part of a response
_PART_BYTES = 1 << 20


class ViewServer:
    """Server of a map's page on 127.0.0.1; a context manager.

    Requests need the token in `url`, which is new for every server; the first response sets it as a cookie. On Linux
    connections of other users are closed unread. Requests must name this machine as their host, so that no other site
    can read the map through the browser; actions must come from the page itself.

    Args:
        page_source: Content of the map.
        cache: Folder of cached levels of detail, used for nothing else.
        params: Settings of the page.
        port: Port; 0 selects a free one.
        page: Folder of the built page; default: the one installed with gsmap.

    Raises:
        ConfigError: The port is taken or not allowed, or the page is not built.
    """

    def __init__(
        self,
        page_source: PageSource,
        cache: Path,
        params: Params | None = None,
        *,
        port: int = 0,
        page: Path | None = None,
    ) -> None:
        params = params or Params()
        self.token = secrets.token_hex(16)
        self.page = built_page() if page is None else page
        shared = {"token": self.token, "page": self.page, "acting": threading.Lock(), "page_source": page_source}
        handler: Any = type("Handler", (_Handler,), shared)
        try:
            self._http = LocalServer(port, handler)
        except (OSError, OverflowError) as error:
            raise ConfigError(
                f"cannot serve on port {port}: {error}; try another --port, or 0", code="port_unavailable"
            ) from error
        self.levels = Levels(page_source, TreeCache(cache, int(params.cache_gib * 2**30)), params.workers)
        self._answers = handler.answers = Answers(page_source, self.levels)
        self._thread: threading.Thread | None = None

    @cached_property
    def port(self) -> int:
        return self._http.server_port

    @cached_property
    def url(self) -> str:
        """Address of the page with its token."""
        return f"http://127.0.0.1:{self.port}/?token={self.token}"

    def start(self) -> ViewServer:
        """Serve from a new thread."""
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
        self._answers.close()
        self.levels.close()

    def __enter__(self) -> ViewServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Handler(BaseHTTPRequestHandler):
    token: str
    page: Path
    page_source: PageSource
    answers: Answers
    acting: threading.Lock
    server: LocalServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gsmap", ""
    timeout = _SEND_S

    def setup(self) -> None:
        super().setup()
        self.rfile: Any = _BoundedStream(self.rfile)

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
            self.send_error(HTTPStatus.BAD_REQUEST, "A GET request must not have a body")
            return
        path, _, query = self.path.partition("?")
        asked = parse_qs(query)
        told = self._is_token(asked.get("token", [""])[0])
        if not self._is_own_host() or not (told or self._is_token(self._cookie())):
            self.send_error(HTTPStatus.FORBIDDEN, "Open the address that gsmap view printed")
        elif path == "/" and told:
            self._welcome()
        elif (file := self._file_of_page(path)) is not None:
            self._answer(Answer(file.read_bytes(), _KINDS[file.suffix]))
        else:
            self._guarded(lambda: self.answers.get(path, {name: values[0] for name, values in asked.items()}))

    def do_POST(self) -> None:
        """Handle an action: accept it only from the page itself, only if small, and one at a time."""
        self._waits_since(None)
        length = self.headers.get("Content-Length", "")
        own = f"http://{self.headers.get('Host', '')}"
        if not self._is_own_host() or not self._is_token(self._cookie()):
            self.send_error(HTTPStatus.FORBIDDEN, "Open the address that gsmap view printed")
        elif self.headers.get("Origin") != own or self.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            self.send_error(HTTPStatus.FORBIDDEN, "Only the page itself may send actions")
        elif self.headers.get_content_type() != "application/json" or "Transfer-Encoding" in self.headers:
            self.send_error(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "Actions must be sent as application/json")
        elif not length.isdecimal() or len(length) > 9 or int(length) > _MAX_BODY_BYTES:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"An action may have at most {_MAX_BODY_BYTES} bytes")
        else:
            self._guarded(lambda: self._act(self.rfile.body(int(length))))

    def _act(self, body: bytes) -> Answer:
        named = _ACTION.fullmatch(self.path)
        if named is None:
            raise NotFoundError(f"no page at {self.path}", code="page_not_found")
        action = self.page_source.actions.get(named[1])
        if action is None:
            if not self.page_source.actions:
                raise ReadOnlyError(
                    "this page is read-only: gsmap view was started with --read-only, or the map cannot be written"
                )
            raise NotFoundError(f"unknown action {named[1]}", code="page_not_found")
        try:
            data = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise InputError(f"the action is not valid JSON: {error}", code="invalid_request") from error
        if not isinstance(data, dict):
            raise InputError("an action must be a JSON object", code="invalid_request")
        if not self.acting.acquire(blocking=False):
            raise BusyError("another action is running; try again when it has ended", code="server_busy")
        try:
            action(data)
        finally:
            self.acting.release()
        return Answer.json({"map": self.answers.summary()})

    def _guarded(self, answer: Any) -> None:
        """Send a response, or the error that its computation raises."""
        try:
            found = answer()
        except GsmapError as error:
            status = next((code for kind, code in _STATUS.items() if isinstance(error, kind)), 500)
            found = Answer.json({"error": str(error), "code": error.code}, HTTPStatus(status))
        except (ConnectionError, TimeoutError):
            raise
        except Exception as error:
            data = {"error": f"{type(error).__name__}: {error}", "code": "internal_error"}
            found = Answer.json(data, HTTPStatus.INTERNAL_SERVER_ERROR)
        self._answer(found)

    def _is_own_host(self) -> bool:
        host, _, port = self.headers.get("Host", "").partition(":")
        return host.lower() in ("127.0.0.1", "localhost") and port in ("", str(self.server.server_port))

    def _file_of_page(self, path: str) -> Path | None:
        """Return the file of the built page at an address; None if the built page has no such file."""
        name = "index.html" if path == "/" else path[1:]
        file = self.page / name
        return file if _FILE.fullmatch(name) and file.suffix in _KINDS and file.is_file() else None

    def _waits_since(self, when: float | None) -> None:
        connection = self.server.open.get(self.connection)
        if connection is not None:
            connection.waiting_since = when

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())

    @property
    def _cookie_name(self) -> str:
        """Name of the cookie, which contains the port because browsers send cookies to every port of a host."""
        return f"gsmap_view_{self.server.server_port}"

    def _cookie(self) -> str:
        try:
            found = SimpleCookie(self.headers.get("Cookie", "")).get(self._cookie_name)
        except CookieError:
            return ""
        return "" if found is None else found.value

    def _welcome(self) -> None:
        """Set the token as a cookie, and redirect to the address without it."""
        self.answers.draw_ahead()
        self.send_response(HTTPStatus.SEE_OTHER)
        self.send_header("Location", "/")
        self.send_header("Set-Cookie", f"{self._cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _answer(self, answer: Answer) -> None:
        body, headers, status = answer.body, dict(answer.headers), answer.status
        if answer.etag and self.headers.get("If-None-Match") == answer.etag:
            body, status = b"", HTTPStatus.NOT_MODIFIED
        elif answer.etag and status == HTTPStatus.OK and (part := _range(self.headers.get("Range"), len(body))):
            headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{len(body)}"
            body, status = body[part], HTTPStatus.PARTIAL_CONTENT
        elif answer.is_text and len(body) > _WORTH_BYTES and "gzip" in self.headers.get("Accept-Encoding", ""):
            body = gzip.compress(body, 5)
            headers["Content-Encoding"] = "gzip"
        if answer.etag:
            headers |= {"ETag": answer.etag, "Accept-Ranges": "bytes"}
        self.send_response(status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(body)))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            for start in range(0, len(body), _PART_BYTES):
                self._waits_since(time.monotonic())  # a client that does not read must not keep others out
                self.wfile.write(memoryview(body)[start : start + _PART_BYTES])

    def end_headers(self) -> None:
        for name, value in _SECURITY.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, *_: object) -> None:
        """Print nothing."""


class _BoundedStream:
    """A request stream with a limit on the length of each request."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.left = 0

    def readline(self, limit: int = -1) -> bytes:
        line = self._stream.readline(self.left + 1 if limit < 0 else min(limit, self.left + 1))
        self.left -= len(line)
        if self.left < 0:
            raise LineTooLong("request")
        return line

    def body(self, size: int) -> bytes:
        """Read the body of a request, whose size the caller has checked."""
        data = self._stream.read(size)
        if len(data) < size:
            raise ConnectionError("the request ended early")
        return data

    def close(self) -> None:
        self._stream.close()

    @property
    def closed(self) -> bool:
        return self._stream.closed


def _range(text: str | None, size: int) -> slice | None:
    """Parse a Range header with one range; None without a header or with an invalid range."""
    found = _RANGE.fullmatch(text or "")
    if found is None or found[1] == found[2] == "":
        return None
    if found[1] == "":
        start, stop = max(0, size - int(found[2])), size
    else:
        start, stop = int(found[1]), min(size, int(found[2]) + 1) if found[2] else size
    return slice(start, stop) if start < stop else None
