"""Who reaches the page: real sockets, another user, and a crowd of half requests."""

from __future__ import annotations

import gzip
import json
import os
import re
import socket
import threading
import time
from dataclasses import replace

import pytest
from headless import Page
from raising import raises
from view_room import A, B, C, MadeDoors, act, ask, page_folder, told

from gsmap import platform
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats import spz
from gsmap.geometry.transforms import transform_gaussians
from gsmap.view import ViewMap, ViewServer, connections
from gsmap.view.trees import shown


@pytest.fixture
def page_source():
    return MadeDoors()


@pytest.fixture
def server(page_source, tmp_path):
    with ViewServer(page_source, tmp_path / "cache", page=page_folder(tmp_path)).start() as found:
        yield found


def raw(server: ViewServer, data: bytes, timeout_s: float = 10) -> bytes:
    """What comes back for bytes, until the server ends the connection."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=timeout_s) as one:
        one.sendall(data)
        out = b""
        while part := one.recv(1 << 16):
            out += part
        return out


def test_nothing_is_answered_without_the_token(server):
    paths = ("/", "/page.js", "/style.css", "/map.json", "/state.json", f"/scenes/{A}/extras.json", "/nothing")
    port, token = server.port, server.token
    wrong = [token[:-1], token + "0", token.upper() + "x", "", "%00", "%C3%A9", "%ff"]
    for path in paths:
        assert ask(server, path, cookie=False)[0] == 403
        assert all(ask(server, f"{path}?token={guess}", cookie=False)[0] == 403 for guess in wrong)
        assert ask(server, path, Cookie=f"gsmap_view_{port}=x")[0] == 403
        assert ask(server, path, Cookie=f"gsmap_view_{port + 1}={token}")[0] == 403
        assert ask(server, path, Cookie='gsmap"[=\\')[0] == 403
        assert ask(server, path, Cookie=f"other=1; gsmap_view_{port}={token}")[0] == (
            404 if path == "/nothing" else 200
        )


def test_the_token_is_new_and_long_and_becomes_a_cookie(server, tmp_path):
    assert re.fullmatch(rf"http://127\.0\.0\.1:{server.port}/\?token=[0-9a-f]{{32}}", server.url)
    with ViewServer(MadeDoors(), tmp_path / "cache", page=server.page) as other:
        assert other.token != server.token
    status, headers, body = ask(server, f"/?token={server.token}", cookie=False)
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
    for method in ("PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "PATCH"):
        assert ask(server, f"/map.json?token={server.token}", method)[0] == 501
    assert ask(server, f"/map.json?token={server.token}", "POST")[0] == 403
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


def test_clients_that_do_not_read_do_not_keep_the_page_out(server, page_source):
    (server.page / "large.js").write_bytes(bytes(8 << 20))
    request = f"GET /large.js?token={server.token} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    crowd = [socket.socket() for _ in range(connections.MAX_CONNECTIONS + 4)]
    for one in crowd:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.connect(("127.0.0.1", server.port))
        one.sendall(request)
        one.recv(1)  # it is being answered
        time.sleep(0.02)
    start = time.monotonic()
    assert ask(server, f"/map.json?token={server.token}")[0] == 200
    assert time.monotonic() - start < 5
    for one in crowd:
        one.close()
    status, _, body = ask(server, f"/large.js?token={server.token}")
    assert (status, len(body)) == (200, 8 << 20)


def test_a_busy_server_ends_at_once(server):
    idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(5)]
    start = time.monotonic()
    server.close()
    assert time.monotonic() - start < 3
    for one in idle:
        one.close()


@pytest.mark.skipif(not platform.IS_LINUX, reason="only Linux tells whose a connection is")
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
        page.wait("window.there")
        assert page.value("location.href") == f"http://127.0.0.1:{server.port}/"  # no token to copy or to look at
        assert page.value("document.cookie") == ""
        assert page.failures() == []
    with Page(f"http://127.0.0.1:{server.port}/", tmp_path / "stranger") as page:
        page.wait("document.readyState === 'complete'")
        assert "Open the address" in page.value("document.body.innerText")


# --- what is answered ------------------------------------------------------------------------------------------------


def test_files_of_the_page_are_served_and_nothing_else_that_lies_there(server):
    assert ask(server, "/page.js")[1]["Content-Type"].startswith("text/javascript")
    for path in (
        "/secret.sqlite",
        "/../view_room.py",
        "/%2e%2e/x.js",
        "/page/page.js",
        "/.js",
        "/index.html/",
    ):
        assert ask(server, path)[0] == 404


def test_the_map_is_told_with_levels_that_come_by_themselves(server, page_source):
    status, headers, body = ask(server, "/map.json", Accept_Encoding="gzip")
    assert (status, headers["Content-Encoding"]) == (200, "gzip")
    said = json.loads(gzip.decompress(body))
    assert said["title"] == "a map"
    assert said["actions"]
    state = said["state"]
    end = time.monotonic() + 20
    while said["components"][0]["overview"]["pending"] and time.monotonic() < end:
        time.sleep(0.05)
        if told(server, "/state.json")["state"] != state:
            said = told(server, "/map.json")
            state = said["state"]
    overview = said["components"][0]["overview"]
    assert overview["scenes"] == [0, 1]
    _, headers, data = ask(server, f"/{overview['uri']}")
    found = spz.unpack("overview", data)
    assert len(found) == sum(overview["counts"])
    # In the map frame, one scene after the other.
    for place, rows in ((0, slice(0, overview["counts"][0])), (1, slice(overview["counts"][0], None))):
        entry = page_source.view.scenes[place]
        whole = transform_gaussians(shown(page_source.gaussians[entry.scene.id]), entry.S_map_scene)
        assert abs(found.means[rows].mean(0) - whole.means.mean(0)).max() < 0.1
    # Its name is of these bytes; that of an older one is gone.
    assert ask(server, f"/{overview['uri']}", If_None_Match=headers["ETag"])[0] == 304
    assert ask(server, "/overviews/0/0123456789.spz")[0] == 404
    assert ask(server, "/overviews/7/none.spz")[0] == 404
    # The island of one scene is made when somebody asks for it.
    assert said["components"][1]["overview"]["uri"] == "overviews/3/none.spz"
    state = said["state"]
    told(server, f"/scenes/{page_source.view.scenes[2].key}/tileset.json")
    assert told(server, "/state.json")["state"] != state
    assert ask(server, "/overviews/3/none.spz")[0] == 202
    end = time.monotonic() + 20
    while told(server, "/map.json")["components"][1]["overview"]["pending"] and time.monotonic() < end:
        time.sleep(0.05)
    assert told(server, "/map.json")["components"][1]["overview"]["counts"]


def test_a_tree_is_made_when_it_is_asked_for_and_served_in_parts(server, page_source, tmp_path):
    key = page_source.view.scenes[0].key
    tileset = told(server, f"/scenes/{key}/tileset.json?rank=0")
    uri = f"/scenes/{key}/{tileset['root']['content']['uri']}"
    status, headers, body = ask(server, uri)
    assert (status, body[:4], headers["Accept-Ranges"]) == (200, b"glTF", "bytes")
    assert ask(server, uri, If_None_Match=headers["ETag"])[0] == 304
    status, part, some = ask(server, uri, Range="bytes=4-9")
    assert (status, some, part["Content-Range"]) == (206, body[4:10], f"bytes 4-9/{len(body)}")
    assert ask(server, uri, Range="bytes=-5")[2] == body[-5:]
    assert ask(server, uri, Range=f"bytes={len(body) - 3}-")[2] == body[-3:]
    for odd in ("bytes=9-4", "bytes=-", "lines=0-3", "bytes=0-3,5-9", f"bytes={len(body)}-", "bytes=" + "9" * 30 + "-"):
        assert ask(server, uri, Range=odd)[::2] == (200, body)
    for path in ("tiles/none-0123456789abcdef.glb", "tiles/..%2f..%2fsecret.glb", "files.json", "../x"):
        assert ask(server, f"/scenes/{key}/{path}")[0] == 404
    assert ask(server, f"/scenes/{'f' * 32}-v1/tileset.json")[0] == 404
    assert ask(server, f"/scenes/{key}/tileset.json?rank=much")[0] == 400
    # One that was damaged meanwhile is made again.
    for tile in (tmp_path / "cache").rglob("*.glb"):
        tile.write_bytes(b"glTF")
    assert told(server, f"/scenes/{key}/tileset.json") == tileset
    assert ask(server, uri)[2] == body


def test_levels_wait_while_a_person_waits_for_something_else(server, page_source, monkeypatch):
    drawing, drawn = threading.Event(), threading.Event()
    graph = page_source.graph

    def slow() -> dict[str, object]:
        drawing.set()
        assert drawn.wait(10)
        return graph()

    monkeypatch.setattr(page_source, "graph", slow, raising=False)
    asked = threading.Thread(target=ask, args=(server, "/graph.json"))
    asked.start()
    assert drawing.wait(10)
    tileset = f"/scenes/{page_source.view.scenes[0].key}/tileset.json"
    end = time.monotonic() + 1
    while time.monotonic() < end:
        assert ask(server, tileset)[0] == 202
        time.sleep(0.05)
    drawn.set()
    asked.join()
    assert told(server, tileset)["root"]


def test_a_scene_that_cannot_be_read_is_said(server, page_source):
    def broken(scene):
        raise InputError("scene a is damaged: run gsmap check")

    page_source.source = broken
    end = time.monotonic() + 10
    status = 202
    while status == 202 and time.monotonic() < end:
        status, _, body = ask(server, f"/scenes/{page_source.view.scenes[0].key}/tileset.json")
        time.sleep(0.02)
    assert status == 400
    assert "gsmap check" in json.loads(body)["error"]
    # Nor is it waited for any more.
    while told(server, "/map.json")["components"][0]["overview"]["pending"] and time.monotonic() < end:
        time.sleep(0.02)
    assert told(server, "/map.json")["components"][0]["overview"]["pending"] == 0


def test_a_scene_that_was_purged_while_its_tree_was_made_is_not_kept(server, page_source, tmp_path):
    real = page_source.source
    asked = []

    def once(scene):
        asked.append(scene)
        if asked.count(scene) > 1:
            raise NotFoundError("purged")
        return real(scene)

    page_source.source = once
    key = page_source.view.scenes[2].key
    status = 202
    while status == 202:
        status = ask(server, f"/scenes/{key}/tileset.json")[0]
        time.sleep(0.02)
    assert status == 404
    assert not list((tmp_path / "cache").glob(f"{C}*"))


def test_everything_else_is_told_by_its_address(server, page_source):
    assert told(server, f"/scenes/{A}/extras.json") == {"layers": {}, "cameras": []}
    assert told(server, "/revisions/1.json")["number"] == 1
    assert told(server, "/graph.json") == {"objects": [], "relations": [], "rooms": []}
    assert told(server, "/history.json?at=0,1,2&component=0") == {"rows": []}
    names = ("revisions/2.json", "changes/c1-after.jpg", "merged/0/tileset.json")
    missing = (f"/scenes/{'e' * 32}/extras.json", *(f"/{name}" for name in names))
    for path in missing:
        assert ask(server, path)[0] == 404
    for path in ("/history.json?at=here", "/history.json?at=0,1,2&component=x"):
        assert ask(server, path)[0] == 400
    detail = told(server, f"/edges/{A}-{B}.json")
    assert [view["camera"] for view in detail["views"]] == ["one", "two"]
    for view in detail["views"]:
        for name in ("target", "source", "difference"):
            status, headers, body = ask(server, f"/{view[name]}")
            assert (status, headers["Content-Type"], body[:2]) == (200, "image/jpeg", b"\xff\xd8")
    assert page_source.drawn == 1  # once for all of them
    assert ask(server, f"/edges/{A}-{B}/9-target.jpg")[0] == 404


def test_merged_tiles_are_served_from_their_folder_and_no_further(server, page_source, tmp_path):
    folder = tmp_path / "export" / "component_000"
    (folder / "levels").mkdir(parents=True)
    (folder / "tileset.json").write_text("{}")
    (folder / "levels" / "x.glb").write_bytes(b"glTF")
    (tmp_path / "export" / "tiles.json").write_text("{}")
    (folder / "link.glb").symlink_to(tmp_path / "export" / "tiles.json")
    page_source.merged_folder, page_source.view = folder, replace(page_source.view, merged=frozenset([0]))
    assert told(server, "/map.json")["components"][0]["merged"] == "merged/0/tileset.json"
    assert ask(server, "/merged/0/tileset.json")[2] == b"{}"
    assert ask(server, "/merged/0/levels/x.glb")[2] == b"glTF"
    for path in (
        "../tiles.json",
        "%2e%2e/tiles.json",
        "levels/../../tiles.json",
        "link.glb",
        "none.glb",
        "x.sqlite",
        "/etc/passwd",
    ):
        assert ask(server, f"/merged/0/{path}")[0] == 404
    assert ask(server, "/merged/1/tileset.json")[0] == 404


# --- what a person does ----------------------------------------------------------------------------------------------


def test_an_action_is_done_and_answered_with_the_map_as_it_is_then(server, page_source):
    status, said = act(server, "confirm", {"what": f"{A}:{B}", "note": "seen"})
    assert status == 200
    assert said["map"]["title"] == "after confirm"
    assert page_source.done == [("confirm", {"what": f"{A}:{B}", "note": "seen"})]
    end = time.monotonic() + 20
    while told(server, "/map.json")["components"][0]["overview"]["pending"] and time.monotonic() < end:
        time.sleep(0.05)
    state = told(server, "/map.json")["state"]
    assert told(server, "/state.json")["state"] == state
    act(server, "reject", {"what": "x"})
    assert told(server, "/state.json")["state"] != state
    assert act(server, "confirm", {"what": "nonsense"}) == (400, {"error": "this makes no sense", "code": "input"})
    assert act(server, "destroy", {})[0] == 404


def test_only_the_page_itself_may_ask_for_an_action(server, page_source):
    own, said = f"http://127.0.0.1:{server.port}", json.dumps({"what": "x"}).encode()
    good = {"Origin": own, "Content_Type": "application/json"}
    path = "/actions/confirm"
    hostile = [
        ({"Origin": "http://evil.example"}, {}),
        ({"Origin": f"http://127.0.0.1:{server.port + 1}"}, {}),
        ({"Origin": f"https://127.0.0.1:{server.port}"}, {}),
        ({"Origin": "null"}, {}),
        ({"Sec_Fetch_Site": "cross-site"}, {}),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, {}),
        ({"Host": f"evil.example:{server.port}", "Origin": f"http://evil.example:{server.port}"}, {}),
        ({"Cookie": "gsmap_view=guess"}, {}),
    ]
    for headers, _ in hostile:
        assert ask(server, path, "POST", body=said, **(good | headers))[0] == 403
    assert ask(server, path, "POST", body=said, Content_Type="application/json")[0] == 403  # no Origin at all
    # The token in the address does for reading, not for changing.
    assert ask(server, f"{path}?token={server.token}", "POST", body=said, cookie=False, **good)[0] == 403
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", "application/jsonx"):
        assert ask(server, path, "POST", body=said, Origin=own, Content_Type=kind)[0] == 415
    for body in (b"", b"{", b"[]", b"3", b"\xff", b"[" * 60_000):
        assert ask(server, path, "POST", body=body, **good)[0] == 400
    assert ask(server, path, "POST", body=b"x" * 70_000, **good)[0] == 413
    assert ask(server, path, "POST", body=said, Content_Length="-5", **good)[0] == 413
    for other in ("/map.json", "/actions/", "/actions/confirm/x", "/actions/confirm?x=1"):
        assert ask(server, other, "POST", body=said, **good)[0] == 404
    assert ask(server, path)[0] == 404  # it is no address to read
    assert page_source.done == []


def test_a_map_that_is_only_looked_at_cannot_be_changed(server, page_source):
    page_source.read_only = True
    assert told(server, "/map.json")["actions"] is False
    status, said = act(server, "confirm", {"what": "x"})
    assert status == 403
    assert "read-only" in said["error"]


def test_one_action_at_a_time(server, page_source):
    began, go_on = threading.Event(), threading.Event()

    def slow(said):
        began.set()
        assert go_on.wait(20)

    type(page_source).actions = property(lambda self: {"confirm": slow})
    try:
        thread = threading.Thread(target=act, args=(server, "confirm", {}))
        thread.start()
        assert began.wait(20)
        status, said = act(server, "confirm", {})
        assert (status, said["error"]) == (409, "another action is running; try again when it has ended")
        assert ask(server, "/state.json")[0] == 200  # reading goes on meanwhile
    finally:
        go_on.set()
        thread.join()
        type(page_source).actions = ACTIONS


ACTIONS = MadeDoors.actions


def test_a_port_that_is_taken_is_named(server, page_source, tmp_path):
    for port in (server.port, 99999):
        with raises(ConfigError, code="port_unavailable"):
            ViewServer(page_source, tmp_path / "cache", page=server.page, port=port)


def test_a_page_that_is_not_built_is_said_with_what_to_do(page_source, tmp_path, monkeypatch):
    from gsmap.view import built

    monkeypatch.setattr(built, "FOLDER", "nowhere")
    with raises(ConfigError, code="page_not_built"):
        ViewServer(page_source, tmp_path / "cache")


def test_an_empty_map_is_served(tmp_path):
    page_source = MadeDoors()
    page_source.view = ViewMap("empty")
    with ViewServer(page_source, tmp_path / "cache", page=page_folder(tmp_path)).start() as server:
        assert told(server, "/map.json")["scenes"] == []
