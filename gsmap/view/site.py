"""Write a static page of a map: a folder for any web server, or one HTML file.

Both contain the responses of `gsmap.view.answers` to GET requests, under the same addresses, except for those computed
on request. A folder has the whole tree of each scene; a file the part of the trees that fits.
"""

from __future__ import annotations

import base64
import hashlib
import heapq
import json
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import CorruptError, GsmapError, InputError, NotFoundError
from gsmap.formats.tiles3d import CONTENT_FOLDER
from gsmap.markup import Markup, joined, policy_meta, source_of, tag
from gsmap.types.progress import Progress
from gsmap.view.answers import Answers, jpeg
from gsmap.view.content import ServerState, ViewMap, ViewOverview, summary
from gsmap.view.levels import OVERVIEW_GAUSSIANS, Levels, members
from gsmap.view.page_source import PageSource
from gsmap.view.params import Params
from gsmap.view.trees import FILE_NAME

CSP = {
    "default-src": "'none'",
    "script-src": "'self' 'wasm-unsafe-eval'",
    "worker-src": "blob:",
    "connect-src": "'self'",
    "style-src": "'self'",
    "img-src": "'self' data:",
    "base-uri": "'none'",
    "form-action": "'none'",
}
"""Content-Security-Policy of the page. Spark needs WebAssembly from its script, and workers from blobs."""

_MERGED_SUFFIXES = (".json", ".glb")
_OBJECT_PICTURES = 300  # largest number of objects with pictures
_HEAD = re.compile(r"<head[^>]*>", re.IGNORECASE)
_SCRIPT = re.compile(r'<script type="module"[^>]*\bsrc="(?:\./)?([^"]+)"[^>]*>\s*</script>')
_STYLE = re.compile(r'<link rel="stylesheet"[^>]*\bhref="(?:\./)?([^"]+)"[^>]*/?>')
# Serve the fetches of the page from the file itself, and block all others.
_EMBEDDED = """
(() => {
  const files = JSON.parse(document.getElementById("gsmap-files").textContent);
  const kinds = { json: "application/json", glb: "model/gltf-binary", jpg: "image/jpeg" };
  const base = new URL(".", document.baseURI).href;
  globalThis.fetch = async (input) => {
    const url = new URL(input instanceof Request ? input.url : String(input), document.baseURI);
    const whole = url.href.split(/[?#]/)[0];
    const name = whole.startsWith(base) ? decodeURIComponent(whole.slice(base.length)) : whole;
    const text = Object.hasOwn(files, name) ? files[name] : undefined;
    const missing = JSON.stringify({ error: `${name} is not in this file` });
    if (text === undefined) return new Response(missing, { status: 404 });
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const kind = kinds[name.split(".").pop()] ?? "application/octet-stream";
    return new Response(bytes, { headers: { "Content-Type": kind } });
  };
})();
"""


@dataclass(frozen=True)
class SiteContents:
    """A summary of the content of a static page.

    Args:
        num_bytes: Total size.
        num_scenes: Number of scenes with levels of detail.
        notes: Notes for the user, such as scenes that could not be read.
    """

    num_bytes: int
    num_scenes: int
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class _Maker:
    page_source: PageSource
    levels: Levels
    params: Params
    progress: Progress
    notes: list[str] = field(default_factory=list)

    def files(self, view: ViewMap, *, size: int | None = None, pictures: bool = True) -> Iterator[tuple[str, bytes]]:
        """Yield the address and bytes of all files except trees and merged tiles, ``map.json`` last.

        Args:
            view: Content of the map.
            size: Number of Gaussians per scene in an overview; default: by the size of the component.
            pictures: Include pictures of pairs, changes and objects.
        """
        overviews: dict[int, ViewOverview] = {}
        boxes: dict[str, np.ndarray] = {}
        inside_of = members(view)
        for i, (component, inside) in enumerate(inside_of.items()):
            self.progress(0.5 + 0.2 * i / len(inside_of), f"overview {component}")
            made = self.tried(f"the overview of component {component}", lambda c=inside: self.levels.whole(c, size))  # type: ignore[misc]
            if made is None:
                continue
            data, overview, more = made
            uri = f"overviews/{component}/{hashlib.sha256(data).hexdigest()[:24]}.spz"
            overviews[component] = replace(overview, uri=uri)
            boxes |= more
            yield uri, data
        for entry in view.scenes:
            extras = self.tried(entry.scene.name, lambda e=entry: self.page_source.extras(e.scene.id))  # type: ignore[misc]
            yield f"scenes/{entry.scene.id}/extras.json", _json(extras or {"layers": {}, "cameras": []})
        for revision in view.revisions:
            if revision["poses"] is not None:
                yield revision["poses"], _json(self.page_source.revision(revision["number"]))
        yield from self._edges(view, pictures)
        drawn = []
        surest = sorted(view.changes, key=lambda change: -change["confidence"])
        for change in surest[: self.params.site_changes if pictures else 0]:
            name = change["id"]
            pair = self.tried(f"change {name}", partial(self.page_source.change_pictures, name))
            if pair is not None:
                drawn.append(name)
                for side, picture in zip(("before", "after"), pair, strict=True):
                    yield f"changes/{name}-{side}.jpg", jpeg(picture)
        has_objects = False
        if view.has_objects:
            graph = self.tried("the graph of objects", self.page_source.graph)
            if graph is not None:
                has_objects, objects = True, []
                for place, one in enumerate(graph["objects"]):
                    picture = None
                    if pictures and place < _OBJECT_PICTURES:
                        draw = partial(self.page_source.object_picture, one["id"])
                        picture = self.tried(f"object {one['id']}", draw)
                    if picture is not None:
                        yield f"objects/{one['id']}.jpg", jpeg(picture)
                    objects.append({**one, "picture": None if picture is None else f"objects/{one['id']}.jpg"})
                yield "graph.json", _json({**graph, "objects": objects})
        served = ServerState(False, boxes, overviews, live=False, drawn=frozenset(drawn))
        yield "map.json", _json({**summary(view, served), "graph": "graph.json" if has_objects else None})

    def _edges(self, view: ViewMap, pictures: bool) -> Iterator[tuple[str, bytes]]:
        answers = Answers(self.page_source, self.levels)
        for place, edge in enumerate(view.edges):
            self.progress(0.7 + 0.3 * place / len(view.edges), "edges")
            pair, views = (view.scenes[edge["target"]].scene.id, view.scenes[edge["source"]].scene.id), []
            detail = self.tried(f"edge {pair}", lambda p=pair: answers.edge(*p))  # type: ignore[misc]
            if detail is None:
                continue
            if pictures and place < self.params.site_pairs and detail["views"]:
                made = self.tried(f"pictures of {pair}", lambda p=pair: self.page_source.pair_pictures(*p))  # type: ignore[misc]
                for i, camera in enumerate(made.cameras if made else ()):
                    assert made is not None
                    names = {}
                    for kind in ("target", "source", "difference"):
                        names[kind] = f"edges/{pair[0]}-{pair[1]}/{i}-{kind}.jpg"
                        yield names[kind], jpeg(getattr(made, kind)[i])
                    views.append({"camera": camera, **names})
            yield f"edges/{pair[0]}-{pair[1]}.json", _json(detail | {"views": views})

    def tried(self, what: str, make: Callable[[], Any]) -> Any:
        """Return the result of a function; if its input is damaged or missing, note this and return None."""
        try:
            return make()
        except (CorruptError, NotFoundError, InputError) as error:
            self.notes.append(f"{what} is missing on the page: {error}")
            return None


def write_site(
    folder: Path,
    page_source: PageSource,
    levels: Levels,
    params: Params,
    page: Path,
    progress: Progress,
) -> SiteContents:
    """Write a static page into an empty folder.

    Args:
        folder: The folder.
        page_source, levels: Content of the map, and its levels of detail.
        params: Settings of the page.
        page: Folder of the built page.
        progress: Callback of the progress.
    """
    view, maker = page_source.content(), _Maker(page_source, levels, params, progress)
    num_scenes = 0
    for i, entry in enumerate(view.scenes):
        progress(0.5 * i / len(view.scenes), entry.scene.name)
        target = folder / "scenes" / entry.key
        copy = partial(_copy_tree, target=target)
        if maker.tried(entry.scene.name, lambda e=entry, c=copy: levels.read(e, c)):  # type: ignore[misc]
            num_scenes += 1
    for component in sorted(view.merged):
        for name, path in _merged(page_source.merged(component)):
            target = folder / "merged" / str(component) / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
    for address, data in maker.files(view):
        target = folder / address
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    for file in page.iterdir():
        if file.is_file():
            shutil.copyfile(file, folder / file.name)
    html = (folder / "index.html").read_text(encoding="utf-8")
    (folder / "index.html").write_text(_with_policy(html, CSP), encoding="utf-8")
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return SiteContents(size, num_scenes, tuple(maker.notes))


def write_page(
    path: Path,
    page_source: PageSource,
    levels: Levels,
    params: Params,
    page: Path,
    max_bytes: int,
    progress: Progress,
    mark: Markup | None = None,
) -> SiteContents:
    """Write the page with its map as one HTML file.

    Args:
        path: The file.
        page_source, levels: Content of the map, and its levels of detail.
        params: Settings of the page.
        page: Folder of the built page.
        max_bytes: Maximum size of the levels of detail in bytes; base64 text takes a third more.
        progress: Callback of the progress.
        mark: Element of the head by which the file is recognized.
    """
    view, maker = page_source.content(), _Maker(page_source, levels, params, progress)
    files: dict[str, bytes] = {}
    # A twentieth for the overviews, which are shown until the trees are loaded.
    size = max(1, min(OVERVIEW_GAUSSIANS, max_bytes // (20 * 20 * max(1, len(view.scenes)))))
    for address, data in maker.files(view, size=size, pictures=False):
        files[address] = data
    left = max_bytes - sum(len(data) for address, data in files.items() if address.startswith("overviews/"))
    trees: dict[str, tuple[dict[str, Any], dict[str, int]]] = {}
    for i, entry in enumerate(view.scenes):
        progress(0.5 * i / len(view.scenes), entry.scene.name)
        listed = maker.tried(entry.scene.name, lambda e=entry: levels.read(e, _listed))  # type: ignore[misc]
        if listed is not None:
            trees[entry.key] = listed
    fitting = _fitting(trees, left)
    for entry in view.scenes:
        if entry.key in fitting:
            tileset, tiles = fitting[entry.key]
            files[f"scenes/{entry.key}/{FILE_NAME}"] = _json(tileset)
            for uri, data in levels.read(entry, partial(_tiles, uris=tiles)).items():
                files[f"scenes/{entry.key}/{uri}"] = data
    listing = json.loads(files["map.json"])
    for component in listing["components"]:
        component["merged"] = None
    files["map.json"] = _json(listing)
    text = _one_file(page, files, mark)
    path.write_text(text, encoding="utf-8")
    return SiteContents(len(text.encode()), len(trees), tuple(maker.notes))


def _copy_tree(tree: Path, target: Path) -> bool:
    """Copy a tree to a folder."""
    (target / CONTENT_FOLDER).mkdir(parents=True, exist_ok=True)
    tiles = [f"{CONTENT_FOLDER}/{tile.name}" for tile in (tree / CONTENT_FOLDER).iterdir()]
    for name in (FILE_NAME, *tiles):
        shutil.copyfile(tree / name, target / name)
    return True


def _listed(tree: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """Return the tileset of a tree and the size of each of its tiles."""
    sizes = {f"{CONTENT_FOLDER}/{tile.name}": tile.stat().st_size for tile in (tree / CONTENT_FOLDER).iterdir()}
    return json.loads((tree / FILE_NAME).read_bytes()), sizes


def _tiles(tree: Path, uris: Iterable[str]) -> dict[str, bytes]:
    return {uri: (tree / uri).read_bytes() for uri in uris}


def _fitting(
    trees: Mapping[str, tuple[dict[str, Any], dict[str, int]]], max_bytes: int
) -> dict[str, tuple[dict[str, Any], list[str]]]:
    """Choose tiles within a size limit, coarse tiles of all trees first; return tilesets with their tiles."""
    kept: dict[str, set[str]] = {key: set() for key in trees}
    waiting: list[tuple[float, int, str, list[dict[str, Any]]]] = []
    for place, (key, (tileset, _)) in enumerate(trees.items()):
        heapq.heappush(waiting, (-float("inf"), place, key, [tileset["root"]]))
    number, left = len(waiting), max_bytes
    while waiting:
        error, _, key, tiles = heapq.heappop(waiting)
        size = sum(trees[key][1][tile["content"]["uri"]] for tile in tiles)
        if size > left and error != -float("inf"):  # keep the root of every scene
            continue
        left -= size
        kept[key] |= {tile["content"]["uri"] for tile in tiles}
        for tile in tiles:
            if tile.get("children"):
                number += 1
                heapq.heappush(waiting, (-tile["geometricError"], number, key, tile["children"]))
    return {key: (trees[key][0] | {"root": _cut(trees[key][0]["root"], kept[key])}, sorted(kept[key])) for key in trees}


def _cut(tile: dict[str, Any], kept: set[str]) -> dict[str, Any]:
    """Return a tile with the children that were chosen; either all children of a tile are kept, or none."""
    children = [_cut(child, kept) for child in tile.get("children", ()) if child["content"]["uri"] in kept]
    rest = {name: value for name, value in tile.items() if name != "children"}
    return rest | ({"children": children} if children else {})


def _one_file(page: Path, files: Mapping[str, bytes], mark: Markup | None) -> str:
    """Return the page as one text, with style, script and all files embedded."""
    html = (page / "index.html").read_text(encoding="utf-8")
    script, style = _SCRIPT.search(html), _STYLE.search(html)
    if script is None:
        raise GsmapError(
            f"{page / 'index.html'} has no script: build the page again (tools/build_page.sh)",
            code="page_not_built",
        )
    code = (page / script[1]).read_text(encoding="utf-8").replace("</script", "<\\/script").replace("<!--", "<\\!--")
    packed = {address: base64.b64encode(data).decode() for address, data in files.items()}
    data = json.dumps(packed).replace("<", "\\u003c")
    inside = joined(
        tag("script", Markup(data), id="gsmap-files", type="application/json"),
        tag("script", Markup(_EMBEDDED)),
        tag("script", Markup(code), type="module"),
    )
    html = html[: script.start()] + html[script.end() :]
    text = ""
    if style is not None:
        text = (page / style[1]).read_text(encoding="utf-8").replace("</style", "<\\/style")
        html = html.replace(style[0], tag("style", Markup(text)).html)
    end = html.rindex("</body>")
    html = html[:end] + inside.html + html[end:]
    policy = CSP | {
        "script-src": f"{source_of(_EMBEDDED)} {source_of(code)} 'wasm-unsafe-eval'",
        "connect-src": "'none'",
        "style-src": source_of(text),
        "img-src": "data:",
    }
    return _with_policy(html, policy, mark)


def _with_policy(html: str, policy: Mapping[str, str], mark: Markup | None = None) -> str:
    head = _HEAD.search(html)
    if head is None:
        raise GsmapError(
            "the page has no head element: build the page again (tools/build_page.sh)", code="page_not_built"
        )
    return html[: head.end()] + joined(mark, policy_meta(policy)).html + html[head.end() :]


def _merged(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield the addresses and the files of a component's 3D Tiles in an export folder."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink() and path.suffix in _MERGED_SUFFIXES:
            yield path.relative_to(folder).as_posix(), path


def _json(value: object) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
