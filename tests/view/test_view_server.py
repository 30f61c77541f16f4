"""Who reaches the page: real sockets, another user, and a crowd of half requests."""

from __future__ import annotations

import http.client
import os
import re
import socket
import sys
import threading
import time

import numpy as np
import pytest
from headless import Page

from gsmap.types import Gaussians, Scene
from gsmap.view import ViewMap, ViewScene, ViewServer, connections


@pytest.fixture
def server():
    one = Gaussians(np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.full((1, 3), -3.0), [3.0], np.ones((1, 1, 3)))
    scene = Scene("a", "a", 1, 0, 0, np.zeros((2, 3)))
    with ViewServer(ViewMap("a map", [ViewScene(scene, None, lambda: one)])).start() as found:
        yield found


def ask(server: ViewServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of one request over a connection of its own."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def raw(server: ViewServer, data: bytes, timeout_s: float = 10) -> bytes:
    """What comes back for bytes, until the server ends the connection."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=timeout_s) as one:
        one.sendall(data)
        out = b""
        while part := one.recv(1 << 16):
            out += part
        return out


def test_nothing_is_answered_without_the_token(server):
    paths = ("/", "/viewer.js", "/scene.js", "/sort.js", "/style.css", "/map.json", "/scenes/0/splats", "/nothing")
    port, token = server.port, server.token
    wrong = [token[:-1], token + "0", token.upper() + "x", "", "%00", "%C3%A9", "%ff"]
    for path in paths:
        assert ask(server, path)[0] == 403
        assert all(ask(server, f"{path}?token={guess}")[0] == 403 for guess in wrong)
        assert ask(server, path, Cookie=f"gsmap_view_{port}=x")[0] == 403
        assert ask(server, path, Cookie=f"gsmap_view_{port + 1}={token}")[0] == 403
        assert ask(server, path, Cookie='gsmap"[=\\')[0] == 403
        assert ask(server, path, Cookie=f"other=1; gsmap_view_{port}={token}")[0] == (
            404 if path == "/nothing" else 200
        )


def test_the_token_is_new_and_long_and_becomes_a_cookie(server):
    assert re.fullmatch(rf"http://127\.0\.0\.1:{server.port}/\?token=[0-9a-f]{{32}}", server.url)
    with ViewServer(ViewMap("other", [])) as other:
        assert other.token != server.token
    status, headers, body = ask(server, f"/?token={server.token}")
    assert (status, headers["Location"], body) == (303, "/", b"")
    cookie, *flags = headers["Set-Cookie"].split("; ")
    assert set(flags) == {"HttpOnly", "SameSite=Strict", "Path=/"}
    status, headers, body = ask(server, "/", Cookie=cookie)
    assert status == 200
    assert b"<canvas" in body
    assert server.token.encode() not in body


def test_every_answer_says_what_a_browser_may_do_with_it(server):
    for path in (f"/?token={server.token}", "/", f"/map.json?token={server.token}", f"/x?token={server.token}"):
        _, headers, _ = ask(server, path)
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cache-Control"] == "no-store"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert "Python" not in headers["Server"]


def test_only_get_and_head_and_nothing_large(server):
    status, headers, body = ask(server, f"/map.json?token={server.token}", "HEAD")
    assert (status, body) == (200, b"")
    assert int(headers["Content-Length"]) > 10
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT"):
        assert ask(server, f"/map.json?token={server.token}", method)[0] == 501
    start = f"GET /map.json?token={server.token} HTTP/1.1\r\nHost: localhost\r\n".encode()
    assert raw(server, start + b"Connection: close\r\n\r\n").startswith(b"HTTP/1.1 200")
    assert raw(server, start + b"Content-Length: 3\r\n\r\nabc").startswith(b"HTTP/1.1 400")
    assert raw(server, start.replace(b"localhost", b"evil.example") + b"\r\n").startswith(b"HTTP/1.1 403")
    assert raw(server, start.replace(b"Host: localhost\r\n", b"") + b"Connection: close\r\n\r\n")[9:12] == b"403"
    # Neither a long line nor many headers are kept in memory.
    assert b" 200 " not in raw(server, b"GET /" + b"a" * 20_000)[:20]
    assert raw(server, start + b"X: " + b"a" * 20_000)[9:12] == b"431"
    assert raw(server, start + b"X: a\r\n" * 3000)[9:12] == b"431"
    assert ask(server, f"/map.json?token={server.token}")[0] == 200


def test_half_requests_end_and_hold_neither_threads_nor_the_page(server, monkeypatch):
    monkeypatch.setattr(connections, "REQUEST_S", 1.0)
    before = threading.active_count()
    crowd = []
    for i in range(300):
        one = socket.create_connection(("127.0.0.1", server.port), timeout=10)
        one.sendall(b"GET /map.json HT" if i % 2 else b"")
        crowd.append(one)
    start = time.monotonic()
    assert ask(server, f"/map.json?token={server.token}")[0] == 200
    assert time.monotonic() - start < 5
    assert threading.active_count() <= before
    assert len(server._http.open) <= connections.MAX_CONNECTIONS
    # A drop at a time is no request either: the last ones are closed though they go on sending.
    end, alive = time.monotonic() + 8, crowd[-5:]
    while alive and time.monotonic() < end:
        time.sleep(0.2)
        for one in list(alive):
            try:
                one.sendall(b"X")
                one.setblocking(False)
                if one.recv(1) == b"":
                    alive.remove(one)
            except BlockingIOError:
                one.setblocking(True)
            except OSError:
                alive.remove(one)
    assert not alive
    for one in crowd:
        one.close()


def test_a_busy_server_ends_at_once(server):
    idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(5)]
    start = time.monotonic()
    server.close()
    assert time.monotonic() - start < 3
    for one in idle:
        one.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells whose a connection is")
@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can act for another user")
@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_another_user_is_not_answered_even_with_the_token(server, family):
    """A child of another user, which has learnt the token (from a list of processes, say)."""
    if family == socket.AF_INET6 and not socket.has_ipv6:
        pytest.skip("no IPv6")
    request = f"GET /map.json?token={server.token} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode()
    host = "127.0.0.1" if family == socket.AF_INET else "::ffff:127.0.0.1"

    def said(user: int) -> bytes:
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            out = b""
            try:
                os.setgid(65534)
                os.setuid(user)
                with socket.socket(family) as one:
                    one.settimeout(10)
                    one.connect((host, server.port))
                    one.sendall(request)
                    out = one.recv(100)
            except OSError:
                pass
            finally:
                os.write(writer, out or b"nothing")
                os._exit(0)
        os.close(writer)
        out = os.read(reader, 1000)
        os.close(reader)
        os.waitpid(child, 0)
        return out

    assert said(0).startswith(b"HTTP/1.1 200")
    assert said(65534) == b"nothing"


def test_a_browser_that_knows_the_address_sees_the_map_and_another_page_does_not(server, tmp_path):
    with Page(server.url, tmp_path / "profile") as page:
        page.wait("window.gsmap && window.gsmap.phase !== 'loading'")
        assert page.value("window.gsmap.error") is None
        assert page.value("location.href") == f"http://127.0.0.1:{server.port}/"  # no token to copy or to look at
        assert page.value("document.cookie") == ""
        assert page.failures() == []
    with Page(f"http://127.0.0.1:{server.port}/", tmp_path / "stranger") as page:
        page.wait("document.readyState === 'complete'")
        assert "Open the address" in page.value("document.body.innerText")
