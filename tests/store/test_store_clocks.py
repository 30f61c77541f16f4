"""Whatever a clock said, what was written last counts, and nothing is overlooked that is older by its date."""

from __future__ import annotations

import pytest
from store_samples import make_cameras, make_gaussians

from gsmap.map.stages.purge import purge
from gsmap.store import Store, merging
from gsmap.store.backup import save
from gsmap.store.storage import open_storage

AHEAD, BEHIND = "2190-01-01T00:00:00.000000+00:00", "1999-01-01T00:00:00.000000+00:00"


def at(patch: pytest.MonkeyPatch, when: str) -> None:
    """Set the clock by which the store dates rows."""
    for module in ("catalog", "facts", "scenes"):
        patch.setattr(f"gsmap.store.{module}.now", lambda: when)


@pytest.fixture
def site(tmp_path):
    with Store.create(tmp_path / "site.gsmap") as store:
        store.scenes.add(make_gaussians(), make_cameras(), name="hall")
        yield store


@pytest.mark.parametrize("clock", [AHEAD, BEHIND])
def test_a_scene_that_was_restored_last_is_not_removed_by_a_merge(site, tmp_path, clock):
    with pytest.MonkeyPatch.context() as patch:
        at(patch, clock)
        site.scenes.remove("hall")
    site.branches.make("before")
    site.scenes.restore("hall")
    with Store.open(f"{site.folder}@before", "r") as branch:
        merging.merge(site, branch)
    assert [scene.name for scene in site.scenes.list()] == ["hall"]


@pytest.mark.parametrize("clock", [AHEAD, BEHIND])
def test_a_scene_that_was_removed_last_is_removed_by_a_merge(site, clock):
    with pytest.MonkeyPatch.context() as patch:
        at(patch, clock)
        site.scenes.add(make_gaussians(seed=1), make_cameras(), name="attic")
    site.branches.make("after")
    with Store.open(f"{site.folder}@after", "w") as branch:
        branch.scenes.remove("attic")
        merging.merge(site, branch)
    assert [scene.name for scene in site.scenes.list()] == ["hall"]


@pytest.mark.parametrize(("scene_clock", "backup_clock"), [(AHEAD, None), (None, BEHIND), (AHEAD, BEHIND)])
def test_a_purge_names_every_backup_that_holds_the_scene(site, tmp_path, scene_clock, backup_clock):
    with pytest.MonkeyPatch.context() as patch:
        if scene_clock:
            at(patch, scene_clock)
        site.scenes.add(make_gaussians(seed=1), make_cameras(), name="attic")
    with pytest.MonkeyPatch.context() as patch:
        if backup_clock:
            at(patch, backup_clock)
        name = save(site, open_storage(str(tmp_path / "kept"))).snapshot.snapshot
    ((_, done),) = purge(site, "attic")
    assert [text.split()[-1] for text in done.receipt["backups"]] == [name]


def test_the_time_at_which_a_map_was_written_is_that_of_its_newest_row(site, tmp_path):
    with Store.create(tmp_path / "empty.gsmap") as empty:
        assert empty.time_written() is None
    with pytest.MonkeyPatch.context() as patch:
        at(patch, AHEAD)
        site.scenes.remove("hall")
    assert site.time_written() == AHEAD
