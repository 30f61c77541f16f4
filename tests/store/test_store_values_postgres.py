"""Branches, merging and purging of a map whose catalog is in a real PostgreSQL server."""

import numpy as np
from sqlalchemy import create_engine, text
from store_samples import key, make_cameras, make_gaussians

import gsmap.map
from gsmap.store import Store
from gsmap.store.merging import merge
from gsmap.types import PoseGraph, Registration, SceneGraph, ScenePose, Sim3


def add(store, seed, name=None):
    return store.scenes.add(make_gaussians(60, seed=seed), make_cameras(), name=name or f"scene{seed}")[0].id


def test_a_map_on_a_server_as_a_value(tmp_path, postgres_database):
    path = tmp_path / "m"
    with Store.create(path, catalog_url=postgres_database) as store:
        a = add(store, 0)
        gone = add(store, 1, "secret-garden")
        store.graphs.save(SceneGraph(a), key("describe", a))
        for scene in (a, gone):
            store.revisions.save(PoseGraph({scene: ScenePose(scene, Sim3.identity(), 0, "placed")}))
        store.branches.make("b")
        with Store.open(f"{path}@b") as branch:
            assert branch.catalog.is_sqlite
            assert [s.name for s in branch.scenes.list()] == ["scene0", "secret-garden"]
            assert branch.revisions.list()[0].origin == {"map": store.id, "number": 1}
            c = add(branch, 2)
            pose = Registration(a, c, "accepted", S_target_source=Sim3.identity(), information=np.eye(7), proposer="g")
            branch.registrations.save(pose, key("register", a, c))
            branch.registrations.review(a, c, "confirm", "seen")
            branch.revisions.save(PoseGraph({c: ScenePose(c, Sim3.identity(), 0, "placed")}))
            assert store.prune().num_orphans == 0  # the server's catalog knows what the branch names
            assert branch.prune().num_orphans == 0  # and the other way round
            merged = merge(store, branch)
            assert {merged.num_scenes, merged.num_registrations, merged.num_reviews, merged.num_revisions} == {1}
            again = merge(store, branch)
            assert (again.num_scenes, again.num_facts, again.num_registrations, again.num_revisions) == (0, 0, 0, 0)
            assert store.registrations.get(a, c).review == "confirm"
            box = np.array([[-5, -5, -5], [0, 0, 0]])
            assert len(store.scenes.gaussians(c, box)) == len(branch.scenes.gaussians(c, box)) > 0
        assert store.check().ok
    with gsmap.map.open(path) as m:
        report = m.purge("secret-garden", branches=True)
        assert report.maps == (str(path), f"{path}@b")
        assert m.check().ok
    assert not (path / "arrays" / "scenes" / gone).exists()
    engine = create_engine(postgres_database)
    with engine.connect() as connection:
        tables = connection.execute(text("SELECT tablename FROM pg_tables WHERE schemaname = 'public'")).scalars().all()
        rows = {t: str(connection.execute(text(f'SELECT * FROM "{t}"')).all()) for t in tables}
    engine.dispose()
    assert [t for t, text_of in rows.items() if "secret-garden" in text_of] == []
    assert [t for t, text_of in rows.items() if gone in text_of] == ["purges"]
