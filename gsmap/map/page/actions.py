"""Run the actions that a person starts from the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import numpy as np

from gsmap.errors import InputError
from gsmap.store import Store
from gsmap.types import PoseGraph, Prior, Sim3
from gsmap.types.metric_scale import MetricScale
from gsmap.view.page_source import Action

_MAX_NOTE = 2_000


class EditableMap(Protocol):
    """The part of `gsmap.map.Map` that actions use."""

    @property
    def store(self) -> Store: ...
    def confirm(self, what: str, note: str = "", *, withdraw: bool = False) -> object: ...
    def reject(self, what: str, note: str = "") -> object: ...
    def set_prior(self, prior: Prior) -> object: ...
    def remove_prior(self, scene: str) -> None: ...
    def optimize(self) -> object: ...
    def changes(self) -> object: ...
    def edit(self, ref: str, *, captured_at: str | None = None) -> object: ...
    def edit_object(self, ref: str, *, name: str | None = None) -> object: ...
    def metres(self) -> Mapping[int, MetricScale]: ...
    def pose_graph(self) -> PoseGraph | None: ...


def actions_of(opened: EditableMap) -> dict[str, Action]:
    """Return the actions by their names in `gsmap.view.contract.Actions`."""
    return {
        "confirm": partial(_review, opened.confirm),
        "reject": partial(_review, opened.reject),
        "withdraw": partial(_review, partial(opened.confirm, withdraw=True)),
        "prior": partial(_prior, opened),
        "earlier_prior": partial(_earlier_prior, opened),
        "remove_prior": lambda said: opened.remove_prior(_text(said, "scene")),
        "name_object": partial(_name_object, opened),
        "date": lambda said: (opened.edit(_text(said, "scene"), captured_at=_text(said, "captured_at")), None)[1],
        "compare": lambda said: (opened.changes(), None)[1],
        "optimize": lambda said: (opened.optimize(), None)[1],
    }


def _review(review: Callable[[str, str], object], said: Mapping[str, Any]) -> None:
    note = _text(said, "note", may_be_empty=True)
    if len(note) > _MAX_NOTE:
        raise InputError(f"a note may have at most {_MAX_NOTE} characters", code="invalid_request")
    review(_text(said, "what"), note)


def _prior(opened: EditableMap, said: Mapping[str, Any]) -> None:
    """Set the pose of a scene as a prior; its scale stays free."""
    scene = opened.store.scenes.get(_text(said, "scene"))
    sigma_m, sigma_deg = (_positive(said, name) for name in ("sigma_m", "sigma_deg"))
    try:
        matrix = np.array(said.get("S_map_scene"), np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"S_map_scene must be a matrix of four rows of four numbers: {error}", code="invalid_pose"
        ) from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError("S_map_scene must be a matrix of four rows of four finite numbers", code="invalid_pose")
    S = Sim3.from_matrix(matrix)
    graph = opened.pose_graph()
    pose = None if graph is None else graph.poses.get(scene.id)
    metres = opened.metres().get(pose.component) if pose is not None else None
    metres_per_unit = 1.0 if metres is None else metres.metres_per_unit
    # The residual of a position is in the scene's unit (`gsmap.types.Prior`).
    sigma = sigma_m / (metres_per_unit * S.scale)
    opened.set_prior(Prior(scene.id, S, np.array([math.radians(sigma_deg)] * 3 + [sigma] * 3 + [math.inf])))


def _earlier_prior(opened: EditableMap, said: Mapping[str, Any]) -> None:
    scene, number = _text(said, "scene"), said.get("number")
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < 1 << 63:
        raise InputError("the number of a revision must be an integer", code="invalid_request")
    opened.set_prior(opened.store.priors.earlier(scene, number))


def _name_object(opened: EditableMap, said: Mapping[str, Any]) -> None:
    """Name an object; an empty name takes the last one back."""
    opened.edit_object(_text(said, "object"), name=_text(said, "name", may_be_empty=True).strip() or "none")


def _text(said: Mapping[str, Any], name: str, *, may_be_empty: bool = False) -> str:
    value = said.get(name, "" if may_be_empty else None)
    if not isinstance(value, str) or not (value or may_be_empty):
        raise InputError(f"{name} must be a text", code="invalid_request")
    return value


def _positive(said: Mapping[str, Any], name: str) -> float:
    value = said.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (0 < value < math.inf):
        raise InputError(f"{name} must be a positive number", code="invalid_request")
    return float(value)
