"""Compute the response to each address of the page's server, as `gsmap.view.contract` defines it."""

from __future__ import annotations

import hashlib
import io
import json
import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from http import HTTPStatus

import numpy as np

from gsmap.durable import open_file
from gsmap.errors import ConfigError, CorruptError, NotFoundError
from gsmap.view.content import ServerState, ViewMap, ViewScene, summary
from gsmap.view.contract import EdgeDetail, EdgeView, MapSummary, TreeProgress
from gsmap.view.levels import Levels
from gsmap.view.making import PendingResult
from gsmap.view.page_source import PageSource, PairPictures
from gsmap.view.trees import FILE_NAME

JSON, BYTES, JPEG = "application/json", "application/octet-stream", "image/jpeg"
# Delay before the page asks again for a pending result: base, increment per job ahead of it, maximum.
_RETRY_S, _EACH_S, _LONGEST_S = 0.5, 0.1, 10.0
_JPEG_QUALITY = 88
_PICTURES_KEPT = 64  # maximum number of pictures in memory
_ID = r"[0-9a-f]{32}"
_MERGED = re.compile(r"(?:[A-Za-z0-9_-][A-Za-z0-9._-]{0,200}/){0,4}[A-Za-z0-9_-][A-Za-z0-9._-]{0,200}\.(?:json|glb)")


@dataclass(frozen=True)
class Answer:
    """Response body with its metadata.

    Args:
        body: Content.
        kind: MIME type.
        status: HTTP status.
        etag: Entity tag of bytes that never change under their address; empty otherwise.
        headers: Further headers.
    """

    body: bytes
    kind: str
    status: HTTPStatus = HTTPStatus.OK
    etag: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def json(cls, value: object, status: HTTPStatus = HTTPStatus.OK) -> Answer:
        return cls(json.dumps(value, allow_nan=False, separators=(",", ":")).encode(), JSON, status)

    @property
    def is_text(self) -> bool:
        return self.kind == JSON or self.kind.startswith("text/")


class Answers:
    """The responses of the page of one map.

    Args:
        page_source: Content of the map.
        levels: Levels of detail of its scenes.
    """

    def __init__(self, page_source: PageSource, levels: Levels) -> None:
        self._page_source, self._levels = page_source, levels
        self._pictures: OrderedDict[str, bytes] = OrderedDict()
        self._drawing, self._reading, self._planning = threading.Lock(), threading.Lock(), threading.Lock()
        self._content: tuple[str, ViewMap] | None = None
        self._plans: tuple[str, dict[int, Answer]] = "", {}
        self._ahead: threading.Thread | None = None
        self._routes: list[tuple[re.Pattern[str], Callable[..., Answer]]] = [
            (re.compile(pattern), route)
            for pattern, route in (
                (r"/map\.json", self._map),
                (r"/state\.json", self._state),
                (rf"/scenes/({_ID})/extras\.json", self._extras),
                (r"/scenes/([0-9a-z-]{1,80})/tileset\.json", self._tileset),
                (r"/scenes/([0-9a-z-]{1,80})/(tiles/[0-9a-z-]{1,120}\.glb)", self._tile),
                (r"/overviews/(\d{1,8})/([0-9a-z]{1,40})\.spz", self._overview),
                (r"/merged/(\d{1,8})/(.{1,400})", self._merged),
                (rf"/edges/({_ID})-({_ID})\.json", self._edge),
                (rf"/edges/({_ID})-({_ID})/(\d{{1,2}})-(target|source|difference)\.jpg", self._pair_picture),
                (r"/changes/(c\d{1,9})-(before|after)\.jpg", self._change_picture),
                (r"/revisions/(\d{1,9})\.json", self._revision),
                (r"/objects/([0-9a-z]{1,12})\.jpg", self._object_picture),
                (r"/plans/(\d{1,8})\.json", self._plan),
                (r"/graph\.json", self._graph),
                (r"/history\.json", self._history),
            )
        ]

    def get(self, path: str, asked: Mapping[str, str]) -> Answer:
        """Return the response to an address.

        Args:
            path: Path of the address, from ``/`` on.
            asked: Query parameters.

        Raises:
            GsmapError: The response cannot be made.
        """
        for pattern, route in self._routes:
            if (found := pattern.fullmatch(path)) is not None:
                # What a person waits for goes before levels of detail, which come by and by.
                with nullcontext() if route in self._of_levels else self._levels.paused():
                    return route(*found.groups(), **({"asked": asked} if route in self._asking else {}))
        raise NotFoundError(f"the page has no address {path}", code="page_not_found")

    @property
    def _asking(self) -> tuple[Callable[..., Answer], ...]:
        return self._tileset, self._history

    @property
    def _of_levels(self) -> tuple[Callable[..., Answer], ...]:
        return self._map, self._state, self._tileset, self._tile, self._overview, self._merged

    def content(self) -> ViewMap:
        """Return the current map, read again if it has changed."""
        state = self._page_source.state()
        with self._reading:
            if self._content is None or self._content[0] != state:
                self._content = state, self._page_source.content()
            return self._content[1]

    def summary(self) -> MapSummary:
        """Return the current ``map.json``."""
        view = self.content()
        overviews, levels = self._levels.overviews(view)
        served = ServerState(bool(self._page_source.actions), self._levels.boxes(), overviews)
        return {**summary(view, served), "state": _state(view.state, levels)}

    def _map(self) -> Answer:
        return Answer.json(self.summary())

    def _state(self) -> Answer:
        return Answer.json({"state": _state(self.content().state, self._levels.state())})

    # --- levels of detail --------------------------------------------------------------------------------------------

    def _entry(self, key: str) -> ViewScene:
        found = next((one for one in self.content().scenes if one.key == key), None)
        if found is None:
            raise NotFoundError(
                "the map has no scene of this id any more: fetch map.json again", code="content_outdated"
            )
        return found

    def _tileset(self, key: str, asked: Mapping[str, str]) -> Answer:
        entry = self._entry(key)
        self._levels.look_at(self.content(), entry.scene.id)
        found = self._levels.tree(entry, _number(asked.get("rank", "0")))
        return _waiting(found) if isinstance(found, PendingResult) else Answer((found / FILE_NAME).read_bytes(), JSON)

    def _tile(self, key: str, uri: str) -> Answer:
        return Answer(self._levels.tile(self._entry(key), uri), "model/gltf-binary", etag=f'"{uri}"')

    def _overview(self, component: str, name: str) -> Answer:
        found = self._levels.overview(self.content(), int(component), name)
        return _waiting(found) if isinstance(found, PendingResult) else Answer(found, BYTES, etag=f'"{name}"')

    def _merged(self, component: str, name: str) -> Answer:
        if not _MERGED.fullmatch(name) or int(component) not in self.content().merged:
            raise NotFoundError(f"there is no merged/{component}/{name}", code="page_not_found")
        path = self._page_source.merged(int(component)) / name
        try:
            with open(open_file(path), "rb") as file:
                data = file.read()
        except (OSError, CorruptError) as error:
            raise NotFoundError(f"there is no merged/{component}/{name}", code="page_not_found") from error
        return Answer(data, JSON if path.suffix == ".json" else "model/gltf-binary")

    # --- data --------------------------------------------------------------------------------------------------------

    def _extras(self, scene: str) -> Answer:
        return Answer.json(self._page_source.extras(scene))

    def _revision(self, number: str) -> Answer:
        return Answer.json(self._page_source.revision(int(number)))

    def draw_ahead(self) -> None:
        """Start to draw the floor plan that a page shows first, before the page asks for it."""
        if self._ahead is None:
            self._ahead = threading.Thread(target=self._draw_first_plan, daemon=True)
            self._ahead.start()

    def close(self) -> None:
        """Wait until nothing is drawn ahead."""
        if self._ahead is not None:
            self._ahead.join()

    def _draw_first_plan(self) -> None:
        with suppress(Exception), self._levels.paused():  # the page's own request reports it
            self._plan("0")

    def _plan(self, component: str) -> Answer:
        state, number = self.content().state, int(component)
        with self._planning:
            if self._plans[0] != state:
                self._plans = state, {}
            plans = self._plans[1]
            if number not in plans:
                plans[number] = Answer.json(self._page_source.plan(number))
            return plans[number]

    def _graph(self) -> Answer:
        return Answer.json(self._page_source.graph())

    def _history(self, asked: Mapping[str, str]) -> Answer:
        component = asked.get("component", "0")
        if not component.isdecimal() or len(component) > 8:
            raise ConfigError(f"the component must be a number, got {component!r}", code="invalid_request")
        return Answer.json(self._page_source.history(asked.get("at", ""), int(component)))

    def _edge(self, target: str, source: str) -> Answer:
        return Answer.json(self.edge(target, source))

    def edge(self, target: str, source: str) -> EdgeDetail:
        """Return the `EdgeDetail` of a pair of scene ids."""
        detail = self._page_source.edge(target, source)
        at = f"edges/{target}-{source}"
        views: list[EdgeView] = [
            {
                "camera": camera,
                "target": f"{at}/{i}-target.jpg",
                "source": f"{at}/{i}-source.jpg",
                "difference": f"{at}/{i}-difference.jpg",
            }
            for i, camera in enumerate(self._page_source.pair_cameras(target, source))
        ]
        return {**detail, "views": views}

    # --- pictures ----------------------------------------------------------------------------------------------------

    def _pair_picture(self, target: str, source: str, place: str, name: str) -> Answer:
        wanted = f"{target}-{source} {place} {name}"

        def draw() -> dict[str, np.ndarray]:
            made: PairPictures = self._page_source.pair_pictures(target, source)
            return {
                f"{target}-{source} {i} {kind}": picture
                for kind in ("target", "source", "difference")
                for i, picture in enumerate(getattr(made, kind))
            }

        return self._drawn(wanted, draw)

    def _change_picture(self, change: str, which: str) -> Answer:
        def draw() -> dict[str, np.ndarray]:
            before, after = self._page_source.change_pictures(change)
            return {f"{change} before": before, f"{change} after": after}

        return self._drawn(f"{change} {which}", draw)

    def _object_picture(self, id: str) -> Answer:
        return self._drawn(f"object {id}", lambda: {f"object {id}": self._page_source.object_picture(id)})

    def _drawn(self, name: str, draw: Callable[[], Mapping[str, np.ndarray]]) -> Answer:
        """Return a picture from memory, or draw it together with all pictures of the same call, one call at a time."""
        state = self._page_source.state()
        with self._drawing:
            found = self._pictures.get(f"{state} {name}")
            if found is None:
                for one, picture in draw().items():
                    self._pictures[f"{state} {one}"] = jpeg(picture)
                while len(self._pictures) > _PICTURES_KEPT:
                    self._pictures.popitem(last=False)
                found = self._pictures.get(f"{state} {name}")
            else:
                self._pictures.move_to_end(f"{state} {name}")
        if found is None:
            raise NotFoundError(f"there is no such picture of {name.partition(' ')[0]}", code="page_not_found")
        return Answer(found, JPEG)


def jpeg(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) uint8 as JPEG."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(picture).save(out, "JPEG", quality=_JPEG_QUALITY)
    return out.getvalue()


def _state(of_map: str, of_levels: str) -> str:
    return hashlib.sha256(f"{of_map}|{of_levels}".encode()).hexdigest()[:24]


def _waiting(found: PendingResult) -> Answer:
    retry_s = round(min(_LONGEST_S, _RETRY_S + _EACH_S * found.waiting), 2)
    status: TreeProgress = {"progress": round(found.progress, 4), "waiting": found.waiting, "retry_s": retry_s}
    return Answer.json(status, HTTPStatus.ACCEPTED)


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise ConfigError(f"the rank must be a number, got {text!r}", code="invalid_request") from error
    return value if np.isfinite(value) else 0.0
