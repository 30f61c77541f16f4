"""The catalog's tables. A change here needs a migration in ``migrations/versions`` and a new `HEAD`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sqlalchemy import (
    REAL,
    BigInteger,
    CheckConstraint,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    Table,
    Text,
    text,
)
from sqlalchemy.types import TypeEngine

from gsmap.store.column_types import (
    ArrayKindText,
    DigestText,
    EnumText,
    JsonText,
    KeyText,
    LineText,
    MultilineText,
    PackedNumbers,
    PairText,
    RelativePathText,
    SceneListText,
    is_box,
    is_candidate_list,
    is_direction,
    is_number_dict,
    is_object,
    is_pose,
    is_poses_by_scene,
    is_sigmas,
    is_text_list,
    is_thinning,
    is_world_ties,
)
from gsmap.store.matrices import (
    covariance_bytes,
    covariance_of_bytes,
    matrix_bytes,
    matrix_of_bytes,
    pose_bytes,
    pose_of_bytes,
)
from gsmap.types.change import CHANGE_KINDS, SYMMETRIES
from gsmap.types.map_object import OBJECT_FACTS
from gsmap.types.scene import SCENE_FACTS
from gsmap.types.world import OBSERVATION_KINDS

HEAD = "0014"  # the newest migration; numbered, so that versions can be compared without alembic
FIRST = "0014"  # the schema of the first release; older ones are of development versions and cannot be migrated

REVISION_COUNTS = (
    "num_scenes",
    "num_placed",
    "num_components",
    "num_used",
    "num_tentative",
    "num_unused",
    "num_undecided",
)
"""Columns with counts that are stored with each revision, so that listing revisions reads no poses."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

Bytes = BigInteger().with_variant(Integer(), "sqlite")
Real: TypeEngine[float] = Double().with_variant(
    REAL(), "sqlite"
)  # STRICT tables know REAL; elsewhere REAL would be single precision


def _table(name: str, *parts: Any) -> Table:
    for part in parts:
        if isinstance(part, Column) and hasattr(part.type, "for_column"):
            part.type = part.type.for_column(f"{name}.{part.name}")  # for messages
    return Table(name, metadata, *parts, sqlite_strict=True)


def _scene(name: str, **options: Any) -> Column[str]:
    return Column(name, DigestText, ForeignKey("scenes.id"), nullable=False, **options)


def _recipe() -> Column[str]:
    """Return the column of a recipe, which is null in rows of manual measurements."""
    return Column("recipe", DigestText, ForeignKey("recipes.digest"))


def result_columns(is_valid: Callable[[Any], bool]) -> list[Column[Any]]:
    """Return the columns of results whose metadata meets a condition."""
    return [
        Column("number", Integer, primary_key=True),
        Column("kind", ArrayKindText, nullable=False),  # also of its array group
        Column("key", KeyText, nullable=False),  # RecipeKey.digest
        _recipe(),
        # The scene of a result of one scene, or the ids of several scenes.
        Column("scene", DigestText, ForeignKey("scenes.id"), index=True),
        Column("scenes", SceneListText),
        Column("num_items", Integer, nullable=False),  # nodes, features, cells, objects
        Column("about", JsonText(is_valid), nullable=False),
        Column("group_id", DigestText, ForeignKey("groups.id")),  # null without arrays
        Column("created_at", Text, nullable=False),
    ]


about = _table(
    "about",
    Column("id", DigestText, primary_key=True),  # of the map, random
    Column("created_at", Text, nullable=False),
    Column("gsmap_version", Text, nullable=False),
)

# An immutable folder of arrays, and the digest of each of its files.
groups = _table(
    "groups",
    Column("id", DigestText, primary_key=True),  # digest of the content
    Column("kind", ArrayKindText, nullable=False),
    Column("created_at", Text, nullable=False),
)
files = _table(
    "files",
    Column("group_id", DigestText, ForeignKey("groups.id"), primary_key=True),
    Column("path", RelativePathText, primary_key=True),  # relative to the group
    Column("size_bytes", Bytes, nullable=False),
    Column("sha256", DigestText, nullable=False),
)

scenes = _table(
    "scenes",
    Column("number", Integer, primary_key=True),
    Column("id", DigestText, nullable=False, unique=True),  # digest of Gaussians and cameras
    Column("name", LineText, nullable=False),
    Column("num_gaussians", Integer, nullable=False),
    Column("sh_degree", Integer, nullable=False),
    Column("num_cameras", Integer, nullable=False),
    Column("bounds", JsonText(is_box), nullable=False),
    Column("scale_policy", Text, nullable=False),
    Column("captured_at", Text),
    Column("ingested_at", Text, nullable=False),
    Column("source", Text, nullable=False),
    Column("cameras_synthesised", Integer, nullable=False),
    Column("antialiased", Integer, nullable=False),
    Column("notes", JsonText(is_text_list), nullable=False),
    Column("group_id", DigestText, ForeignKey("groups.id")),  # null once pruned
    Column("removed_at", Text),  # the tombstone
    Column("thinned", JsonText(is_thinning)),  # of a scene that is kept compact (`gsmap.store.compact`)
    Column("origin", JsonText(is_direction)),  # of its frame in the coordinates of its file; null for zero
    CheckConstraint("scale_policy in ('auto', 'known', 'unknown')", name="scale_policy"),
)
Index(
    "uq_scenes_living_name",
    scenes.c.name,
    unique=True,
    sqlite_where=text("removed_at IS NULL"),  # on PostgreSQL too (migrations); naming it here would load that dialect
)

# Facts about a scene since its ingest, never overwritten. `scenes` holds the newest value of `FACT_COLUMNS`.
scene_facts = _table(
    "scene_facts",
    Column("number", Integer, primary_key=True),
    _scene("scene", index=True),
    Column("kind", Text, nullable=False),
    Column("value", MultilineText, nullable=False),  # empty: a withdrawn date or scale
    Column("author", LineText, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint(f"kind in {SCENE_FACTS}", name="kind"),
)
FACT_COLUMNS = tuple(kind for kind in SCENE_FACTS if kind in scenes.c)

# `chunk_boxes` is an R*Tree on SQLite and a plain table elsewhere, so the migration makes it:
# id, s0 = s1 = scene number, x0 x1 y0 y1 z0 z1, chunk.
CHUNK_BOXES = "chunk_boxes"

# Recipes of results: a `gsmap.methods.RecipeKey` without its inputs, stored once for all results that share it.
recipes = _table(
    "recipes",
    Column("digest", DigestText, primary_key=True),  # RecipeKey.recipe
    Column("stage", Text, nullable=False),
    Column("method", Text, nullable=False),
    Column("version", JsonText(is_object), nullable=False),
    Column("settings", JsonText(is_object), nullable=False),
    Column("backend", Text, nullable=False),
    Column("created_at", Text, nullable=False),
)

# Results that are computed from scenes, by kind, and recomputed if lost (`gsmap.store.results`): scene graphs, view
# features, prepared scenes, segments of indexes, objects of components.
results = _table("results", *result_columns(is_object))
Index("ix_results_kind_key", results.c.kind, results.c.key)

registrations = _table(
    "registrations",
    Column("number", Integer, primary_key=True),
    _scene("target", index=True),
    _scene("source", index=True),
    Column("pair", PairText, nullable=False, index=True),  # both ids, sorted: the pair in either direction
    Column("key", KeyText, nullable=False, index=True),  # RecipeKey.digest; empty for a manual measurement
    _recipe(),
    Column("adopts", Integer, ForeignKey("registrations.number")),  # the earlier row that this one makes current again
    Column("status", Text, nullable=False),
    Column("reason", Text, nullable=False),
    Column("S_target_source", PackedNumbers(pose_bytes, pose_of_bytes)),
    Column("information", PackedNumbers(matrix_bytes, matrix_of_bytes)),
    Column("num_inliers", Integer, nullable=False),
    Column("num_correspondences", Integer, nullable=False),
    Column("overlap", Real, nullable=False),
    Column("proposer", Text, nullable=False),
    Column("exact", Integer, nullable=False),
    Column("seconds", JsonText(is_object), nullable=False),
    Column("evidence", JsonText(is_object), nullable=False),
    Column("notes", JsonText(is_text_list), nullable=False, server_default="[]"),
    Column("created_at", Text, nullable=False),
    CheckConstraint("status in ('accepted', 'rejected', 'no_match')", name="status"),
)
reviews = _table(
    "reviews",
    Column("number", Integer, primary_key=True),
    Column("pair", PairText, nullable=False, index=True),
    Column("review", Text, nullable=False),
    Column("registration", Integer, ForeignKey("registrations.number"), nullable=False),
    Column("note", MultilineText, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name="review"),
)

# Candidates that the index of graphs found for each scene; recomputed if lost.
lookups = _table(
    "lookups",
    _scene("scene", primary_key=True),
    Column("key", KeyText, nullable=False),  # RecipeKey.digest of the query recipe and the scene's graph
    Column("candidates", JsonText(is_candidate_list), nullable=False),  # best first; each: scene, score, votes
    Column("num_left", Integer),  # of these, candidates left when there were enough edges; null before the first run
    Column("created_at", Text, nullable=False),
)

# Comparisons of two scenes, never overwritten; the newest one of a pair is current.
comparisons = _table(
    "comparisons",
    Column("number", Integer, primary_key=True),
    _scene("older"),
    _scene("newer"),
    Column("pair", PairText, nullable=False, index=True),  # both ids, sorted
    Column("key", KeyText, nullable=False, index=True),  # RecipeKey.digest
    _recipe(),
    Column("S_newer_older", JsonText(is_pose), nullable=False),  # relative pose used for it
    # Takes the newer scene to the frame of boxes and voxels.
    Column("S_frame_newer", JsonText(is_pose), nullable=False),
    Column("seen_share", Real, nullable=False),
    Column("gains", JsonText(is_direction), nullable=False),
    Column("notes", JsonText(is_text_list), nullable=False),
    Column("group_id", DigestText, ForeignKey("groups.id")),  # null if nothing changed, and once pruned
    Column("created_at", Text, nullable=False),
)
changes = _table(
    "changes",
    Column("number", Integer, primary_key=True),
    Column("comparison", Integer, ForeignKey("comparisons.number"), nullable=False, index=True),
    Column("place", Integer, nullable=False),  # in its comparison, from 0, surest first
    Column("same_as", Integer, ForeignKey("changes.number")),  # the first row of the same change, or null
    Column("kind", EnumText(CHANGE_KINDS), nullable=False),
    Column("box", JsonText(is_box), nullable=False),
    Column("S_after_before", JsonText(is_pose)),
    Column("symmetry", EnumText(SYMMETRIES), nullable=False),
    Column("confidence", Real, nullable=False),
    Column("evidence", JsonText(is_number_dict), nullable=False),
    Column("num_voxels", Integer, nullable=False),  # its share of each array of its comparison
    Column("num_before", Integer, nullable=False),
    Column("num_after", Integer, nullable=False),
    CheckConstraint("kind in ('appeared', 'disappeared', 'moved', 'recoloured', 'replaced', 'lighting')", name="kind"),
    CheckConstraint("symmetry in ('none', 'half', 'any')", name="symmetry"),
)
change_reviews = _table(
    "change_reviews",
    Column("number", Integer, primary_key=True),
    Column("change", Integer, ForeignKey("changes.number"), nullable=False, index=True),  # its first row
    Column("review", Text, nullable=False),
    Column("note", MultilineText, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name="review"),
)

revisions = _table(
    "revisions",
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("key", KeyText, nullable=False, server_default=""),  # RecipeKey.digest
    _recipe(),
    Column("settings", JsonText(is_object), nullable=False, server_default="{}"),
    Column("provenance", JsonText(is_object), nullable=False, server_default="{}"),
    Column("notes", JsonText(is_text_list), nullable=False, server_default="[]"),
    Column("world", JsonText(is_world_ties), nullable=False, server_default="[]"),  # world ties of its components
    Column("note", MultilineText, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("dropped_at", Text),  # when prune dropped it
    Column("origin", JsonText(is_object)),  # {"map": id, "number": n} of a revision solved by another map
    *(Column(name, Integer, nullable=False, server_default="0") for name in REVISION_COUNTS),
)
# Poses and edge outcomes: a row is valid from the revision `since` to the one before `until`, or up to the newest if
# that is null. A revision adds the rows that differ from the previous one.
poses = _table(
    "poses",
    _scene("scene", primary_key=True),
    Column("since", Integer, ForeignKey("revisions.number"), primary_key=True),
    Column("until", Integer, ForeignKey("revisions.number"), index=True),
    Column("S_map_scene", PackedNumbers(pose_bytes, pose_of_bytes)),
    Column("component", Integer, nullable=False),
    Column("status", Text, nullable=False),
    Column("covariance", PackedNumbers(covariance_bytes, covariance_of_bytes)),
)
edges = _table(
    "edges",
    _scene("target", primary_key=True),
    _scene("source", primary_key=True),
    Column("since", Integer, ForeignKey("revisions.number"), primary_key=True),
    Column("until", Integer, ForeignKey("revisions.number"), index=True),
    Column("use", Text, nullable=False, server_default="unused"),
    Column("residual_chi2", Real),
    Column("reason", Text, nullable=False, server_default=""),
    Column("undecided", Integer, nullable=False, server_default="0"),
    CheckConstraint("use in ('used', 'tentative', 'unused')", name="use"),
)

priors = _table(
    "priors",
    Column("number", Integer, primary_key=True),
    _scene("scene", index=True),
    Column("S_map_scene", JsonText(is_pose), nullable=False),
    Column("sigmas", JsonText(is_sigmas), nullable=False),
    Column("up", JsonText(is_direction)),
    Column("up_sigma_rad", Real, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)

# World observations, never overwritten.
observations = _table(
    "observations",
    Column("number", Integer, primary_key=True),
    Column("kind", EnumText(OBSERVATION_KINDS), nullable=False),
    Column("name", LineText, nullable=False),
    Column("scene", DigestText, ForeignKey("scenes.id"), index=True),  # scene whose frame it refers to; null for points
    Column("other", DigestText, ForeignKey("scenes.id")),  # scene of a scale bar's other end
    Column("value", JsonText(is_object), nullable=False),  # as of `gsmap.types.world`
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
    CheckConstraint("kind in ('frame', 'point', 'image', 'fix', 'bar')", name="kind"),
)

# Photos kept as evidence with pose and observations; a removed one keeps its row.
photo_sightings = _table(
    "photo_sightings",
    Column("number", Integer, primary_key=True),
    Column("digest", DigestText, nullable=False, index=True),  # SHA-256 of the file
    Column("name", LineText, nullable=False),
    Column("captured_at", LineText),
    _scene("scene", index=True),  # whose frame its pose is in
    Column("value", JsonText(is_object), nullable=False),  # as of `gsmap.types.localized_photo`
    Column("group_id", DigestText, ForeignKey("groups.id")),  # of its small JPEG; null once removed and pruned
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)

# Objects tracked over all scenes by number (`o12`), with their boxes in each scene and facts about them.
objects = _table(
    "objects",
    Column("number", Integer, primary_key=True),
    Column("created_at", Text, nullable=False),
)
object_places = _table(
    "object_places",
    Column("object", Integer, ForeignKey("objects.number"), primary_key=True),
    _scene("scene", primary_key=True, index=True),
    Column("box", JsonText(is_box), nullable=False),  # bounds in the scene frame
)
object_facts = _table(
    "object_facts",
    Column("number", Integer, primary_key=True),
    Column("object", Integer, ForeignKey("objects.number"), nullable=False, index=True),
    Column("kind", EnumText(OBJECT_FACTS), nullable=False),
    Column("value", MultilineText, nullable=False),  # empty: the previous value is withdrawn
    Column("author", LineText, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("kind in ('name', 'label', 'note', 'same_as')", name="kind"),
)
models = _table(
    "models",
    Column("number", Integer, primary_key=True),
    Column("name", LineText, nullable=False),
    Column("kind", LineText, nullable=False),
    Column("path", Text, nullable=False),  # relative to the map if copied
    Column("copied", Integer, nullable=False),
    Column("sha256", DigestText, nullable=False),
    Column("size_bytes", Bytes, nullable=False),
    Column("options", JsonText(is_object), nullable=False),
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)
Index(
    "uq_models_living_name",
    models.c.name,
    unique=True,
    sqlite_where=text("removed_at IS NULL"),  # on PostgreSQL too (migrations); naming it here would load that dialect
)

exports = _table(
    "exports",
    Column("number", Integer, primary_key=True),
    Column("target", Text, nullable=False, index=True),  # the folder or file it was written to
    Column("revision", Integer, ForeignKey("revisions.number")),
    Column("settings", JsonText(is_object), nullable=False),
    Column("created_at", Text, nullable=False),
)
tiles = _table(
    "tiles",
    Column("number", Integer, primary_key=True),
    Column("export", Integer, ForeignKey("exports.number"), nullable=False),
    Column("key", KeyText, nullable=False, index=True),  # RecipeKey.digest
    _recipe(),
    Column("component", Integer, nullable=False),
    Column("bounds", JsonText(is_box), nullable=False),
    Column("poses", JsonText(is_poses_by_scene), nullable=False),  # S_map_scene by scene id
    Column("num_gaussians", Integer, nullable=False),
    Column("truncated", Integer, nullable=False),
    Column("notes", JsonText(is_text_list), nullable=False, server_default="[]"),
    Column("path", RelativePathText, nullable=False),  # relative to the target
    Column("sha256", KeyText, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)

# Leases of processes on the map, a job, or an export folder; a lease that is not renewed expires.
leases = _table(
    "leases",
    Column("what", Text, primary_key=True),
    Column("token", Text, nullable=False),  # of its owner; random
    Column("host", Text, nullable=False),
    # Process id, and its start to tell it from a later process with the same id.
    Column("process", Text, nullable=False),
    Column("task", Text, nullable=False),  # the verb, for messages
    Column("since", Text, nullable=False),
    Column("expires_at", Text, nullable=False),
)

# Quarantined jobs, which crashed their processes and are skipped until requested, and unreadable captures.
set_aside = _table(
    "set_aside",
    Column("what", LineText, primary_key=True),  # KIND and RecipeKey.digest, or a digest of a path
    Column("about", LineText, nullable=False),  # ids of scenes, a folder, or a file
    Column("reason", LineText, nullable=False),
    Column("created_at", Text, nullable=False),
)

backups = _table(
    "backups",
    Column("number", Integer, primary_key=True),
    Column("target", Text, nullable=False),  # where it went; no password
    Column("snapshot", LineText, nullable=False),  # its name there
    Column("created_at", Text, nullable=False),
    Column("num_bytes", Bytes, nullable=False),  # that it added there
)

# Purged scenes: nothing of them is kept but a receipt.
purges = _table(
    "purges",
    Column("number", Integer, primary_key=True),
    Column("scene", DigestText, nullable=False),  # its id: a digest
    Column("receipt", JsonText(is_object), nullable=False),  # what was deleted, and where else copies may exist
    Column("created_at", Text, nullable=False),
)
