"""A made map as the page is told of it, and a server that takes reviews of it: the panels without a map on disk."""

from __future__ import annotations

import http.server
import io
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

# As gsmap/view/server.py has it.
CSP = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; "
    "connect-src 'self' blob: data:; style-src 'self'; img-src 'self' data:"
)
KINDS = ("appeared", "disappeared", "moved", "recoloured", "replaced", "lighting")
_KIND_OF = {".js": "text/javascript", ".css": "text/css", ".html": "text/html; charset=utf-8"}


def made_map(scenes: int = 12, second_island: int = 2, hostile: bool = False) -> dict[str, Any]:
    """A row of scenes 3 m apart in island 0, joined by edges of every kind; a second island; changes; photos."""
    rooms = ("hall", "stairs", "kitchen", "workshop", "office east", "office west", "cellar", "corridor")
    rows = []
    for i in range(scenes + second_island):
        component = int(i >= scenes)
        pose = np.eye(4)
        pose[0, 3] = 3.0 * (i - scenes * component)
        name = f"{rooms[i % len(rooms)]} {2024 + i // 8}-{i % 12 + 1:02d}"
        if hostile and i == 0:
            name = '<img src=x onerror="window.hacked=1"><script>window.hacked=1</script>' + "W" * 180
        corners = [[pose[0, 3] + x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)]
        rows.append(
            {
                "id": f"{i:012x}",
                "name": name,
                "num_gaussians": 150_000 + 1000 * i,
                "num_cameras": 40 + i,
                "captured_at": None if i == 3 else f"{2024 + i // 8}-{i % 12 + 1:02d}-11T09:30:00+00:00",
                "component": component,
                "status": ("placed", "placed", "tentative")[i % 3] if i else "placed",
                "S_map_scene": pose.tolist(),
                "box": [[-1, -1, 0], [1, 1, 2]],
                "corners": corners,
                "sigma_m": 0.004 * i if i else None,
                "ellipsoid": (np.eye(3) * 1e-4).tolist(),
                "middle": [pose[0, 3], 0, 1],
                "tileset": f"scenes/{i:012x}/tileset.json",
                "extras": f"scenes/{i:012x}/extras.json",
                "tags": ["ground", "north"] if i % 2 else ["ground"],
                "prior": "position, 0.30 m" if i == 4 else None,
                "prior_number": 1 if i == 4 else None,
            }
        )
    states = ("used", "tentative", "used", "undecided", "rejected", "used", "no_match")
    edges = []
    for i in range(scenes - 1):
        edges.append(_edge(i, i + 1, states[i % len(states)], hostile and i == 1))
    changes = [
        {
            "id": f"c{i + 1}",
            "kind": kind,
            "component": 0,
            "box": [[3.0 * i, 0, 0], [3.0 * i + 0.6, 0.5, 0.8]],
            "older": i,
            "newer": i + 1,
            "newer_at": rows[i + 1]["captured_at"],
            "confidence": 0.95 - 0.07 * i,
            "status": "open",
            "pictures": [f"changes/c{i + 1}-before.jpg", f"changes/c{i + 1}-after.jpg"],
            "note": "",
        }
        for i, kind in enumerate(KINDS)
        if i + 1 < scenes
    ]
    return {
        "schema": 1,
        "state": "s0",
        "title": "<b>made</b>" if hostile else "Plant 4, ground floor",
        "actions": True,
        "revision": 3,
        "stale": False,
        "components": [
            {
                "component": k,
                "num_scenes": (scenes, second_island)[k],
                "up": [0, 0, 1],
                "metres_per_unit": (1.0, 0.5)[k],
                "scale_sigma": (0.01, None)[k],
                "box": [[-1, -1, 0], [3.0 * (scenes, second_island)[k] - 2, 1, 2]],
                "overview": {
                    "uri": f"overviews/{k}/none.spz",
                    "pending": 0,
                    "scenes": [],
                    "counts": [],
                    "frame": None,
                    "outline": None,
                    "has_ceiling": k == 0,
                    "size": [3.0 * (scenes, second_island)[k] - 1, 2, 2],
                },
                "plan": f"plans/{k}.json",
                "merged": "merged/tileset.json" if k == 0 else None,
            }
            for k in range(2 if second_island else 1)
        ],
        "scenes": rows,
        "edges": edges,
        "revisions": [
            {
                "number": k,
                "created_at": f"2025-0{k}-02T10:00:00+00:00",
                "scenes": scenes - 3 + k,
                "edges_used": 6 + k,
                "poses": f"revisions/{k}.json",
            }
            for k in (1, 2, 3)
        ],
        "changes": changes,
        "compared": [],
        "uncompared": [],
        "photos": [
            {
                "file": f"IMG_{i:04d}.jpg",
                "component": 0,
                "T_map_camera": [[1, 0, 0, 2.0 * i], [0, 0, 1, -4], [0, -1, 0, 1.6], [0, 0, 0, 1]],
                "intrinsics_px": [1000, 1000, 960, 540],
                "size_px": [1920, 1080],
                "captured_at": f"2025-03-0{i + 1}T12:00:00+00:00",
            }
            for i in range(3)
        ],
        "counts": {"gaussians": sum(row["num_gaussians"] for row in rows)},
        "graph": "graph.json",
        "history": "history.json",
    }


def _edge(target: int, source: int, how: str, hostile: bool) -> dict[str, Any]:
    reasons = {
        "tentative": "no cycle confirms it",
        "undecided": "another group of edges contradicts it",
        "rejected": "colours disagree where surfaces coincide (correlation 0.21)",
        "no_match": "no pose was found",
    }
    return {
        "target": target,
        "source": source,
        "status": how if how in ("rejected", "no_match") else "accepted",
        "used": {"used": True, "tentative": "tentative", "undecided": False}.get(how, False),
        "one_pair": False,
        "undecided": how == "undecided",
        "review": None,
        "note": "",
        "reason": "<script>window.hacked=1</script>" if hostile else reasons.get(how, ""),
        "probability": None if how == "no_match" else {"used": 0.99, "tentative": 0.93}.get(how, 0.4),
        "overlap": 0.31,
        "num_inliers": 84,
        "doubt": {"used": 0, "tentative": 0.6, "undecided": 0.9, "rejected": 0.3, "no_match": 0}[how],
        "detail": f"edges/{target:012x}-{source:012x}.json",
    }


class MadeServer:
    """Serves a built page and a made map on this machine; `gone` ends it, `back` starts it on the same port.

    `log` has every action that it took.
    """

    def __init__(self, built: Path, summary: dict[str, Any]) -> None:
        self.built, self.map, self.log = built, summary, []
        self.events: dict[str, list[dict[str, str]]] = {}
        self.priors = ["position, 0.30 m"]  # that were ever told; numbered from one
        self.names: dict[str, str] = {}  # that were given to objects
        self.refuse: str | None = None  # what the next action is answered with
        self.delay_s = 0.0
        self._http: http.server.ThreadingHTTPServer | None = None
        self.port = 0
        self.back()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def back(self) -> None:
        handler = type("Handler", (_Handler,), {"made": self})
        self._http = http.server.ThreadingHTTPServer(("127.0.0.1", self.port), handler)
        self._http.daemon_threads = True
        self.port = self._http.server_port
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()

    def gone(self) -> None:
        assert self._http is not None
        self._http.shutdown()
        self._http.server_close()
        self._http = None

    def act(self, name: str, body: dict[str, Any]) -> None:
        if self.refuse:
            said, self.refuse = self.refuse, None
            raise ValueError(said)
        self.log.append((name, body))
        self.map["state"] = f"s{len(self.log)}"
        if name in ("confirm", "reject", "withdraw"):
            self._review(name, body["what"], body["note"])
        elif name in ("prior", "remove_prior", "earlier_prior"):
            scene = next(row for row in self.map["scenes"] if row["id"] == body["scene"])
            if name == "prior":
                self.priors.append(f"pose, {body['sigma_m']} m, {body['sigma_deg']}°")
            number = {"prior": len(self.priors), "remove_prior": None}.get(name, body.get("number"))
            scene |= {"prior": None if number is None else self.priors[number - 1], "prior_number": number}
        elif name == "date":
            scene = next(row for row in self.map["scenes"] if row["id"] == body["scene"])
            scene["captured_at"] = None if body["captured_at"] == "none" else body["captured_at"]
        elif name == "compare":
            self.map["compared"] += self.map["uncompared"]
            self.map["uncompared"] = []
        elif name == "name_object":
            self.names[body["object"]] = body["name"]
        elif name == "optimize":
            self.map["revision"] += 1
            last = self.map["revisions"][-1]
            number = self.map["revision"]
            self.map["revisions"].append({**last, "number": number, "poses": f"revisions/{number}.json"})
        self.map["stale"] = name != "optimize"

    def _review(self, verdict: str, what: str, note: str) -> None:
        if what.startswith("c"):
            change = next(row for row in self.map["changes"] if row["id"] == what)
            change["status"] = {"confirm": "confirmed", "reject": "rejected"}.get(verdict, "open")
            change["note"] = "" if verdict == "withdraw" else note
            return
        ids = [row["id"] for row in self.map["scenes"]]
        a, b = (ids.index(one) for one in what.split(":"))
        edge = next(row for row in self.map["edges"] if (row["target"], row["source"]) == (a, b))
        edge["review"] = None if verdict == "withdraw" else verdict
        edge["note"] = "" if verdict == "withdraw" else note
        self.events.setdefault(what, []).append({"at": "2025-06-01T10:00:00+00:00", "what": verdict, "reason": note})

    def file(self, path: str) -> tuple[bytes, str]:
        """What a GET gives; KeyError where there is nothing."""
        name, _, query = path.partition("?")
        name = name.lstrip("/") or "index.html"
        if name == "map.json":
            return _json(self.map)
        if name == "state.json":
            return _json({"state": self.map["state"]})
        if name == "graph.json":
            return _json(self._graph())
        if name == "history.json":
            return _json(
                {
                    "rows": [
                        {"captured_at": "2024-02-11", "scene": 1, "state": "a chair appeared", "object": "o1"},
                        {
                            "captured_at": "2024-05-11",
                            "scene": 4,
                            "state": f"it was moved ({query[:2]})",
                            "object": None,
                        },
                    ]
                }
            )
        folder, _, rest = name.partition("/")
        if folder == "revisions":
            number = int(rest.removesuffix(".json"))
            rows = [
                {k: s[k] for k in ("component", "status", "S_map_scene")} | {"scene": i}
                for i, s in enumerate(self.map["scenes"][: 6 + 2 * number])
            ]
            return _json({"number": number, "scenes": rows})
        if folder == "edges" and rest.endswith(".json"):
            return _json(self._detail(rest.removesuffix(".json")))
        if folder == "plans":
            return _json(
                {
                    "picture": None,
                    "size_m": [40, 20],
                    "P_plan_map": [[1 / 40, 0, 0, 0.1], [0, -1 / 20, 0, 0.5]],
                    "scenes": [{"scene": k, "at": [0.5 + 0.3 * k, 0.9], "outlines": []} for k in range(2)],
                }
            )
        if folder == "changes" or rest.endswith(".jpg"):
            return _picture(name), "image/jpeg"
        file = self.built / name
        if file.is_file() and file.parent == self.built:
            return file.read_bytes(), _KIND_OF.get(file.suffix, "application/octet-stream")
        raise KeyError(path)

    def _detail(self, pair: str) -> dict[str, Any]:
        ids = [row["id"] for row in self.map["scenes"]]
        a, b = (ids.index(one) for one in pair.split("-"))
        edge = next(row for row in self.map["edges"] if (row["target"], row["source"]) == (a, b))
        none = edge["status"] == "no_match"
        views = [
            {
                "camera": f"frame_{k:04d}.png",
                **{w: f"edges/{pair}/{k}-{w}.jpg" for w in ("target", "source", "difference")},
            }
            for k in (12, 31, 57)
        ]
        held = edge["status"] == "accepted"
        return {
            "target": a,
            "source": b,
            "S_target_source": None if none else np.eye(4).tolist(),
            "steps": [
                {"name": "retrieval", "value": "tried: no. 1 of what hall was paired with, score 0.82",
                 "bar": "among the candidates", "passed": True},
                {"name": "clique", "value": "84", "bar": "", "passed": None},
                {"name": "coinciding cells", "value": "412", "bar": "at least 60", "passed": True},
                {"name": "colour correlation", "value": "0.74" if held else "0.21",
                 "bar": "at least 0.35", "passed": held},
                {"name": "free-space violation", "value": "0.031", "bar": "at most 0.12", "passed": True},
                {"name": "probability", "value": "0.93", "bar": "at least 0.9, of all of these", "passed": True},
                {"name": "the other edges", "value": "tentative", "bar": "bear it out: used", "passed": False},
            ],
            "advice": ["a further capture that overlaps both closes a loop that bears it out or contradicts it"],
            "correspondences": [] if none else [[[k, 0, 1], [k + 0.02, 0, 1]] for k in range(84)],
            "views": [] if none else views,
            "events": [
                {"at": "2025-03-02T10:00:00+00:00", "what": edge["status"], "reason": edge["reason"]},
                *self.events.get(f"{ids[a]}:{ids[b]}", []),
            ],
        }  # fmt: skip

    def _graph(self) -> dict[str, Any]:
        names = [self.names.get(f"o{k + 1}", n) for k, n in enumerate(("chair", "red cabinet", "forklift", "plant"))]
        objects = [
            {
                "id": f"o{k + 1}",
                "name": name,
                "label": "",
                "picture": f"objects/o{k + 1}.jpg",
                "component": 0,
                "position": [2.0 * k, 0, 0.4],
                "box": [[2.0 * k - 0.3, -0.3, 0], [2.0 * k + 0.3, 0.3, 0.9]],
                "first_seen": "2024-01-11",
                "last_seen": f"2025-0{k + 1}-11",
                "there": k != 2,
                "seen": 3 + k,
                "room": f"r{1 + k // 2}",
            }
            for k, name in enumerate(names)
        ]
        relations = [{"subject": "o1", "relation": "stands beside", "other": "o2"}]
        rooms = []
        for k, other in ((0, "r2"), (1, "r1")):
            corners = [[4.0 * k + x, y, 0] for x, y in ((-1, -1), (3, -1), (3, 2), (-1, 2))]
            outline = [[corners[i - 1], corners[i]] for i in range(4)]
            rooms.append({"id": f"r{k + 1}", "component": 0, "outline": outline, "area_m2": 12.0, "doors": [other]})
        return {"objects": objects, "relations": relations, "rooms": rooms, "changes": {"c1": "r1", "c2": "r2"}}


class _Handler(http.server.BaseHTTPRequestHandler):
    made: MadeServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        try:
            self._answer(*self.made.file(self.path))
        except (KeyError, ValueError, StopIteration):
            self._answer(b"nothing here", "text/plain", 404)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        try:
            assert self.headers["Content-Type"] == "application/json"
            assert self.headers["Origin"] == f"http://127.0.0.1:{self.made.port}"
            threading.Event().wait(self.made.delay_s)
            self.made.act(self.path.rpartition("/")[2], json.loads(body))
            self._answer(*_json({"map": self.made.map}))
        except ValueError as error:
            self._answer(*_json({"error": str(error)}), 400)

    def _answer(self, body: bytes, kind: str, status: int = 200) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", CSP)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Quiet."""


def _json(value: object) -> tuple[bytes, str]:
    return json.dumps(value, allow_nan=False).encode(), "application/json"


def _picture(name: str) -> bytes:
    """A room drawn with a few boxes; the source's are a little aside."""
    size = (480, 320)
    rng = np.random.default_rng(sum(map(ord, name.split("-")[0])))
    ground = np.linspace(150, 60, size[1])[:, None, None] * np.array([1, 0.97, 0.9])
    picture = np.broadcast_to(ground, (size[1], size[0], 3)).copy()
    for _ in range(7):
        x, y = rng.integers(0, size[0] - 100), rng.integers(120, size[1] - 80)
        colour = rng.uniform(40, 220, 3)
        aside = 7 if "source" in name else 0
        picture[y : y + 80, x + aside : x + aside + 90] = colour
    if "difference" in name:
        picture = np.abs(picture - np.roll(picture, 7, axis=1))
    out = io.BytesIO()
    Image.fromarray(picture.clip(0, 255).astype("u1")).save(out, "JPEG")
    return out.getvalue()
