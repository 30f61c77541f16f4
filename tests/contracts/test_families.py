"""Every method keeps its family's contract: the built-in ones, and those of a package outside gsmap."""

from __future__ import annotations

import importlib
import inspect
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import pytest
from raising import raises

from gsmap.describe import Params as DescribeParams
from gsmap.describe import describe
from gsmap.describe import recipe_key as describe_key
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.objects.views import render_views
from gsmap.errors import ConfigError
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.merge import PosedScene, merge, recipe_key
from gsmap.methods import MethodParams, families, family
from gsmap.register import Params as RegisterParams
from gsmap.register import SceneView, register_pair
from gsmap.settings.docs import field_docs
from gsmap.types import MergeResult, Sim3
from gsmap.types.registration import Proposal
from gsmap.types.views import Mask, SceneContext
from gsmap_synthetic import make_captures, make_place

OUTSIDE = Path(__file__).with_name("outside_package")
ADDED = {
    group.removeprefix("gsmap.").removesuffix("s"): sorted(points)
    for group, points in tomllib.loads((OUTSIDE / "pyproject.toml").read_text())["project"]["entry-points"].items()
}
BUILT_IN = {name: kind.names() for name, kind in families().items()}
METHODS = [(kind, name) for kind, names in BUILT_IN.items() for name in (*names, *ADDED.get(kind, []))]


def of(kind: str) -> list[str]:
    """All methods of a family, for those tests that run them."""
    return [name for k, name in METHODS if k == kind]


@pytest.fixture(scope="module", autouse=True)
def _outside_package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The package as an installer leaves it: its module, and what it says about itself."""
    site = tmp_path_factory.mktemp("site")
    project = tomllib.loads((OUTSIDE / "pyproject.toml").read_text())["project"]
    shutil.copy(OUTSIDE / "gsmap_outside.py", site)
    about = site / f"gsmap_outside-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in points.items()))
    ]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")
    sys.path.insert(0, str(site))
    importlib.invalidate_caches()
    yield
    sys.path.remove(str(site))
    importlib.invalidate_caches()


@dataclass(frozen=True)
class World:
    """Two captures of one flat in one frame, the second one's own frame and what is made of both."""

    scenes: tuple[PosedScene, PosedScene]
    target: SceneView
    source: SceneView
    S_target_source: Sim3


@pytest.fixture(scope="module")
def world() -> World:
    place = make_place(3, texel_m=0.1)
    made = make_captures(3, 2, steps=0, place=place, num_frames=14, num_gaussians=10_000, size_px=(120, 90))
    S = [Sim3.from_matrix(capture.T_scene_world) for capture in made]
    S_target_source = S[0] @ S[1].inverse()
    views = []
    for capture in made:
        graph = describe(capture.name, capture.gaussians, capture.cameras, DescribeParams(objects=False))
        views.append(SceneView(capture.name, capture.gaussians, capture.cameras, graph, "known"))
    moved = transform_gaussians(made[1].gaussians, S_target_source), transform_cameras(made[1].cameras, S_target_source)
    scenes = PosedScene(made[0].gaussians, made[0].cameras, "a"), PosedScene(*moved, "b")
    return World(scenes, *views, S_target_source)


# --- what all families ask for ----------------------------------------------------------------------------------------


def test_the_outside_package_is_found() -> None:
    for kind, names in ADDED.items():
        assert set(names) <= set(family(kind).names())
        assert not set(names) & set(BUILT_IN[kind])


@pytest.mark.parametrize(("kind", "name"), METHODS)
def test_params_and_version(kind: str, name: str) -> None:
    method = family(kind).get(name)
    assert isinstance(method.VERSION, int)
    assert method.VERSION >= 1
    if not family(kind).has_params:
        return
    assert is_dataclass(method.Params)
    params = method.Params()
    docs = field_docs(method.Params)
    assert [f.name for f in fields(params) if not docs.get(f.name)] == []
    assert set(get_type_hints(method.Params)) >= {f.name for f in fields(params)}
    hash(params)
    for field in fields(params)[:1]:
        with pytest.raises(FrozenInstanceError):
            setattr(params, field.name, None)


@pytest.mark.parametrize(("kind", "name"), METHODS)
def test_functions_take_what_the_contract_says(kind: str, name: str) -> None:
    method, written = family(kind).get(name), importlib.import_module(f"gsmap.methods.{kind}")
    contracts = [c for c in vars(written).values() if isinstance(c, type) and getattr(c, "_is_protocol", False)]
    for part in family(kind).contract:
        contract = next((c for c in contracts if callable(vars(c).get(part))), None)
        if contract is None:
            continue  # A constant, or a contract without a signature of its own.
        asked = [p for p in inspect.signature(vars(contract)[part]).parameters.values() if p.name != "self"]
        taken = list(inspect.signature(getattr(method, part)).parameters.values())
        assert [p.name for p in taken][: len(asked)] == [p.name for p in asked], part
        assert all(p.default is not p.empty for p in taken[len(asked) :]), part


def test_choosing_costs_no_heavy_library() -> None:
    """The settings tree holds the Params of every method: reading them must not load what the methods run on."""
    code = (
        "import sys\nfrom gsmap.methods import families\n"
        "for kind in families().values():\n"
        "    for name in kind.names():\n"
        "        kind.get(name)\n"
        "print(sorted({'torch', 'gtsam', 'open3d', 'onnxruntime', 'pycolmap', 'gsplat'} & set(sys.modules)))"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_a_name_that_is_not_there_is_answered_with_the_nearest() -> None:
    with raises(ConfigError, code="unknown_method"):
        family("merger").get("opake")


def test_a_method_that_breaks_the_contract_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import gsmap_outside

    kind = replace(family("merger"), name="broken", table=(("opaque", "gsmap_outside"),))
    with raises(ConfigError, code="invalid_method"):
        kind.get("opaque")
    assert gsmap_outside.Opaque.VERSION == 1


# --- mergers ----------------------------------------------------------------------------------------------------------


def _few_steps(method: Any) -> Any:
    return replace(method.Params(), **{method.STEPS: 4}) if method.STEPS else method.Params()


@pytest.mark.parametrize("name", of("merger"))
def test_merger(name: str, world: World) -> None:
    method = family("merger").get(name)
    params = _few_steps(method)
    assert method.reading_m(params, True) >= method.reading_m(params, False) >= method.reach_m(params) >= 0
    assert method.looking_m(params) >= 0
    assert isinstance(method.min_cameras(params), int)
    assert isinstance(method.uses_dates(params), bool)
    assert isinstance(method.RENDERS, bool)
    told: list[float] = []
    middle = np.median(world.scenes[0].gaussians.means, axis=0)
    bounds = np.stack([middle - 1.5, middle + 1.5])
    parts = [replace(s, centroid=s.whole_centroid) for s in world.scenes]
    result = method.merge(parts, params, bounds, None, lambda fraction, text: told.append(fraction))
    assert isinstance(result, MergeResult)
    assert result.origin.shape == (len(result.gaussians),)
    assert set(result.origin.tolist()) <= {0, 1}
    assert all(0 <= fraction <= 1 for fraction in told)
    whole = merge(world.scenes, name, params, bounds=bounds)
    turned = merge(world.scenes[::-1], name, params, bounds=bounds)
    assert len(whole.gaussians) > 0
    assert whole.gaussians.means.tobytes() == turned.gaussians.means.tobytes()
    assert whole.gaussians.sh.tobytes() == turned.gaussians.sh.tobytes()
    np.testing.assert_array_equal(whole.origin, 1 - turned.origin)
    assert ((whole.gaussians.means >= bounds[0]) & (whole.gaussians.means <= bounds[1])).all()


# --- refiners and proposers -------------------------------------------------------------------------------------------


def _surfaces(world: World) -> tuple[Any, Any]:
    return world.target.surface(), world.source.surface()


def _away(S: Sim3, world: World) -> Sim3:
    """The pose 4 cm and about 1 degree beside the truth, turned about the middle of what is moved."""
    centre = S.apply(world.source.centre[None])[0]
    turn = exp_so3(np.array([0.0, 0.012, 0.012]))
    return Sim3(turn @ S.rotation, turn @ (S.translation - centre) + centre + [0.03, -0.02, 0.02], S.scale)


@pytest.mark.parametrize("name", of("refiner"))
def test_refiner(name: str, world: World) -> None:
    method, (target, source) = family("refiner").get(name), _surfaces(world)
    start = _away(world.S_target_source, world)
    pose = method.refine(target, source, start, None)
    again = method.refine(target, source, start, method.Params())
    assert isinstance(pose, Sim3)
    assert pose.matrix().tobytes() == again.matrix().tobytes()
    assert pose.scale == start.scale
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-9)
    middle = world.source.centre[None]
    truth = world.S_target_source.apply(middle)
    before, after = (float(np.linalg.norm(S.apply(middle) - truth)) for S in (start, pose))
    assert after <= before + 1e-12
    far = Sim3(np.eye(3), np.full(3, 1e3))
    assert method.refine(target, source, far, None).matrix().tobytes() == far.matrix().tobytes()
    if method.SCALES:
        assert isinstance(method.refine(target, source, start, None, with_scale=True), Sim3)


@pytest.mark.parametrize("name", of("proposer"))
def test_proposer(name: str, world: World) -> None:
    method = family("proposer").get(name)
    for package in method.PACKAGES:
        pytest.importorskip(package)

    def scene(view: SceneView) -> Any:
        return SimpleNamespace(graph=view.graph, unit_m=1.0, surface=view.surface)

    found = method.propose(scene(world.target), scene(world.source), None)
    again = method.propose(scene(world.target), scene(world.source), method.Params())
    assert all(isinstance(proposal, Proposal) for proposal in found)
    assert len(found) == len(again)
    if not method.PACKAGES:  # What another package computes on its own threads may round as it likes.
        poses = [p.S_target_source.matrix().tobytes() for p in found]
        assert poses == [p.S_target_source.matrix().tobytes() for p in again]


# --- segmenters and embedders -----------------------------------------------------------------------------------------


def _context(world: World) -> SceneContext:
    view = world.target
    return SceneContext(surface_cloud(view.gaussians), len(view.gaussians), view.graph.up, 1.0)


@pytest.mark.parametrize("name", of("segmenter"))
def test_segmenter(name: str, world: World) -> None:
    method = family("segmenter").get(name)
    if method.MODELS:
        assert callable(method.probe)
        return
    segmenter = method.make(_context(world), method.Params())
    assert world.target.cameras is not None
    view = next(render_views(world.target.gaussians, world.target.cameras[:1], 120))
    for mask in segmenter.segment(view):
        assert mask.pixels.shape == view.rgb.shape[:2]
        assert mask.pixels.dtype == bool
        assert 0 <= mask.confidence <= 1


@pytest.mark.parametrize("name", of("embedder"))
def test_embedder(name: str, world: World) -> None:
    method = family("embedder").get(name)
    if method.MODELS:
        assert callable(method.probe)
        return
    context = _context(world)
    embedder, again = (method.make(context, method.Params()) for _ in range(2))
    assert world.target.cameras is not None
    view = next(render_views(world.target.gaussians, world.target.cameras[:1], 120))
    halves = np.zeros((2, *view.rgb.shape[:2]), bool)
    halves[0, :, :60], halves[1, :, 60:] = True, True
    points = [context.cloud.points[:50], context.cloud.points[50:150]]
    features = embedder.embed(view, [Mask(half, 1.0) for half in halves], points)
    assert features.shape[0] == 2
    assert features.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(
        again.embed(view, [Mask(half, 1.0) for half in halves], points), features, "the scene alone decides"
    )
    assert embedder.embed(view, [], []).shape == (0, features.shape[1])


# --- executors and formats --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", of("executor"))
def test_executor(name: str) -> None:
    method = family("executor").get(name)
    if name == "dask":
        with raises(ConfigError, code="missing_option", match="scheduler="):
            method.start(method.Params())  # with a cluster: tests/engine/test_engine_dask.py
        return
    workers = method.start(method.Params())
    try:
        assert dict(workers.run(divmod, [(7, 2), (9, 4)])) == {0: (3, 1), 1: (2, 1)}
        assert dict(workers.run(divmod, iter([(7, 2), (9, 4)]), quick=True)) == {0: (3, 1), 1: (2, 1)}
        with pytest.raises(ZeroDivisionError):
            list(workers.run(divmod, [(7, 0)]))
    finally:
        workers.close()


@pytest.mark.parametrize("name", of("format"))
def test_format(name: str) -> None:
    method = family("format").get(name)
    assert callable(getattr(method, "read", None)) or callable(getattr(method, "write", None))


# --- the package outside gsmap, end to end ----------------------------------------------------------------------------


def test_merges_with_an_added_merger(world: World) -> None:
    every = merge(world.scenes, "union")
    some = merge(world.scenes, "opaque", family("merger").get("opaque").Params(min_opacity=0.7))
    assert len(some.gaussians) == int((every.gaussians.opacities >= 0.7).sum())
    assert 0 < len(some.gaussians) <= len(every.gaussians)
    assert recipe_key("opaque").version["merger.opaque"] == 1
    assert recipe_key("opaque").recipe != recipe_key("union").recipe


def test_registers_with_an_added_refiner(world: World) -> None:
    refiners = MethodParams("refiner").with_params("nudge", family("refiner").get("nudge").Params(reach_m=0.05))
    params = RegisterParams(refiner="nudge", refiners=refiners)
    done = register_pair(world.target, world.source, params)
    usual = register_pair(world.target, world.source, RegisterParams())
    assert done.S_target_source is not None
    assert usual.S_target_source is not None
    assert done.S_target_source.matrix().tobytes() != usual.S_target_source.matrix().tobytes()
    middle = world.source.centre[None]
    apart = done.S_target_source.apply(middle) - world.S_target_source.apply(middle)
    assert np.linalg.norm(apart) < 0.1


def test_describes_with_an_added_embedder(world: World) -> None:
    defaults = DescribeParams(landmarks=False)
    params = replace(defaults, object=replace(defaults.object, embedder="mean_colour"))
    graph = describe("a", world.target.gaussians, world.target.cameras, params, scale_policy="known")
    objects = graph.layers["objects"]
    assert len(objects) > 3
    assert objects.embeddings.shape[1] == 3
    assert describe_key(params).version["embedder.mean_colour"] == 1
