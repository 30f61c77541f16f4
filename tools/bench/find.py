"""How well things are found by one of them, on made places where things repeat; beside the cosine of embeddings.

    python -m tools.bench.find --cache FOLDER --seeds 300 306

Of every place (`find_places`; seeds that `tools.fit.find` does not use): three captures, registered into one map.
Asked is every thing that shows at least half of its object: its other sightings and those of its twins are right, parts
of these neither right nor wrong, everything else wrong, chairs of another look among it.

things     each thing alone is ranked: by likeness, and by the cosine of the mean embedding of the nodes in it
objects    `Map.find --like` on the map of the captures, whose hits stand for the sightings of their objects
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

import gsmap
from gsmap.find import SimilarityModel
from gsmap.map.objects.map_objects import compute_objects
from tools.bench.find_scores import QUERIES, average_precisions, by_cosine, by_model, items_of, precision
from tools.harness import argument_parser
from tools.make import find_places


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(300, 306), metavar=("FIRST", "END"))
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--maps", type=int, default=1, help="of so many places a map is made, too")
    args = parser.parse_args()
    model = SimilarityModel.load()
    scores: dict[str, dict[str, list[float]]] = {"likeness": defaultdict(list), "cosine": defaultdict(list)}
    for seed in range(*args.seeds):
        items = items_of(find_places.cached(seed, args.cache))
        for how, score in (("likeness", lambda q: by_model(model, q)), ("cosine", by_cosine)):
            for name, ap in average_precisions(items, score):
                scores[how][name].append(ap)
    for how, found in scores.items():
        show(f"things by {how}", found)
    for seed in range(args.seeds[0], args.seeds[0] + args.maps):
        by_map(seed)


def show(what: str, found: dict[str, list[float]]) -> None:
    every = [ap for aps in found.values() for ap in aps]
    parts = ", ".join(f"{name} {np.mean(aps):.3f} ({len(aps)})" for name, aps in sorted(found.items()))
    print(f"{what}: mAP {np.mean(every):.3f} of {len(every)} queries: {parts}", flush=True)


def by_map(seed: int) -> None:
    """The same through the door of a map, whose objects are fused over captures."""
    place = find_places.make(seed)
    found = find_places.sightings(place)
    kind = {(item.capture, item.thing): item for item in items_of(found)}
    with tempfile.TemporaryDirectory() as folder, gsmap.map.create(Path(folder) / "found.gsmap") as m:
        for row, capture in enumerate(place.captures):
            m.ingest(capture.gaussians, cameras=capture.cameras, name=f"place_{row}", scale="known")
        m.update()
        number = {scene.id: int(scene.name.removeprefix("place_")) for scene in m.scenes()}
        objects = {thing.id: thing for thing in compute_objects(m.store, m.settings, lambda *_: None).objects}
        shown = {
            name: [(number[s.scene], s.thing) for s in thing.sightings if s.thing >= 0]
            for name, thing in objects.items()
        }
        scores: dict[str, list[float]] = defaultdict(list)
        spent: list[float] = []
        for name, mine in shown.items():
            query = next((kind[one] for one in mine if one in kind and kind[one].good), None)
            if query is None or query.name not in QUERIES:
                continue
            began = time.process_time()
            hits = m.find(like=name, top=len(objects)).hits
            spent.append(time.process_time() - began)
            ranked = [kind[one] for hit in hits for one in shown[hit.object or ""] if one in kind]
            ap = precision(query, ranked, list(kind.values()))
            if ap is not None:
                scores[query.name].append(ap)
        show(f"objects of the map of place {seed}", scores)
        print(f"{np.median(spent):.2f} CPU s to find one among {len(objects)} objects")


if __name__ == "__main__":
    main()
