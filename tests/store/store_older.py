"""A map that schema 0001 wrote, and what is in it.

``releases/0.1.0.tar.xz`` was made by gsmap 0.1.0 (commit 0ff8db8): two scenes (the first with a date and a note), a
graph of each, two registrations of the pair with a confirmation that was withdrawn, three revisions, an export with one
tile, and a prior.
"""

import tarfile
from pathlib import Path

from sqlalchemy import Connection, MetaData, insert, select, text

from gsmap.store import Store
from gsmap.types import EdgeOutcome, Provenance

ARCHIVE = Path(__file__).with_name("releases") / "0.1.0.tar.xz"
TABLES = [
    *("about", "groups", "files", "scenes", "chunk_boxes", "graphs", "registrations", "verdicts"),
    *("revisions", "poses", "edges", "priors", "models", "exports", "tiles"),
]


def unpack(folder: Path) -> Path:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder / "old.gsmap"


def copy_rows(source: Connection, target: Connection) -> None:
    """Every row of an unpacked catalog, as it stands, into the same tables of another database."""
    there, here = MetaData(), MetaData()
    there.reflect(source, only=[t for t in TABLES if t != "chunk_boxes"])
    here.reflect(target, only=TABLES)
    for name in TABLES:
        if name == "chunk_boxes":
            columns = ("s0", "s1", "x0", "x1", "y0", "y1", "z0", "z1", "chunk")
            query = text(f"SELECT {', '.join(columns)} FROM chunk_boxes")
            rows = [dict(zip(columns, row, strict=True)) for row in source.execute(query)]
        else:
            rows = [dict(row) for row in source.execute(select(there.tables[name])).mappings()]
        if rows:
            target.execute(insert(here.tables[name]), rows)
        if target.dialect.name == "postgresql" and "number" in here.tables[name].columns and name != "revisions":
            last = f"SELECT COALESCE(MAX(number), 0) + 1 FROM {name}"
            target.execute(text(f"SELECT setval(pg_get_serial_sequence('{name}', 'number'), ({last}), false)"))


def check_all(store: Store) -> None:
    """Everything that the archive holds is there, in the words of today."""
    assert store.check().ok
    monday, tuesday = store.scenes.list()
    assert (monday.name, monday.captured_at, tuesday.name) == ("monday", "2026-01-02T03:04:05+00:00", "tuesday")
    assert monday.tags == ()
    assert [(f.kind, f.value) for f in store.scenes.facts("monday")] == [
        ("name", "monday"),
        ("captured_at", "2026-01-02T03:04:05+00:00"),
    ]
    assert store.scenes.facts("monday")[0].created_at == monday.ingested_at
    assert [f.kind for f in store.scenes.facts("tuesday")] == ["name"]
    assert len(store.scenes.gaussians("monday")) == 40
    assert len(store.scenes.cameras("tuesday")) == 3

    graph = store.graphs.load("monday")
    assert {name: len(nodes) for name, nodes in graph.layers.items()} == {
        "landmarks": 5,
        "landmarks_gravity_free:1": 3,
        "objects": 0,
    }
    free = graph.layers["landmarks_gravity_free:1"]
    assert (free.descriptor_id, free.unit_m) == ("m1", 1.45)
    assert (graph.up.tolist(), graph.unit_m, graph.notes) == ([0, 0.6, 0.8], 0.4, ("few nodes",))
    assert [g.recipe for g in store.graphs.list()] == [None, None]

    first, second = store.registrations.history("monday", "tuesday")
    assert (first.registration.proposer, second.registration.proposer) == ("kiss_matcher", "graph:landmarks")
    assert first.registration.evidence == {"log_nfa": -7.5, "free_space_violation": 0.25}
    assert (first.registration.notes, first.key, first.recipe, first.adopts) == ((), "key-1", None, None)
    assert first.registration.overlap == 0.1 + 0.2
    assert store.registrations.get("monday", "tuesday").number == 2
    said = store.registrations.reviews("monday", "tuesday")
    assert [(r.review, r.registration, r.note) for r in said] == [("confirm", 1, "looked at it"), ("withdraw", 1, "")]

    edge = (tuesday.id, monday.id)
    one, two, three = (store.revisions.get(number) for number in (1, 2, 3))
    assert one.settings == {"gate_probability": 0.999, "anneal": 16.0, "marginals": True}
    assert one.provenance == Provenance("batch", "", 2, "a41112002c7451ff", (tuesday.id,))
    assert two.provenance.method == "incremental"
    assert (three.settings, three.provenance, three.notes) == ({}, Provenance(), ())
    assert one.outcomes == {edge: EdgeOutcome("tentative", 2.5, "no cycle", undecided=True)}
    assert two.outcomes == {edge: EdgeOutcome("used", 0.5)}
    assert three.outcomes == {edge: EdgeOutcome("unused", None, "contradicts")}
    assert one.poses[monday.id].covariance[6, 6] == 1.0
    lines = store.revisions.list()
    assert [r.key for r in lines] == ["5d40e10ccfb76f12fc27017fbadbd344", "other", ""]
    assert [(r.num_used, r.num_tentative, r.num_unused, r.num_undecided) for r in lines] == [
        (0, 1, 0, 1),
        (1, 0, 0, 0),
        (0, 0, 1, 0),
    ]
    assert (lines[0].note, lines[0].recipe) == ("first", None)

    (tile,) = store.exports.tiles("/maps/tiles")
    assert (tile.key, tile.recipe, tile.notes) == ("tile-key", {"method": "tto [{}, null, false]"}, ())
    assert store.exports.list()[0].settings == {"merge": "tto"}
    assert store.priors.list()[0].up_sigma_rad == 0.02
    assert store.recipes.list() == []


def use(store: Store) -> None:
    """What a map is used for goes on."""
    from store_samples import key, make_cameras, make_gaussians
    from test_store_nouns import graph_of, registration

    scenes = store.scenes.list()
    a, b = (s.id for s in scenes)
    store.scenes.add(make_gaussians(seed=5), make_cameras(), name="wednesday")
    assert store.scenes.edit("monday", tags_add=["first"]).tags == ("first",)
    store.registrations.save(registration(a, b), key("register"))
    assert store.registrations.adopt(1).number == 4
    assert store.registrations.review("monday", "tuesday", "confirm").number == 4
    assert store.revisions.save(graph_of(scenes), key("optimize")) == 4
    assert store.check().ok
