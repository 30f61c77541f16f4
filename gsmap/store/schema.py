"""The catalog's tables. A change here needs a migration in ``migrations/versions`` and a new `HEAD`."""

from __future__ import annotations

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
    LargeBinary,
    MetaData,
    Table,
    Text,
    text,
)
from sqlalchemy.types import TypeEngine

from gsmap.store.columns import (
    Digest,
    Json,
    Key,
    Kind,
    Line,
    Lines,
    Numbers,
    Pair,
    RelativePath,
    Word,
    a_box,
    a_direction,
    a_graph,
    a_pose,
    a_thinning,
    an_object,
    candidates,
    members,
    numbers,
    poses_by_scene,
    sigmas,
    texts,
    ties,
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
from gsmap.types.world import OBSERVATION_KINDS

HEAD = "0011"  # the newest migration; numbered, so that older and newer can be told apart without alembic

REVISION_COUNTS = (
    "num_scenes",
    "num_placed",
    "num_components",
    "num_used",
    "num_tentative",
    "num_unused",
    "num_undecided",
)
"""What a revision knows of itself when it is made, so that a list of revisions reads no pose."""

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
        if isinstance(part, Column) and hasattr(part.type, "at"):
            part.type = part.type.at(f"{name}.{part.name}")  # so that a message can say where
    return Table(name, metadata, *parts, sqlite_strict=True)


def _scene(name: str, **options: Any) -> Column[str]:
    return Column(name, Digest, ForeignKey("scenes.id"), nullable=False, **options)


def _recipe() -> Column[str]:
    """Null in rows that schema 0001 wrote."""
    return Column("recipe", Digest, ForeignKey("recipes.digest"))


about = _table(
    "about",
    Column("id", Digest, primary_key=True),  # of the map, random
    Column("created_at", Text, nullable=False),
    Column("gsmap_version", Text, nullable=False),
)

# An immutable folder of arrays, and the digest of each of its files.
groups = _table(
    "groups",
    Column("id", Digest, primary_key=True),  # digest of the content
    Column("kind", Kind, nullable=False),  # scenes, graphs, changes, indexes, views, photos
    Column("created_at", Text, nullable=False),
)
files = _table(
    "files",
    Column("group_id", Digest, ForeignKey("groups.id"), primary_key=True),
    Column("path", RelativePath, primary_key=True),  # relative to the group
    Column("size_bytes", Bytes, nullable=False),
    Column("sha256", Digest, nullable=False),
)

scenes = _table(
    "scenes",
    Column("number", Integer, primary_key=True),
    Column("id", Digest, nullable=False, unique=True),  # digest of Gaussians and cameras
    Column("name", Line, nullable=False),
    Column("num_gaussians", Integer, nullable=False),
    Column("sh_degree", Integer, nullable=False),
    Column("num_cameras", Integer, nullable=False),
    Column("bounds", Json(a_box), nullable=False),
    Column("scale_policy", Text, nullable=False),
    Column("captured_at", Text),
    Column("ingested_at", Text, nullable=False),
    Column("source", Text, nullable=False),
    Column("cameras_synthesised", Integer, nullable=False),
    Column("antialiased", Integer, nullable=False),
    Column("notes", Json(texts), nullable=False),
    Column("group_id", Digest, ForeignKey("groups.id")),  # null once pruned
    Column("removed_at", Text),  # the tombstone
    Column("thinned", Json(a_thinning)),  # of a scene that is kept compact (`gsmap.store.compact`)
    Column("origin", Json(a_direction)),  # of its frame in the coordinates of its file; null for zero
    CheckConstraint("scale_policy in ('auto', 'known', 'unknown')", name="scale_policy"),
)
Index(
    "uq_scenes_living_name",
    scenes.c.name,
    unique=True,
    sqlite_where=text("removed_at IS NULL"),
    postgresql_where=text("removed_at IS NULL"),
)

# What people said of a scene, from its ingest on: nothing is overwritten. `scenes` holds the newest name and date.
scene_facts = _table(
    "scene_facts",
    Column("number", Integer, primary_key=True),
    _scene("scene", index=True),
    Column("kind", Text, nullable=False),
    Column("value", Lines, nullable=False),  # empty: a date, or metres per unit, that was taken back
    Column("author", Line, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("kind in ('name', 'captured_at', 'note', 'tag', 'untag', 'metres_per_unit')", name="kind"),
)

# `chunk_boxes` is an R*Tree on SQLite and a plain table elsewhere, so the migration makes it:
# id, s0 = s1 = scene number, x0 x1 y0 y1 z0 z1, chunk.
CHUNK_BOXES = "chunk_boxes"

# How results were made: a `gsmap.methods.RecipeKey` without its inputs, once for all results that share it.
recipes = _table(
    "recipes",
    Column("digest", Digest, primary_key=True),  # RecipeKey.recipe
    Column("stage", Text, nullable=False),
    Column("method", Text, nullable=False),
    Column("version", Json(an_object), nullable=False),
    Column("settings", Json(an_object), nullable=False),
    Column("backend", Text, nullable=False),
    Column("created_at", Text, nullable=False),
)

graphs = _table(
    "graphs",
    Column("key", Key, primary_key=True),  # RecipeKey.digest
    _recipe(),
    _scene("scene", index=True),
    Column("num_nodes", Integer, nullable=False),
    Column("about", Json(a_graph), nullable=False),  # up, unit_m, notes, layers
    Column("group_id", Digest, ForeignKey("groups.id"), nullable=False),
    Column("created_at", Text, nullable=False),
)

registrations = _table(
    "registrations",
    Column("number", Integer, primary_key=True),
    _scene("target", index=True),
    _scene("source", index=True),
    Column("pair", Pair, nullable=False, index=True),  # both ids, sorted: the pair in either direction
    Column("key", Key, nullable=False, index=True),  # RecipeKey.digest; empty: a person's own measurement
    _recipe(),
    Column("adopts", Integer, ForeignKey("registrations.number")),  # the earlier row that this one makes current again
    Column("status", Text, nullable=False),
    Column("reason", Text, nullable=False),
    Column("S_target_source", Numbers(pose_bytes, pose_of_bytes)),
    Column("information", Numbers(matrix_bytes, matrix_of_bytes)),
    Column("num_inliers", Integer, nullable=False),
    Column("num_correspondences", Integer, nullable=False),
    Column("overlap", Real, nullable=False),
    Column("proposer", Text, nullable=False),
    Column("exact", Integer, nullable=False),
    Column("seconds", Json(an_object), nullable=False),
    Column("evidence", Json(an_object), nullable=False),
    Column("notes", Json(texts), nullable=False, server_default="[]"),
    Column("created_at", Text, nullable=False),
    CheckConstraint("status in ('accepted', 'rejected', 'no_match')", name="status"),
)
reviews = _table(
    "reviews",
    Column("number", Integer, primary_key=True),
    Column("pair", Pair, nullable=False, index=True),
    Column("review", Text, nullable=False),
    Column("registration", Integer, ForeignKey("registrations.number"), nullable=False),
    Column("note", Lines, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name="review"),
)

# What retrieval derives from graphs, and makes anew where it is lost.
index_segments = _table(
    "index_segments",
    Column("number", Integer, primary_key=True),
    Column("key", Key, nullable=False),  # of the recipe: what an index keeps of a graph
    Column("members", Json(members), nullable=False),  # each: scene, key of its graph, upright, metric, coarseness
    Column("num_nodes", Integer, nullable=False),
    Column("group_id", Digest, ForeignKey("groups.id"), nullable=False),
    Column("created_at", Text, nullable=False),
)
lookups = _table(
    "lookups",
    _scene("scene", primary_key=True),
    Column("key", Key, nullable=False),  # RecipeKey.digest of how it asked, and of its graph
    Column("candidates", Json(candidates), nullable=False),  # best first; each: scene, score, votes
    Column("num_left", Integer),  # of these, not tried when there was enough; null until the list was gone down
    Column("created_at", Text, nullable=False),
)

# What the views of a scene show, which photographs are found by; made anew where it is lost.
view_features = _table(
    "view_features",
    Column("key", Key, primary_key=True),  # RecipeKey.digest
    _recipe(),
    _scene("scene", index=True),
    Column("num_views", Integer, nullable=False),
    Column("num_features", Integer, nullable=False),
    Column("summaries", LargeBinary, nullable=False),  # empty; older maps hold a vector of each view
    Column("group_id", Digest, ForeignKey("groups.id"), nullable=False),
    Column("created_at", Text, nullable=False),
)

# Two captures of a place, looked at for what changed. Nothing is overwritten; of a pair the newest one counts.
comparisons = _table(
    "comparisons",
    Column("number", Integer, primary_key=True),
    _scene("older"),
    _scene("newer"),
    Column("pair", Pair, nullable=False, index=True),  # both ids, sorted
    Column("key", Key, nullable=False, index=True),  # RecipeKey.digest
    _recipe(),
    Column("S_newer_older", Json(a_pose), nullable=False),  # the relative pose that it was made with
    Column("S_frame_newer", Json(a_pose), nullable=False),  # takes the newer scene to the frame of boxes and voxels
    Column("seen_share", Real, nullable=False),
    Column("gains", Json(a_direction), nullable=False),
    Column("notes", Json(texts), nullable=False),
    Column("group_id", Digest, ForeignKey("groups.id")),  # null where nothing changed, and once pruned
    Column("created_at", Text, nullable=False),
)
changes = _table(
    "changes",
    Column("number", Integer, primary_key=True),
    Column("comparison", Integer, ForeignKey("comparisons.number"), nullable=False, index=True),
    Column("place", Integer, nullable=False),  # in its comparison, from 0, surest first
    Column("same_as", Integer, ForeignKey("changes.number")),  # the first row of the change that this one is; or null
    Column("kind", Word(CHANGE_KINDS), nullable=False),
    Column("box", Json(a_box), nullable=False),
    Column("S_after_before", Json(a_pose)),
    Column("symmetry", Word(SYMMETRIES), nullable=False),
    Column("confidence", Real, nullable=False),
    Column("evidence", Json(numbers), nullable=False),
    Column("num_voxels", Integer, nullable=False),  # so many of each array of its comparison are its own
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
    Column("note", Lines, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name="review"),
)

revisions = _table(
    "revisions",
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("key", Key, nullable=False, server_default=""),  # RecipeKey.digest
    _recipe(),
    Column("settings", Json(an_object), nullable=False, server_default="{}"),
    Column("provenance", Json(an_object), nullable=False, server_default="{}"),
    Column("notes", Json(texts), nullable=False, server_default="[]"),
    Column("world", Json(ties), nullable=False, server_default="[]"),  # where its components lie in the world
    Column("note", Lines, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("dropped_at", Text),  # prune may reclaim what only this revision names
    Column(
        "origin", Json(an_object)
    ),  # {"map": id, "number": n} of a revision that another map solved; null where this one did
    *(Column(name, Integer, nullable=False, server_default="0") for name in REVISION_COUNTS),
)
# Where scenes lie, and what became of edges: a row holds from the revision `since` to the one before `until`, or up to
# the newest where that is null. A revision adds what differs from the one before it.
poses = _table(
    "poses",
    _scene("scene", primary_key=True),
    Column("since", Integer, ForeignKey("revisions.number"), primary_key=True),
    Column("until", Integer, ForeignKey("revisions.number"), index=True),
    Column("S_map_scene", Numbers(pose_bytes, pose_of_bytes)),
    Column("component", Integer, nullable=False),
    Column("status", Text, nullable=False),
    Column("covariance", Numbers(covariance_bytes, covariance_of_bytes)),
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
    Column("S_map_scene", Json(a_pose), nullable=False),
    Column("sigmas", Json(sigmas), nullable=False),
    Column("up", Json(a_direction)),
    Column("up_sigma_rad", Real, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)

# What was observed of the world; nothing is overwritten.
observations = _table(
    "observations",
    Column("number", Integer, primary_key=True),
    Column("kind", Word(OBSERVATION_KINDS), nullable=False),
    Column("name", Line, nullable=False),
    Column("scene", Digest, ForeignKey("scenes.id"), index=True),  # whose frame it speaks of; null of points
    Column("other", Digest, ForeignKey("scenes.id")),  # of a scale bar's other end
    Column("value", Json(an_object), nullable=False),  # as of `gsmap.types.world`
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
    CheckConstraint("kind in ('frame', 'point', 'image', 'fix', 'bar')", name="kind"),
)

# Photographs that are kept as evidence: when, from where, what they show; one that is taken back says when.
photo_sightings = _table(
    "photo_sightings",
    Column("number", Integer, primary_key=True),
    Column("digest", Digest, nullable=False, index=True),  # SHA-256 of the file
    Column("name", Line, nullable=False),
    Column("captured_at", Line),
    _scene("scene", index=True),  # whose frame its pose is in
    Column("value", Json(an_object), nullable=False),  # as of `gsmap.types.localized_photo`
    Column("group_id", Digest, ForeignKey("groups.id")),  # of its small JPEG; null once it was taken back and pruned
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)

# Things of the map over all captures, by the number they are called by (`o12`): where each capture shows one, and what
# people said of it. What was computed of them (`object_sets`) is made anew where it is lost or out of date.
objects = _table(
    "objects",
    Column("number", Integer, primary_key=True),
    Column("created_at", Text, nullable=False),
)
object_places = _table(
    "object_places",
    Column("object", Integer, ForeignKey("objects.number"), primary_key=True),
    _scene("scene", primary_key=True, index=True),
    Column("box", Json(a_box), nullable=False),  # around it, the scene's own frame
)
object_facts = _table(
    "object_facts",
    Column("number", Integer, primary_key=True),
    Column("object", Integer, ForeignKey("objects.number"), nullable=False, index=True),
    Column("kind", Word(OBJECT_FACTS), nullable=False),
    Column("value", Lines, nullable=False),  # empty: what was said before is taken back
    Column("author", Line, nullable=False),
    Column("created_at", Text, nullable=False),
    CheckConstraint("kind in ('name', 'label', 'note', 'same_as')", name="kind"),
)
object_sets = _table(
    "object_sets",
    Column("number", Integer, primary_key=True),
    Column("key", Key, nullable=False, index=True),  # RecipeKey.digest
    _recipe(),
    Column("poses", Json(poses_by_scene), nullable=False),  # S_map_scene of its captures, as it was made with
    Column("value", Json(an_object), nullable=False),  # as of `gsmap.store.objects`
    Column("created_at", Text, nullable=False),
)

models = _table(
    "models",
    Column("number", Integer, primary_key=True),
    Column("name", Line, nullable=False),
    Column("kind", Line, nullable=False),
    Column("path", Text, nullable=False),  # relative to the map where it was copied
    Column("copied", Integer, nullable=False),
    Column("sha256", Digest, nullable=False),
    Column("size_bytes", Bytes, nullable=False),
    Column("options", Json(an_object), nullable=False),
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)
Index(
    "uq_models_living_name",
    models.c.name,
    unique=True,
    sqlite_where=text("removed_at IS NULL"),
    postgresql_where=text("removed_at IS NULL"),
)

exports = _table(
    "exports",
    Column("number", Integer, primary_key=True),
    Column("target", Text, nullable=False, index=True),  # the folder or file it was written to
    Column("revision", Integer, ForeignKey("revisions.number")),
    Column("settings", Json(an_object), nullable=False),
    Column("created_at", Text, nullable=False),
)
tiles = _table(
    "tiles",
    Column("number", Integer, primary_key=True),
    Column("export", Integer, ForeignKey("exports.number"), nullable=False),
    Column("key", Key, nullable=False, index=True),  # RecipeKey.digest
    _recipe(),
    Column("older_recipe", Text),  # of rows that schema 0001 wrote: merger and parameters as one text
    Column("component", Integer, nullable=False),
    Column("bounds", Json(a_box), nullable=False),
    Column("poses", Json(poses_by_scene), nullable=False),  # S_map_scene by scene id
    Column("num_gaussians", Integer, nullable=False),
    Column("truncated", Integer, nullable=False),
    Column("notes", Json(texts), nullable=False, server_default="[]"),
    Column("path", RelativePath, nullable=False),  # relative to the target
    Column("sha256", Key, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("removed_at", Text),
)

# Who is at work on what: the map, a job, another folder. A lease that is not renewed in time is nobody's.
leases = _table(
    "leases",
    Column("what", Text, primary_key=True),
    Column("token", Text, nullable=False),  # of the one holder; random
    Column("host", Text, nullable=False),
    Column("process", Text, nullable=False),  # its number, and what tells it from a later process of that number
    Column("task", Text, nullable=False),  # the verb, for people
    Column("since", Text, nullable=False),
    Column("expires_at", Text, nullable=False),
)

# Jobs that ended the processes they ran in, left out until a person asks for them; captures that could not be read.
set_aside = _table(
    "set_aside",
    Column("what", Line, primary_key=True),  # KIND and RecipeKey.digest, or a digest of a path
    Column("about", Line, nullable=False),  # ids of scenes, a folder, or a file
    Column("reason", Line, nullable=False),
    Column("created_at", Text, nullable=False),
)

backups = _table(
    "backups",
    Column("number", Integer, primary_key=True),
    Column("target", Text, nullable=False),  # where it went; no password
    Column("snapshot", Line, nullable=False),  # its name there
    Column("created_at", Text, nullable=False),
    Column("num_bytes", Bytes, nullable=False),  # that it added there
)

# Scenes that were forgotten on demand: nothing of them is kept but that it happened.
purges = _table(
    "purges",
    Column("number", Integer, primary_key=True),
    Column("scene", Digest, nullable=False),  # its id: a digest
    Column("receipt", Json(an_object), nullable=False),  # what went, and where else it may live
    Column("created_at", Text, nullable=False),
)
