"""Thin stage: store superseded scenes in compact form, oldest first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

from gsmap.compare import CaptureViews
from gsmap.errors import ConfigError, NotFoundError, StoreError
from gsmap.geometry.metric_scale import in_metres
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map.metric_scales import metres_of_scenes
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import note_interruption
from gsmap.methods import RecipeKey
from gsmap.reason_codes import reason, reason_code
from gsmap.store import Store, compact
from gsmap.store.sizes import graph_sizes, scene_sizes
from gsmap.thin import find_visible, measure_fidelity_db, observed_fraction, render_views
from gsmap.types import PosedScene, PoseGraph, Scene, SceneGraph
from gsmap.types.progress import StageProgress
from gsmap.types.rows.thinning import ThinReport, ThinRow

_TOLERANCE = timedelta(days=1)  # of clocks and time zones of other computers


@dataclass(frozen=True)
class Request:
    """The options of a thinning.

    Args:
        keep_days: scenes captured in this many days before ``now`` stay whole; None for no limit by age.
        budget_bytes: thin only until the arrays of living scenes fit; None thins all that may be.
        dry_run: change nothing.
        now: ISO 8601; None for the time at which the map was last written, or the clock's if that is earlier.
    """

    keep_days: float | None = None
    budget_bytes: int | None = None
    dry_run: bool = False
    now: str | None = None


def thin(store: Store, request: Request, settings: Settings, progress: StageProgress) -> ThinReport:
    """Thin superseded scenes, the oldest first, and reclaim the space.

    A placed capture is superseded where newer ones, also placed, dated and kept whole, looked at nearly all of its
    surface: they stand for it when a new capture is registered or a picture localised. Poses, registrations and words
    stay.

    Raises:
        ConfigError: neither days nor a budget, or negative ones; the clock contradicts what is stored.
        NotFoundError: the map has no poses.
        StoreError: another process changed the poses or a capture that stays; captures thinned before stay thinned.
    """
    if request.keep_days is None and request.budget_bytes is None:
        raise ConfigError("pass --keep-days DAYS, --budget SIZE, or both", code="nothing_requested")
    if not (request.keep_days or 0) >= 0 or (request.budget_bytes or 0) < 0:
        raise ConfigError("days and sizes must not be negative", code="out_of_range")
    with store.catalog.read():
        revision, graph = store.revisions.newest_number(), store.revisions.get()
        living = {scene.id: scene for scene in store.scenes.list()}
    if graph is None:
        raise NotFoundError("the map has no poses yet: run gsmap update first", code="no_poses")
    dated = sorted((s for s in living.values() if s.captured_at is not None), key=_when)
    try:
        now = _present(store, dated) if request.now is None else _moment(request.now)
        before = now - timedelta(days=float(request.keep_days or 0))
    except OverflowError as error:
        raise ConfigError(
            f"no date lies {request.keep_days:g} days before today: pass fewer days", code="date_out_of_range"
        ) from error
    # Thinning cannot be undone, so a pose that nothing confirms is not enough.
    sure = {scene for scene, pose in graph.poses.items() if pose.status == "placed"}
    known = [scene for scene in dated if scene.id in (sure if scene.thinning is None else graph.poses)]
    doubtful = [s for s in dated if s.thinning is None and s.id not in sure and _when(s) < before]
    of_scenes, of_graphs = scene_sizes(store), graph_sizes(store)
    sizes = {scene: of_scenes.get(scene, 0) + of_graphs.get(scene, 0) for scene in living}
    ups = {graph.scene: graph.up for graph in store.graphs.list()}  # of the newest graph
    shares, stay = _superseded(store, known, before, graph, settings, progress)
    why = reason("pose_unconfirmed", "its pose is not confirmed: gsmap list MAP scenes shows its status")
    rows = [_row(scene, sizes[scene.id], sizes[scene.id], 0.0, why) for scene in doubtful]
    with note_interruption(lambda: f"{sum(row.thinned for row in rows)} captures are thinned"):
        for done, scene in enumerate(scene for scene in known if scene.id in shares):
            if request.budget_bytes is not None and sum(sizes.values()) <= request.budget_bytes:
                break
            progress("thin", 0.5 + 0.5 * done / len(shares), scene.name)
            share = shares[scene.id]
            if share < settings.thin.min_seen_again:
                why = reason("seen_too_little", f"newer captures that stay whole saw {share:.0%} of it")
                rows.append(_row(scene, sizes[scene.id], sizes[scene.id], share, why))
                continue
            own = PosedScene(store.scenes.gaussians(scene.id), store.scenes.cameras(scene.id), scene.id)
            stays = find_visible(own, settings.thin)
            kept = compact.round_trip(own.gaussians[stays])
            fidelity = measure_fidelity_db(own, kept, settings.thin)
            if fidelity < settings.thin.min_fidelity_db:
                why = reason("fidelity_too_low", f"compact, its pictures would keep {fidelity:.1f} dB")
                rows.append(_row(scene, sizes[scene.id], sizes[scene.id], share, why, fidelity))
                continue
            after = compact.num_bytes(own.gaussians[stays])
            if not request.dry_run:
                described = store.graphs.load(scene.id)
                with store.transaction():
                    _require_unchanged(store, revision, [scene, *stay])
                    store.scenes.thin(scene.id, stays, up=ups.get(scene.id))
                    _keep_things(store, described)
                after = _num_bytes(store, scene.id)
            rows.append(_row(scene, sizes[scene.id], after, share, "", fidelity))
            sizes[scene.id] = after
    freed = 0 if request.dry_run else store.reclaim().num_bytes
    progress("thin", 1.0, f"{sum(row.thinned for row in rows)} thinned")
    return ThinReport(
        dry_run=request.dry_run,
        scenes=tuple(sorted(rows, key=lambda row: _moment(row.captured_at))),
        num_undated=len(living) - len(dated),
        num_bytes=sum(sizes.values()),
        num_bytes_freed=freed,
        fits=request.budget_bytes is None or sum(sizes.values()) <= request.budget_bytes,
    )


def _present(store: Store, dated: Sequence[Scene]) -> datetime:
    """Return the time from which days are counted.

    Thinning cannot be undone, and a clock may be wrong. While it is ahead, no capture is older than it was when the map
    was last written; behind what is stored, nobody knows how old captures are.

    Args:
        dated: scenes with a date, oldest first.
    """
    now, written = datetime.now(UTC), store.time_written()
    latest = now + _TOLERANCE
    advice = f"and this computer's clock says {now:%Y-%m-%d}: correct the clock, or say which day it is (--now DATE)"
    if written is not None and _moment(written) > latest:
        raise ConfigError(f"the map was last written at {written}, {advice}", code="clock_contradicts_map")
    if dated and _when(dated[-1]) > latest:
        raise ConfigError(
            f"scene {dated[-1].name} is dated {dated[-1].captured_at}, {advice}, or correct the date (gsmap edit)",
            code="clock_contradicts_map",
        )
    return now if written is None else min(now, _moment(written))


THINGS = RecipeKey("thin", "things", {"things": 1})
"""Recipe of the graph of a thinned capture, which keeps the segments of the whole capture but no node layers."""


def _keep_things(store: Store, graph: SceneGraph | None) -> None:
    """Keep the segments of a thinned scene without its node layers."""
    if graph is None or graph.segments is None:
        return
    store.graphs.save(replace(graph, layers={}), THINGS.of(graph.scene_id))


def _require_unchanged(store: Store, revision: int | None, decided: Sequence[Scene]) -> None:
    """Raise `StoreError` inside a transaction if another process has changed what a thinning was decided on.

    Args:
        revision: number of the newest revision when it was decided.
        decided: the scene to thin and the scenes that stay whole, as they were then.
    """
    now = {scene.id: scene for scene in store.scenes.list()}
    changed = [
        scene.name
        for scene in decided
        if (found := now.get(scene.id)) is None or found.thinning is not None or found.captured_at != scene.captured_at
    ]
    if changed:
        what = f"removed, thinned or edited {', '.join(changed[:3])}"
    elif store.revisions.newest_number() != revision:
        what = "changed the poses"
    else:
        return
    raise StoreError(f"another process {what} meanwhile: run the same command again", code="changed_meanwhile")


def _superseded(
    store: Store,
    known: Sequence[Scene],
    before: datetime,
    graph: PoseGraph,
    settings: Settings,
    progress: StageProgress,
) -> tuple[dict[str, float], list[Scene]]:
    """Return the fraction of each old scene's surface that newer, whole scenes observed, by scene id.

    Also return the scenes that stay whole.

    Decided from the newest back, so that no capture is superseded by one that is thinned itself. What was thinned
    before needs others to stand for it still: where those that stay do not, further ones must.

    Args:
        known: scenes with a date and a pose, oldest first.
        before: scenes captured earlier are old.
    """
    bar = settings.thin.min_seen_again
    metres = metres_of_scenes(store, graph)
    looks: dict[str, CaptureViews] = {}
    stay: list[Scene] = []
    shares: dict[str, float] = {}

    def placed(scene: Scene) -> PosedScene:
        S = in_metres(graph.poses[scene.id].S_map_scene, metres[scene.id])
        gaussians = transform_gaussians(store.scenes.gaussians(scene.id), S)
        return PosedScene(gaussians, transform_cameras(store.scenes.cameras(scene.id), S), scene.id)

    def share(scene: Scene) -> float:
        component = graph.poses[scene.id].component
        newer = [
            other for other in stay if graph.poses[other.id].component == component and _when(other) > _when(scene)
        ]
        for other in newer:
            if other.id not in looks:
                looks[other.id] = render_views(placed(other))
        return observed_fraction(placed(scene), [looks[other.id] for other in newer]) if newer else 0.0

    for done, scene in enumerate(reversed(known)):
        progress("thin", 0.5 * done / len(known), f"looking at {scene.name}")
        if scene.thinning is not None:
            spare = [other for other in reversed(known) if shares.get(other.id, 0.0) >= bar]
            while spare and share(scene) < bar:
                stay.append(spare.pop(0))
                shares[stay[-1].id] = 0.0
        elif _when(scene) >= before:
            stay.append(scene)
        else:
            shares[scene.id] = share(scene)
            if shares[scene.id] < bar:
                stay.append(scene)
    return shares, stay


def _row(scene: Scene, before: int, after: int, seen: float, why: str, fidelity: float | None = None) -> ThinRow:
    return ThinRow(
        scene=scene.id,
        scene_name=scene.name,
        captured_at=scene.captured_at or "",
        thinned=not why,
        num_bytes_before=before,
        num_bytes_after=after,
        seen_again=seen,
        fidelity_db=fidelity,
        reason=why,
        reason_code=reason_code(why),
    )


def _num_bytes(store: Store, scene: str) -> int:
    """Return the size of a scene's arrays and graphs in bytes."""
    return store.scenes.num_bytes(scene) + store.graphs.num_bytes(scene)


def _when(scene: Scene) -> datetime:
    return _moment(scene.captured_at or "")


def _moment(text: str) -> datetime:
    """Parse an ISO 8601 time; UTC if it has no zone."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(
            f"a time must be in ISO 8601, such as 2026-05-31T14:00:00+02:00, got {text!r}", code="invalid_date"
        ) from error
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
