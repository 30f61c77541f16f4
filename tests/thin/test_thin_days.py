"""How many days `gsmap thin` may be told to keep."""

from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap.errors import ConfigError
from gsmap.types import Cameras, Gaussians, PoseGraph, ScenePose, Sim3


@pytest.mark.parametrize("days", [1e6, 1e12, float("inf"), float("nan"), -1])
def test_days_that_no_calendar_has_are_refused(tmp_path: Path, days: float) -> None:
    one = Gaussians(np.array([[0.0, 0, 2]]), np.eye(4)[:1], np.zeros((1, 3)), np.zeros(1), np.zeros((1, 1, 3)))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        cameras = Cameras(np.eye(4)[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))
        (row,) = m.ingest(one, cameras=cameras, name="a")
        m.store.revisions.save(PoseGraph({row.scene: ScenePose(row.scene, Sim3.identity(), 0, "placed")}, {}))
        with raises(ConfigError, code=("date_out_of_range", "out_of_range"), match="days"):
            m.thin(keep_days=days)
