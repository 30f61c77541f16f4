"""What a capture takes in a map: files, bytes of its Gaussians and of its graph, and CPU to load the graph.

    python -m tools.bench.graphs MAP... [--repeat 20]

Bytes are those of the arrays as they were written, load is process time, the median of the repeats (the first read is
left out). A second table has the bytes of each array of all graphs together, packed.
"""

from __future__ import annotations

import statistics
from collections import Counter
from pathlib import Path

from gsmap.store import Store, array_archive
from tools.harness import argument_parser, timed


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--repeat", type=int, default=20)
    options = parser.parse_args()
    names = ("Gaussians", "nodes", "files", "scene kB", "graph kB", "ratio", "load ms")
    print(f"{'capture':14}" + "".join(f"{name:>10}" for name in names))
    shares: Counter[str] = Counter()
    for path in options.maps:
        with Store.open(path, "r") as store:
            for scene in store.scenes.list():
                _row(store, scene.name, options.repeat)
            for archive in (path / "arrays" / "graphs").glob(f"*/{array_archive.FILE}"):
                shares.update(_shares(archive))
    print()
    for name, num_bytes in shares.most_common():
        print(f"{name:24}{num_bytes / 1e3:10.1f} kB")


def _row(store: Store, name: str, repeat: int) -> None:
    graph = store.graphs.load(name)
    if graph is None:
        print(f"{name:14} has no graph")
        return
    times = [timed(store.graphs.load, name)[1] for _ in range(repeat)]
    scene = store.scenes.get(name)
    folders = [store.home / "arrays" / "scenes" / scene.id]
    with store.catalog.read() as connection:
        of_scene = f"kind = 'graphs' AND scene = '{scene.id}'"
        newest = f"SELECT group_id FROM results WHERE {of_scene} ORDER BY created_at DESC LIMIT 1"
        folders.append(store.home / "arrays" / "graphs" / connection.exec_driver_sql(newest).scalar_one())
    files = sum(path.is_file() for folder in folders for path in folder.rglob("*"))
    own, made = (sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) for folder in folders)
    print(
        f"{name:14}{scene.num_gaussians:10}{graph.num_nodes:10}{files:10}{own / 1e3:10.0f}{made / 1e3:10.0f}"
        f"{made / own:10.2f}{1e3 * statistics.median(times):10.1f}"
    )


def _shares(archive: Path) -> Counter[str]:
    """Bytes of each array of a graph, and of all that is no array."""
    with open(archive, "rb") as file:

        def read(start: int, stop: int) -> bytes:
            file.seek(start)
            return file.read(stop - start)

        size = archive.stat().st_size
        members = array_archive.read_members(size, read)
    out = Counter({"(names and places)": size - sum(m.size for key, m in members.items() if "/c/" in key)})
    for key, member in members.items():
        if "/c/" in key:
            out[key.partition("/c/")[0]] += member.size
    return out


if __name__ == "__main__":
    main()
