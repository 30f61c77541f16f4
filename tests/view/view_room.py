"""A made map behind a page source of its own, and a page of a few bytes: what the tests of the server look through."""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.morton import morton_order
from gsmap.types import Gaussians, GaussianSource, Scene, ScenePose, Sim3
from gsmap.view import ViewMap, ViewScene, ViewServer
from gsmap.view.contract import EdgeEntry
from gsmap.view.page_source import PairPictures

A, B, C = ("a" * 32, "b" * 32, "c" * 32)


def blob(seed: int, n: int = 400, sh_degree: int = 0) -> Gaussians:
    """A cloud of Gaussians along its Morton curve, as scenes are stored."""
    rng = np.random.default_rng(seed)
    found = Gaussians(
        rng.normal(0, 0.4, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(-5, -3, (n, 3)),
        rng.normal(0.5, 2, n),
        rng.uniform(-1.7, 1.7, (n, (sh_degree + 1) ** 2, 3)),
    )
    return found[morton_order(found.means)]


def entry(scene: str, name: str, g: Gaussians, pose: ScenePose | None) -> ViewScene:
    bounds = np.stack([g.means.min(0), g.means.max(0)]).astype(float)
    return ViewScene(Scene(scene, name, len(g), g.sh_degree, 0, bounds), f"{scene}-v1", pose)


def edge(pair: tuple[int, int], status: str, **more: Any) -> EdgeEntry:
    made: Any = {"target": pair[0], "source": pair[1], "status": status, "used": None, "review": None}
    made |= {"note": "", "reason": "", "probability": None, "registration": None, "one_pair": False}
    made |= {"undecided": False, "overlap": 0.0, "num_inliers": 0, "doubt": 0.0}
    made["detail"] = "edges/{}-{}.json".format(*((A, B, C)[i] for i in pair))
    return made | more


def turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


POSE_A = Sim3(turn(0.3), np.array([0.0, 0, 0]))
POSE_B = Sim3(turn(-1.0), np.array([1.5, 0.2, 0.1]), 1.3)


@dataclass
class MadeDoors:
    """Three scenes, two of them placed; what people do is written down."""

    gaussians: dict[str, Gaussians] = field(default_factory=lambda: {A: blob(1), B: blob(2), C: blob(3)})
    done: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    read_only: bool = False
    view: ViewMap = field(default_factory=lambda: ViewMap("a map"))
    drawn: int = 0
    merged_folder: Path | None = None

    def __post_init__(self) -> None:
        cov = np.diag([1e-6] * 3 + [1e-4, 4e-4, 1e-4, 1e-6])
        scenes = [
            entry(A, "a", self.gaussians[A], ScenePose(A, POSE_A, 0, "placed", cov)),
            entry(B, "b", self.gaussians[B], ScenePose(B, POSE_B, 0, "tentative")),
            entry(C, "far <b>away</b>", self.gaussians[C], None),
        ]
        edges = [
            edge((0, 1), "accepted", used="tentative", num_inliers=21, overlap=0.4, doubt=0.7),
            edge((0, 2), "rejected"),
        ]
        self.view = ViewMap("a map", scenes, edges, state="s1", revision=1)

    def state(self) -> str:
        return self.view.state

    def content(self) -> ViewMap:
        return self.view

    def source(self, scene: str) -> GaussianSource:
        if scene not in self.gaussians:
            raise NotFoundError(f"no scene {scene}")
        return self.gaussians[scene]

    def extras(self, scene: str) -> dict[str, Any]:
        if scene not in self.gaussians:
            raise NotFoundError(f"no scene {scene}")
        return {"layers": {}, "cameras": []}

    def revision(self, number: int) -> dict[str, Any]:
        if number != 1:
            raise NotFoundError(f"no revision {number}")
        return {"number": 1, "scenes": []}

    def edge(self, target: str, source: str) -> dict[str, Any]:
        return {"target": 0, "source": 1, "steps": []}

    def pair_cameras(self, target: str, source: str) -> tuple[str, ...]:
        return ("one", "two")

    def pair_pictures(self, target: str, source: str) -> PairPictures:
        self.drawn += 1
        pictures = tuple(np.full((8, 10, 3), 40 * k, np.uint8) for k in range(2))
        return PairPictures(("one", "two"), pictures, pictures, pictures)

    def change_pictures(self, change: str) -> tuple[np.ndarray, np.ndarray]:
        raise NotFoundError(f"no change {change}")

    def graph(self) -> dict[str, Any]:
        return {"objects": [], "relations": [], "rooms": []}

    def history(self, at: str, component: int) -> dict[str, Any]:
        if at.count(",") != 2:
            raise InputError("a point is three numbers")
        return {"rows": []}

    def merged(self, component: int) -> Path:
        assert self.merged_folder is not None
        return self.merged_folder

    @property
    def actions(self) -> Mapping[str, Callable[[Mapping[str, Any]], None]]:
        return {} if self.read_only else {name: self._doing(name) for name in ("confirm", "reject", "optimize")}

    def _doing(self, name: str) -> Callable[[Mapping[str, Any]], None]:
        def act(said: Mapping[str, Any]) -> None:
            if said.get("what") == "nonsense":
                raise InputError("this makes no sense")
            self.done.append((name, dict(said)))
            self.view = replace(self.view, state=f"s{len(self.done) + 1}", title=f"after {name}")

        return act


def page_folder(tmp_path: Path) -> Path:
    """A page that says when it is there."""
    folder = tmp_path / "page"
    folder.mkdir(exist_ok=True)
    (folder / "index.html").write_text(
        '<!doctype html><html><head><title>a page</title><link rel="icon" href="data:," />'
        '<link rel="stylesheet" href="style.css" /><script type="module" src="page.js"></script></head>'
        "<body><canvas></canvas></body></html>"
    )
    (folder / "page.js").write_text("window.there = true;")
    (folder / "style.css").write_text("canvas { width: 100% }")
    (folder / "secret.sqlite").write_text("not for the browser")
    return folder


def ask(
    server: ViewServer,
    path: str,
    method: str = "GET",
    *,
    cookie: bool = True,
    body: bytes | None = None,
    **headers: str,
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of one request over a connection of its own, with the cookie."""
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    if cookie:
        sent.setdefault("Cookie", f"gsmap_view_{server.port}={server.token}")
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.request(method, path, body=body, headers=sent)
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), data


def told(server: ViewServer, path: str) -> Any:
    """The JSON of an address, waited for where it is in the making."""
    import time

    for _ in range(200):
        status, _, data = ask(server, path)
        if status == 200:
            return json.loads(data)
        assert status == 202, data
        time.sleep(0.05)
    raise AssertionError(f"{path} is never there")


def act(server: ViewServer, name: str, said: object, **headers: str) -> tuple[int, Any]:
    """Status and JSON of an action, asked for as the page does."""
    sent = {"Origin": f"http://127.0.0.1:{server.port}", "Content_Type": "application/json", **headers}
    body = said if isinstance(said, bytes) else json.dumps(said).encode()
    status, answered, data = ask(server, f"/actions/{name}", "POST", body=body, **sent)
    return status, json.loads(data) if answered.get("Content-Type") == "application/json" else data
