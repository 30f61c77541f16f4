"""The first tables."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

# What the types were at this revision, whatever gsmap.store.schema says later.
JSON = sa.Text()
REAL: sa.types.TypeEngine[float] = sa.Double().with_variant(sa.REAL(), "sqlite")
BYTES = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
LIVING = sa.text("removed_at IS NULL")


def upgrade() -> None:
    op.create_table(
        "about",
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("gsmap_version", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_about")),
        sqlite_strict=True,
    )
    op.create_table(
        "groups",
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_groups")),
        sqlite_strict=True,
    )
    op.create_table(
        "models",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("path", sa.Text, nullable=False),
        sa.Column("copied", sa.Integer, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("size_bytes", BYTES, nullable=False),
        sa.Column("options", JSON, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("removed_at", sa.Text, nullable=True),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_models")),
        sqlite_strict=True,
    )
    op.create_index(
        "uq_models_living_name", "models", ["name"], unique=True, sqlite_where=LIVING, postgresql_where=LIVING
    )
    op.create_table(
        "revisions",
        sa.Column("number", sa.Integer, autoincrement=False, nullable=False),
        sa.Column("parameters", JSON, nullable=False),
        sa.Column("undecided", JSON, nullable=False),
        sa.Column("note", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("dropped_at", sa.Text, nullable=True),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_revisions")),
        sqlite_strict=True,
    )
    op.create_table(
        "exports",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("revision", sa.Integer, nullable=True),
        sa.Column("settings", JSON, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["revision"], ["revisions.number"], name=op.f("fk_exports_revision_revisions")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_exports")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_exports_target"), "exports", ["target"], unique=False)
    op.create_table(
        "files",
        sa.Column("group_id", sa.Text, nullable=False),
        sa.Column("path", sa.Text, nullable=False),
        sa.Column("size_bytes", BYTES, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_files_group_id_groups")),
        sa.PrimaryKeyConstraint("group_id", "path", name=op.f("pk_files")),
        sqlite_strict=True,
    )
    op.create_table(
        "scenes",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("num_gaussians", sa.Integer, nullable=False),
        sa.Column("sh_degree", sa.Integer, nullable=False),
        sa.Column("num_cameras", sa.Integer, nullable=False),
        sa.Column("bounds", JSON, nullable=False),
        sa.Column("scale_policy", sa.Text, nullable=False),
        sa.Column("captured_at", sa.Text, nullable=True),
        sa.Column("ingested_at", sa.Text, nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("cameras_synthesised", sa.Integer, nullable=False),
        sa.Column("antialiased", sa.Integer, nullable=False),
        sa.Column("notes", JSON, nullable=False),
        sa.Column("group_id", sa.Text, nullable=True),
        sa.Column("removed_at", sa.Text, nullable=True),
        sa.CheckConstraint("scale_policy in ('auto', 'known', 'unknown')", name=op.f("ck_scenes_scale_policy")),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_scenes_group_id_groups")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_scenes")),
        sa.UniqueConstraint("id", name=op.f("uq_scenes_id")),
        sqlite_strict=True,
    )
    op.create_index(
        "uq_scenes_living_name", "scenes", ["name"], unique=True, sqlite_where=LIVING, postgresql_where=LIVING
    )
    op.create_table(
        "edges",
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("used", JSON, nullable=True),
        sa.Column("residual", REAL, nullable=True),
        sa.Column("reason", sa.Text, nullable=True),
        sa.ForeignKeyConstraint(["revision"], ["revisions.number"], name=op.f("fk_edges_revision_revisions")),
        sa.ForeignKeyConstraint(["source"], ["scenes.id"], name=op.f("fk_edges_source_scenes")),
        sa.ForeignKeyConstraint(["target"], ["scenes.id"], name=op.f("fk_edges_target_scenes")),
        sa.PrimaryKeyConstraint("revision", "target", "source", name=op.f("pk_edges")),
        sqlite_strict=True,
    )
    op.create_table(
        "graphs",
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("method", sa.Text, nullable=False),
        sa.Column("num_nodes", sa.Integer, nullable=False),
        sa.Column("about", JSON, nullable=False),
        sa.Column("group_id", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_graphs_group_id_groups")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_graphs_scene_scenes")),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_graphs")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_graphs_scene"), "graphs", ["scene"], unique=False)
    op.create_table(
        "poses",
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("S_map_scene", JSON, nullable=True),
        sa.Column("component", sa.Integer, nullable=False),
        sa.Column("status", sa.Text, nullable=False),
        sa.Column("covariance", JSON, nullable=True),
        sa.ForeignKeyConstraint(["revision"], ["revisions.number"], name=op.f("fk_poses_revision_revisions")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_poses_scene_scenes")),
        sa.PrimaryKeyConstraint("revision", "scene", name=op.f("pk_poses")),
        sqlite_strict=True,
    )
    op.create_table(
        "priors",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("S_map_scene", JSON, nullable=False),
        sa.Column("sigmas", JSON, nullable=False),
        sa.Column("up", JSON, nullable=True),
        sa.Column("up_sigma_rad", REAL, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("removed_at", sa.Text, nullable=True),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_priors_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_priors")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_priors_scene"), "priors", ["scene"], unique=False)
    op.create_table(
        "registrations",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("pair", sa.Text, nullable=False),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("status", sa.Text, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("S_target_source", JSON, nullable=True),
        sa.Column("information", JSON, nullable=True),
        sa.Column("num_inliers", sa.Integer, nullable=False),
        sa.Column("num_correspondences", sa.Integer, nullable=False),
        sa.Column("overlap", REAL, nullable=False),
        sa.Column("method", sa.Text, nullable=False),
        sa.Column("exact", sa.Integer, nullable=False),
        sa.Column("seconds", JSON, nullable=False),
        sa.Column("evidence", JSON, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("status in ('accepted', 'rejected', 'no_match')", name=op.f("ck_registrations_status")),
        sa.ForeignKeyConstraint(["source"], ["scenes.id"], name=op.f("fk_registrations_source_scenes")),
        sa.ForeignKeyConstraint(["target"], ["scenes.id"], name=op.f("fk_registrations_target_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_registrations")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_registrations_key"), "registrations", ["key"], unique=False)
    op.create_index(op.f("ix_registrations_pair"), "registrations", ["pair"], unique=False)
    op.create_table(
        "tiles",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("export", sa.Integer, nullable=False),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("component", sa.Integer, nullable=False),
        sa.Column("bounds", JSON, nullable=False),
        sa.Column("poses", JSON, nullable=False),
        sa.Column("num_gaussians", sa.Integer, nullable=False),
        sa.Column("method", sa.Text, nullable=False),
        sa.Column("truncated", sa.Integer, nullable=False),
        sa.Column("path", sa.Text, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("removed_at", sa.Text, nullable=True),
        sa.ForeignKeyConstraint(["export"], ["exports.number"], name=op.f("fk_tiles_export_exports")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_tiles")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_tiles_key"), "tiles", ["key"], unique=False)
    op.create_table(
        "verdicts",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("pair", sa.Text, nullable=False),
        sa.Column("verdict", sa.Text, nullable=False),
        sa.Column("registration", sa.Integer, nullable=False),
        sa.Column("note", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("verdict in ('confirm', 'reject', 'withdraw')", name=op.f("ck_verdicts_verdict")),
        sa.ForeignKeyConstraint(
            ["registration"], ["registrations.number"], name=op.f("fk_verdicts_registration_registrations")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_verdicts")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_verdicts_pair"), "verdicts", ["pair"], unique=False)
    if op.get_bind().dialect.name == "sqlite":
        op.execute("CREATE VIRTUAL TABLE chunk_boxes USING rtree(id, s0, s1, x0, x1, y0, y1, z0, z1, +chunk INTEGER)")
    else:
        sides: list[sa.Column[float]] = [
            sa.Column(name, sa.Double(), nullable=False) for name in ("x0", "x1", "y0", "y1", "z0", "z1")
        ]
        scene: list[sa.Column[int]] = [sa.Column(name, sa.Integer, nullable=False) for name in ("s0", "s1", "chunk")]
        op.create_table("chunk_boxes", sa.Column("id", sa.Integer, primary_key=True), *scene, *sides)
        op.create_index("ix_chunk_boxes_s0", "chunk_boxes", ["s0"])


def downgrade() -> None:
    op.drop_table("chunk_boxes")
    for table in (
        "verdicts",
        "tiles",
        "registrations",
        "priors",
        "poses",
        "graphs",
        "edges",
        "scenes",
        "files",
        "exports",
        "revisions",
        "models",
        "groups",
        "about",
    ):
        op.drop_table(table)
