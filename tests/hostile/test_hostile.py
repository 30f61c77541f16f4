"""Nothing outside the map and OUT is touched, whatever a map, a folder of tiles or a capture says."""

from __future__ import annotations

import contextlib
import re
import resource
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import hostile_arrays
import hostile_catalogs
import hostile_files
import hostile_values
import pytest
from hostile_world import CASES, MAX_MEMORY, VERBS, Case, World, everything_in

import gsmap.map
from gsmap.cli import app as command_line
from gsmap.errors import GsmapError
from gsmap.map.page.source import MapPageSource
from gsmap.texts import escaped
from gsmap.view.content import ServerState, summary

assert hostile_arrays
assert hostile_catalogs
assert hostile_files
assert hostile_values

_LIMIT_S = 60
_RAW = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]|\xc2[\x80-\x9f]|\xe2\x80[\xaa-\xae]")


@pytest.fixture(scope="module")
def program() -> Callable[..., object]:
    return command_line.build()


@pytest.fixture
def run(
    program: Callable[..., object], capfdbinary: pytest.CaptureFixture[bytes], monkeypatch: pytest.MonkeyPatch
) -> Callable[[list[str]], tuple[int, bytes]]:
    """Runs the command line here, with limits on time and memory; anything but an exit of its own is an error."""
    monkeypatch.setattr(command_line, "build", lambda *_: program)

    def too_long(*_: object) -> NoReturn:
        raise AssertionError(f"it took more than {_LIMIT_S} s")

    def call(arguments: list[str]) -> tuple[int, bytes]:
        capfdbinary.readouterr()
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        handler = signal.signal(signal.SIGALRM, too_long)
        resource.setrlimit(resource.RLIMIT_AS, (used + MAX_MEMORY, hard))
        signal.alarm(_LIMIT_S)
        try:
            with pytest.raises(SystemExit) as exit:
                (_look if arguments[0] == "look" else command_line.run)(arguments)
        finally:
            signal.alarm(0)
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
            signal.signal(signal.SIGALRM, handler)
        out, err = capfdbinary.readouterr()
        return int(exit.value.code or 0), out + err

    return call


def _look(arguments: list[str]) -> NoReturn:
    """Make what a browser would ask the page of `gsmap view` for; an error goes to the page as it is."""
    try:
        with gsmap.map.open(arguments[1]) as m:
            doors = MapPageSource(m.store, m.settings)
            view = doors.content()
            summary(view, ServerState())
            for one in view.scenes:
                doors.source(one.scene.id).load()
                doors.extras(one.scene.id)
    except GsmapError as error:
        print(escaped(str(error)))
        raise SystemExit(1) from error
    raise SystemExit(0)


@pytest.fixture
def server() -> Iterator[tuple[int, list[bytes]]]:
    """A server that takes whatever it is sent, as one that collects passwords would."""
    received: list[bytes] = []
    listening = socket.create_server(("127.0.0.1", 0))

    def listen() -> None:
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            with connection:
                received.append(b"connected")
                connection.settimeout(1)
                with contextlib.suppress(OSError):
                    received.append(connection.recv(1000))

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    yield listening.getsockname()[1], received
    listening.close()


@pytest.fixture(params=CASES, ids=lambda case: case.name)
def hostile_case(request: pytest.FixtureRequest) -> Case:
    return request.param


@pytest.mark.guards("security")
def test_nothing_outside_is_touched(
    hostile_case: Case,
    good_world: Path,
    tmp_path: Path,
    run: Callable[[list[str]], tuple[int, bytes]],
    server: tuple[int, list[bytes]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PGPASSWORD", "hunter2")
    port, received = server
    world = World.copied(good_world, tmp_path / "w")
    world.environment["PORT"] = str(port)
    places = {
        "MAP": world.map,
        "TILES": world.tiles,
        "HOME": world.home,
        "CAPTURES": world.captures,
        "IDA": world.id_of("a"),
        "INTO": world.root / "into.gsmap",
    }
    hostile_case.plant(world)
    before = everything_in(world.home)
    said, failed = b"", {}
    for line in hostile_case.verbs or VERBS:
        words = [
            re.sub(r"^(MAP|TILES|HOME|CAPTURES|IDA|INTO)", lambda m: str(places[m[0]]), w) for w in line.split(" ")
        ]
        code, output = run(words)
        assert code in (0, 1, 2, 3), (line, code, output)
        assert not _RAW.search(output), (line, output)
        assert b"Traceback" not in output
        assert everything_in(world.home) == before, line
        said += output
        if code:
            failed[line] = output
    assert received == []
    if hostile_case.says:
        assert re.search(hostile_case.says, said.decode()), said.decode()
    for line in hostile_case.works:
        assert line not in failed, failed[line].decode()
