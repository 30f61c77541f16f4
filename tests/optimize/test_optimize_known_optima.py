import numpy as np
import pytest

from gsmap.geometry.similarities import Similarities
from gsmap.optimize import Params, optimize
from gsmap.optimize.robust import chi_squares
from tools.pose_graph_files import read_g2o

OPTIMA = {"smallGrid3D": 517.925, "parking-garage": 0.634192, "sphere2500": 675.701, "torus3D": 12117.64}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in ("torus3D", "sphere2500") else n for n in OPTIMA]
)
def test_known_optimum(shared_data, name):
    from gsmap.optimize.measurements import measurements

    graph = read_g2o(shared_data / "pose_graphs" / f"{name}.g2o")
    answer = optimize(list(graph.poses), graph.edges, params=Params(marginals=False))
    poses = Similarities.stack([p.S_map_scene for p in answer.poses.values()])
    cost = chi_squares(measurements(list(graph.poses), graph.edges), poses).sum() / 2
    assert cost == pytest.approx(OPTIMA[name], rel=1e-3)


def test_grid_without_triangles_is_found_by_longer_cycles(shared_data):
    """Nobody vouches for the edges, and a grid has no triangles: cycles of four must do."""
    graph = read_g2o(shared_data / "pose_graphs" / "smallGrid3D.g2o", confirmed=False)
    answer = optimize(list(graph.poses), graph.edges, params=Params(marginals=False))
    assert np.mean([outcome.use == "used" for outcome in answer.outcomes.values()]) > 0.98
