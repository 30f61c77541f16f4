"""What Python users expect of types: short representations, data frames, tensors, errors that name arguments."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError, GsmapError, InputError, on_command_line, with_arguments
from gsmap.types import Cameras, Gaussians, PoseGraph, Scene, ScenePose, Sim3
from gsmap.types.rows.base import Row, Table


@dataclass(frozen=True, eq=False)
class Thing(Row):
    columns: ClassVar = {"label": "label", "weight": "kg"}
    id: str
    weight: float | None
    matrix: np.ndarray

    @property
    def label(self) -> str:
        return f"thing {self.id[:2]}"


def things(count: int) -> Table[Thing]:
    return Table(Thing(f"{i:02d}" * 16, i / 3, np.full((4, 4), i)) for i in range(count))


def test_rows_are_one_short_line_of_what_tables_show() -> None:
    (one,) = things(1)
    assert repr(one) == "Thing(label='thing 00', weight=0)"
    assert repr(things(2)).splitlines() == [
        "[Thing(label='thing 00', weight=0),",
        " Thing(label='thing 01', weight=0.3333)]",
    ]
    many = repr(things(100))
    assert "80 more" in many
    assert len(many) < 1500
    assert repr(Table()) == "[]"


def test_a_table_is_a_data_frame() -> None:
    pytest.importorskip("pandas")
    frame = things(3).to_pandas()
    assert list(frame.columns) == ["label", "weight", "id", "matrix"]
    assert frame["weight"].tolist() == [0, 1 / 3, 2 / 3]
    assert frame["matrix"][2].shape == (4, 4)
    assert frame["weight"].dtype == np.float64
    assert Table().to_pandas().empty


def test_scenes_and_poses_are_short() -> None:
    scene = Scene("ab" * 16, "hall", 1000, 1, 20, np.array([[0.0, 0, 0], [4, 3, 2]]))
    assert repr(scene) == "Scene('hall', id='abababababab', 1000 Gaussians, 20 cameras, extent=4 x 3 x 2)"
    pose = ScenePose(scene.id, Sim3(np.eye(3), [1, 2, 3]), 0, "placed", np.eye(7))
    assert len(repr(pose)) < 130
    assert "1 components" in repr(PoseGraph({scene.id: pose}))


def some_gaussians(n: int = 5) -> Gaussians:
    rng = np.random.default_rng(0)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 4, 3)]
    return Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def test_gaussians_and_cameras_are_arguments_of_gsplat() -> None:
    """By the definitions: standard deviations, opacities in [0, 1], and a view matrix that takes the centre to zero."""
    torch = pytest.importorskip("torch")
    g = some_gaussians()
    drawn = g.to_gsplat()
    assert drawn.pop("sh_degree") == 1
    assert {name: tuple(value.shape) for name, value in drawn.items()} == {
        "means": (5, 3),
        "quats": (5, 4),
        "scales": (5, 3),
        "opacities": (5,),
        "colors": (5, 4, 3),
    }
    assert {value.dtype for value in drawn.values()} == {torch.float32}
    np.testing.assert_allclose(drawn["scales"].log().numpy(), g.log_scales, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(torch.logit(drawn["opacities"]).numpy(), g.logit_opacities, rtol=1e-4, atol=1e-5)
    drawn["means"][0] = 7  # a copy
    assert g.means[0, 0] != 7
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    cameras = Cameras(pose[None], np.array([[100.0, 110, 32, 24]]), np.array([[64, 48]]))
    seen = cameras.to_gsplat()
    np.testing.assert_allclose(seen["viewmats"][0].numpy() @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(seen["Ks"][0].numpy(), [[100, 0, 32], [0, 110, 24], [0, 0, 1]])
    assert (seen["width"], seen["height"]) == (64, 48)
    two = Cameras(np.stack([pose, pose]), np.tile([100.0, 100, 32, 24], (2, 1)), np.array([[64, 48], [32, 24]]))
    with raises(InputError, code="shape_mismatch"):
        two.to_gsplat()


def test_errors_name_arguments_in_python_and_options_on_the_command_line() -> None:
    error = ConfigError("--pictures draws changes: add --changes", code="missing_option")
    assert str(error) == "pictures= draws changes: add changes="
    with on_command_line():
        assert str(error) == "--pictures draws changes: add --changes"
        assert f"{error}" == "--pictures draws changes: add --changes"
    assert isinstance(error, GsmapError)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("set it with gsmap edit MAP SCENE --captured-at DATE", None),  # a command to type stays
        (
            "no date (gsmap edit M S --captured-at D); give --captured-at",
            "no date (gsmap edit M S --captured-at D); give captured_at=",
        ),
        ("gsmap why M A:B --pictures DIR", None),
        ("leave --tile-size out", "leave tile_size_m= out"),
        ("export it (--set localize.extractor=sift)", "export it (with_settings({'localize.extractor': 'sift'}))"),
        ("a range 3--5 and -- nothing", None),
    ],
)
def test_only_options_are_renamed(text: str, expected: str | None) -> None:
    assert with_arguments(text) == (text if expected is None else expected)
