"""A real object store that speaks S3: OpenStack Swift with its S3 API, four servers on this machine."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from datetime import timedelta
from pathlib import Path

BUCKET = "maps"
ENVIRONMENT = {"AWS_ACCESS_KEY_ID": "test:tester", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_REGION": "us-east-1"}

_COMMON = """
[DEFAULT]
swift_dir = {root}
devices = {root}/devices
mount_check = false
bind_ip = 127.0.0.1
bind_port = {port}
workers = 0
user = {user}
log_address = {root}/no-syslog
fallocate_reserve = 0
"""
_BACKEND = """
[pipeline:main]
pipeline = {kind}-server
[app:{kind}-server]
use = egg:swift#{kind}
"""
_PROXY = """
[pipeline:main]
pipeline = catch_errors gatekeeper s3api tempauth slo proxy-server
[app:proxy-server]
use = egg:swift#proxy
account_autocreate = true
[filter:catch_errors]
use = egg:swift#catch_errors
[filter:gatekeeper]
use = egg:swift#gatekeeper
[filter:s3api]
use = egg:swift#s3api
[filter:tempauth]
use = egg:swift#tempauth
user_test_tester = testing .admin
[filter:slo]
use = egg:swift#slo
"""


def why_not(folder: Path) -> str:
    """Why a server cannot be started here; empty where it can."""
    try:
        import swift  # noqa: F401
    except ImportError:
        return "needs OpenStack Swift (pip install swift)"
    probe = folder / "probe"
    probe.touch()
    try:
        os.setxattr(probe, "user.swift", b"x")
    except OSError:
        return f"Swift keeps metadata in extended attributes, which the disk of {folder} does not have"
    return ""


class Swift:
    """The servers below one folder; ``url`` is where they speak S3."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.url = ""
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Swift:
        import getpass

        (self.root / "devices" / "d1").mkdir(parents=True)
        (self.root / "swift.conf").write_text("[swift-hash]\nswift_hash_path_prefix = a\nswift_hash_path_suffix = b\n")
        ports = dict(zip(("account", "container", "object", "proxy"), _free_ports(4), strict=True))
        for kind, port in ports.items():
            if kind != "proxy":
                builder = self.root / f"{kind}.builder"
                for words in (["create", "4", "1", "0"], ["add", f"r1z1-127.0.0.1:{port}/d1", "1"], ["rebalance"]):
                    self._run("swift-ring-builder", str(builder), *words)
            text = _COMMON.format(root=self.root, port=port, user=getpass.getuser())
            text += _PROXY if kind == "proxy" else _BACKEND.format(kind=kind)
            (self.root / f"{kind}.conf").write_text(text)
            self._start(kind)
        self.url = f"http://127.0.0.1:{ports['proxy']}"
        for port in ports.values():
            self._wait(port)
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._processes:
            process.kill()
            process.wait()

    def make_bucket(self) -> None:
        """An empty bucket, by the API itself: one signed request."""
        import obstore
        from obstore.store import S3Store

        names = {name.lower(): value for name, value in ENVIRONMENT.items()}
        store = S3Store(BUCKET, endpoint=self.url, client_options={"allow_http": True}, **names)
        url = obstore.sign(store, "PUT", "", timedelta(minutes=1))
        with urllib.request.urlopen(urllib.request.Request(url, method="PUT")) as answer:
            assert answer.status == 200

    def _program(self, name: str) -> str:
        beside = Path(sys.executable).parent / name
        return str(beside) if beside.exists() else shutil.which(name) or name

    def _environment(self) -> dict[str, str]:
        return {**os.environ, "SWIFT_CONF_FILE": str(self.root / "swift.conf")}

    def _run(self, *words: str) -> None:
        command = [self._program(words[0]), *words[1:]]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=self._environment())
        assert done.returncode in (0, 1), done.stdout + done.stderr  # 1: a warning

    def _start(self, kind: str) -> None:
        with open(self.root / f"{kind}.log", "wb") as log:
            command = [self._program(f"swift-{kind}-server"), str(self.root / f"{kind}.conf"), "-v"]
            self._processes.append(subprocess.Popen(command, stdout=log, stderr=log, env=self._environment()))

    def _wait(self, port: int) -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.05)
        logs = "".join((self.root / f).read_text() for f in os.listdir(self.root) if f.endswith(".log"))
        raise AssertionError(f"Swift did not start: {logs[-3000:]}")


class Wire:
    """A wire to the server that counts, and on which the answer to every so many-th request is lost after the server
    has done it.

    Args:
        every: 0 to lose none.
        faults: by the method of a request, the answers to its first requests, which do not reach the server; an empty
            one never comes.
        delay_s: by which answers of the server are late.
    """

    def __init__(
        self, url: str, every: int = 0, faults: dict[str, list[bytes]] | None = None, delay_s: float = 0.0
    ) -> None:
        self.faults = {f"{method} ".encode(): answers for method, answers in (faults or {}).items()}
        self.delay_s = delay_s
        self.host, port = url.removeprefix("http://").split(":")
        self.port = int(port)
        self.every = every
        self.lost = self.answers = self.num_bytes = 0
        self._count = itertools.count(1)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listening.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            server = socket.create_connection((self.host, self.port))
            threading.Thread(target=self._forward, args=(client, server), daemon=True).start()
            threading.Thread(target=self._answer, args=(server, client), daemon=True).start()

    def _forward(self, client: socket.socket, server: socket.socket) -> None:
        try:
            while data := client.recv(1 << 16):
                answers = next((a for method, a in self.faults.items() if data.startswith(method)), [])
                if answers:
                    client.sendall(answers.pop(0))
                    while client.recv(1 << 16):
                        pass
                    server.close()
                    return
                server.sendall(data)
        except OSError:
            pass

    def _answer(self, server: socket.socket, client: socket.socket) -> None:
        try:
            while data := server.recv(1 << 16):
                self.num_bytes += len(data)
                if data.startswith(b"HTTP/1.1 "):
                    time.sleep(self.delay_s)
                    self.answers += 1
                    if self.every and next(self._count) % self.every == 0:
                        self.lost += 1
                        break  # the server has done it, and nobody hears of it
                client.sendall(data)
        except OSError:
            pass
        for one in (client, server):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


def refusal(status: int, code: str) -> bytes:
    """An answer of S3 that refuses a request."""
    body = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>no</Message></Error>'
    return f"HTTP/1.1 {status} No\r\nConnection: close\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports
