"""The tables of the first release."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = None
branch_labels = None
depends_on = None

_LIVING = sa.text("removed_at IS NULL")


def upgrade() -> None:
    op.create_table(
        "about",
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("gsmap_version", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_about")),
        sqlite_strict=True,
    )
    op.create_table(
        "backups",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("target", sa.Text(), nullable=False),
        sa.Column("snapshot", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("num_bytes", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_backups")),
        sqlite_strict=True,
    )
    op.create_table(
        "groups",
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_groups")),
        sqlite_strict=True,
    )
    op.create_table(
        "leases",
        sa.Column("what", sa.Text(), nullable=False),
        sa.Column("token", sa.Text(), nullable=False),
        sa.Column("host", sa.Text(), nullable=False),
        sa.Column("process", sa.Text(), nullable=False),
        sa.Column("task", sa.Text(), nullable=False),
        sa.Column("since", sa.Text(), nullable=False),
        sa.Column("expires_at", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("what", name=op.f("pk_leases")),
        sqlite_strict=True,
    )
    op.create_table(
        "models",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("copied", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.Text(), nullable=False),
        sa.Column("size_bytes", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("options", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("removed_at", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_models")),
        sqlite_strict=True,
    )
    op.create_index(
        "uq_models_living_name", "models", ["name"], unique=True, sqlite_where=_LIVING, postgresql_where=_LIVING
    )
    op.create_table(
        "objects",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_objects")),
        sqlite_strict=True,
    )
    op.create_table(
        "purges",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("receipt", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_purges")),
        sqlite_strict=True,
    )
    op.create_table(
        "recipes",
        sa.Column("digest", sa.Text(), nullable=False),
        sa.Column("stage", sa.Text(), nullable=False),
        sa.Column("method", sa.Text(), nullable=False),
        sa.Column("version", sa.Text(), nullable=False),
        sa.Column("settings", sa.Text(), nullable=False),
        sa.Column("backend", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_recipes")),
        sqlite_strict=True,
    )
    op.create_table(
        "set_aside",
        sa.Column("what", sa.Text(), nullable=False),
        sa.Column("about", sa.Text(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("what", name=op.f("pk_set_aside")),
        sqlite_strict=True,
    )
    op.create_table(
        "files",
        sa.Column("group_id", sa.Text(), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("size_bytes", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("sha256", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_files_group_id_groups")),
        sa.PrimaryKeyConstraint("group_id", "path", name=op.f("pk_files")),
        sqlite_strict=True,
    )
    op.create_table(
        "object_facts",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("object", sa.Integer(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=False),
        sa.Column("author", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.CheckConstraint("kind in ('name', 'label', 'note', 'same_as')", name=op.f("ck_object_facts_kind")),
        sa.ForeignKeyConstraint(["object"], ["objects.number"], name=op.f("fk_object_facts_object_objects")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_object_facts")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_object_facts_object"), "object_facts", ["object"], unique=False)
    op.create_table(
        "revisions",
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("key", sa.Text(), server_default="", nullable=False),
        sa.Column("recipe", sa.Text(), nullable=True),
        sa.Column("settings", sa.Text(), server_default="{}", nullable=False),
        sa.Column("provenance", sa.Text(), server_default="{}", nullable=False),
        sa.Column("notes", sa.Text(), server_default="[]", nullable=False),
        sa.Column("world", sa.Text(), server_default="[]", nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("dropped_at", sa.Text(), nullable=True),
        sa.Column("origin", sa.Text(), nullable=True),
        sa.Column("num_scenes", sa.Integer(), server_default="0", nullable=False),
        sa.Column("num_placed", sa.Integer(), server_default="0", nullable=False),
        sa.Column("num_components", sa.Integer(), server_default="0", nullable=False),
        sa.Column("num_used", sa.Integer(), server_default="0", nullable=False),
        sa.Column("num_tentative", sa.Integer(), server_default="0", nullable=False),
        sa.Column("num_unused", sa.Integer(), server_default="0", nullable=False),
        sa.Column("num_undecided", sa.Integer(), server_default="0", nullable=False),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_revisions_recipe_recipes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_revisions")),
        sqlite_strict=True,
    )
    op.create_table(
        "scenes",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("num_gaussians", sa.Integer(), nullable=False),
        sa.Column("sh_degree", sa.Integer(), nullable=False),
        sa.Column("num_cameras", sa.Integer(), nullable=False),
        sa.Column("bounds", sa.Text(), nullable=False),
        sa.Column("scale_policy", sa.Text(), nullable=False),
        sa.Column("captured_at", sa.Text(), nullable=True),
        sa.Column("ingested_at", sa.Text(), nullable=False),
        sa.Column("source", sa.Text(), nullable=False),
        sa.Column("cameras_synthesised", sa.Integer(), nullable=False),
        sa.Column("antialiased", sa.Integer(), nullable=False),
        sa.Column("notes", sa.Text(), nullable=False),
        sa.Column("group_id", sa.Text(), nullable=True),
        sa.Column("removed_at", sa.Text(), nullable=True),
        sa.Column("thinned", sa.Text(), nullable=True),
        sa.Column("origin", sa.Text(), nullable=True),
        sa.CheckConstraint("scale_policy in ('auto', 'known', 'unknown')", name=op.f("ck_scenes_scale_policy")),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_scenes_group_id_groups")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_scenes")),
        sa.UniqueConstraint("id", name=op.f("uq_scenes_id")),
        sqlite_strict=True,
    )
    op.create_index(
        "uq_scenes_living_name", "scenes", ["name"], unique=True, sqlite_where=_LIVING, postgresql_where=_LIVING
    )
    op.create_table(
        "comparisons",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("older", sa.Text(), nullable=False),
        sa.Column("newer", sa.Text(), nullable=False),
        sa.Column("pair", sa.Text(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("recipe", sa.Text(), nullable=True),
        sa.Column("S_newer_older", sa.Text(), nullable=False),
        sa.Column("S_frame_newer", sa.Text(), nullable=False),
        sa.Column("seen_share", sa.Double().with_variant(sa.REAL(), "sqlite"), nullable=False),
        sa.Column("gains", sa.Text(), nullable=False),
        sa.Column("notes", sa.Text(), nullable=False),
        sa.Column("group_id", sa.Text(), nullable=True),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_comparisons_group_id_groups")),
        sa.ForeignKeyConstraint(["newer"], ["scenes.id"], name=op.f("fk_comparisons_newer_scenes")),
        sa.ForeignKeyConstraint(["older"], ["scenes.id"], name=op.f("fk_comparisons_older_scenes")),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_comparisons_recipe_recipes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_comparisons")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_comparisons_key"), "comparisons", ["key"], unique=False)
    op.create_index(op.f("ix_comparisons_pair"), "comparisons", ["pair"], unique=False)
    op.create_table(
        "edges",
        sa.Column("target", sa.Text(), nullable=False),
        sa.Column("source", sa.Text(), nullable=False),
        sa.Column("since", sa.Integer(), nullable=False),
        sa.Column("until", sa.Integer(), nullable=True),
        sa.Column("use", sa.Text(), server_default="unused", nullable=False),
        sa.Column("residual_chi2", sa.Double().with_variant(sa.REAL(), "sqlite"), nullable=True),
        sa.Column("reason", sa.Text(), server_default="", nullable=False),
        sa.Column("undecided", sa.Integer(), server_default="0", nullable=False),
        sa.CheckConstraint("use in ('used', 'tentative', 'unused')", name=op.f("ck_edges_use")),
        sa.ForeignKeyConstraint(["since"], ["revisions.number"], name=op.f("fk_edges_since_revisions")),
        sa.ForeignKeyConstraint(["source"], ["scenes.id"], name=op.f("fk_edges_source_scenes")),
        sa.ForeignKeyConstraint(["target"], ["scenes.id"], name=op.f("fk_edges_target_scenes")),
        sa.ForeignKeyConstraint(["until"], ["revisions.number"], name=op.f("fk_edges_until_revisions")),
        sa.PrimaryKeyConstraint("target", "source", "since", name=op.f("pk_edges")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_edges_until"), "edges", ["until"], unique=False)
    op.create_table(
        "exports",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("target", sa.Text(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=True),
        sa.Column("settings", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["revision"], ["revisions.number"], name=op.f("fk_exports_revision_revisions")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_exports")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_exports_target"), "exports", ["target"], unique=False)
    op.create_table(
        "results",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("recipe", sa.Text(), nullable=True),
        sa.Column("scene", sa.Text(), nullable=True),
        sa.Column("scenes", sa.Text(), nullable=True),
        sa.Column("num_items", sa.Integer(), nullable=False),
        sa.Column("about", sa.Text(), nullable=False),
        sa.Column("group_id", sa.Text(), nullable=True),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_results_group_id_groups")),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_results_recipe_recipes")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_results_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_results")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_results_kind_key"), "results", ["kind", "key"], unique=False)
    op.create_index(op.f("ix_results_scene"), "results", ["scene"], unique=False)
    op.create_table(
        "lookups",
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("candidates", sa.Text(), nullable=False),
        sa.Column("num_left", sa.Integer(), nullable=True),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_lookups_scene_scenes")),
        sa.PrimaryKeyConstraint("scene", name=op.f("pk_lookups")),
        sqlite_strict=True,
    )
    op.create_table(
        "object_places",
        sa.Column("object", sa.Integer(), nullable=False),
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("box", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["object"], ["objects.number"], name=op.f("fk_object_places_object_objects")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_object_places_scene_scenes")),
        sa.PrimaryKeyConstraint("object", "scene", name=op.f("pk_object_places")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_object_places_scene"), "object_places", ["scene"], unique=False)
    op.create_table(
        "observations",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("scene", sa.Text(), nullable=True),
        sa.Column("other", sa.Text(), nullable=True),
        sa.Column("value", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("removed_at", sa.Text(), nullable=True),
        sa.CheckConstraint("kind in ('frame', 'point', 'image', 'fix', 'bar')", name=op.f("ck_observations_kind")),
        sa.ForeignKeyConstraint(["other"], ["scenes.id"], name=op.f("fk_observations_other_scenes")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_observations_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_observations")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_observations_scene"), "observations", ["scene"], unique=False)
    op.create_table(
        "photo_sightings",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("digest", sa.Text(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("captured_at", sa.Text(), nullable=True),
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=False),
        sa.Column("group_id", sa.Text(), nullable=True),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("removed_at", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_photo_sightings_group_id_groups")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_photo_sightings_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_photo_sightings")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_photo_sightings_digest"), "photo_sightings", ["digest"], unique=False)
    op.create_index(op.f("ix_photo_sightings_scene"), "photo_sightings", ["scene"], unique=False)
    op.create_table(
        "poses",
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("since", sa.Integer(), nullable=False),
        sa.Column("until", sa.Integer(), nullable=True),
        sa.Column("S_map_scene", sa.LargeBinary(), nullable=True),
        sa.Column("component", sa.Integer(), nullable=False),
        sa.Column("status", sa.Text(), nullable=False),
        sa.Column("covariance", sa.LargeBinary(), nullable=True),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_poses_scene_scenes")),
        sa.ForeignKeyConstraint(["since"], ["revisions.number"], name=op.f("fk_poses_since_revisions")),
        sa.ForeignKeyConstraint(["until"], ["revisions.number"], name=op.f("fk_poses_until_revisions")),
        sa.PrimaryKeyConstraint("scene", "since", name=op.f("pk_poses")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_poses_until"), "poses", ["until"], unique=False)
    op.create_table(
        "priors",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("S_map_scene", sa.Text(), nullable=False),
        sa.Column("sigmas", sa.Text(), nullable=False),
        sa.Column("up", sa.Text(), nullable=True),
        sa.Column("up_sigma_rad", sa.Double().with_variant(sa.REAL(), "sqlite"), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("removed_at", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_priors_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_priors")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_priors_scene"), "priors", ["scene"], unique=False)
    op.create_table(
        "registrations",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("target", sa.Text(), nullable=False),
        sa.Column("source", sa.Text(), nullable=False),
        sa.Column("pair", sa.Text(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("recipe", sa.Text(), nullable=True),
        sa.Column("adopts", sa.Integer(), nullable=True),
        sa.Column("status", sa.Text(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("S_target_source", sa.LargeBinary(), nullable=True),
        sa.Column("information", sa.LargeBinary(), nullable=True),
        sa.Column("num_inliers", sa.Integer(), nullable=False),
        sa.Column("num_correspondences", sa.Integer(), nullable=False),
        sa.Column("overlap", sa.Double().with_variant(sa.REAL(), "sqlite"), nullable=False),
        sa.Column("proposer", sa.Text(), nullable=False),
        sa.Column("exact", sa.Integer(), nullable=False),
        sa.Column("seconds", sa.Text(), nullable=False),
        sa.Column("evidence", sa.Text(), nullable=False),
        sa.Column("notes", sa.Text(), server_default="[]", nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.CheckConstraint("status in ('accepted', 'rejected', 'no_match')", name=op.f("ck_registrations_status")),
        sa.ForeignKeyConstraint(
            ["adopts"], ["registrations.number"], name=op.f("fk_registrations_adopts_registrations")
        ),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_registrations_recipe_recipes")),
        sa.ForeignKeyConstraint(["source"], ["scenes.id"], name=op.f("fk_registrations_source_scenes")),
        sa.ForeignKeyConstraint(["target"], ["scenes.id"], name=op.f("fk_registrations_target_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_registrations")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_registrations_key"), "registrations", ["key"], unique=False)
    op.create_index(op.f("ix_registrations_pair"), "registrations", ["pair"], unique=False)
    op.create_index(op.f("ix_registrations_source"), "registrations", ["source"], unique=False)
    op.create_index(op.f("ix_registrations_target"), "registrations", ["target"], unique=False)
    op.create_table(
        "scene_facts",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("scene", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=False),
        sa.Column("author", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.CheckConstraint(
            "kind in ('name', 'captured_at', 'note', 'tag', 'untag', 'metres_per_unit')",
            name=op.f("ck_scene_facts_kind"),
        ),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_scene_facts_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_scene_facts")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_scene_facts_scene"), "scene_facts", ["scene"], unique=False)
    op.create_table(
        "changes",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("comparison", sa.Integer(), nullable=False),
        sa.Column("place", sa.Integer(), nullable=False),
        sa.Column("same_as", sa.Integer(), nullable=True),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("box", sa.Text(), nullable=False),
        sa.Column("S_after_before", sa.Text(), nullable=True),
        sa.Column("symmetry", sa.Text(), nullable=False),
        sa.Column("confidence", sa.Double().with_variant(sa.REAL(), "sqlite"), nullable=False),
        sa.Column("evidence", sa.Text(), nullable=False),
        sa.Column("num_voxels", sa.Integer(), nullable=False),
        sa.Column("num_before", sa.Integer(), nullable=False),
        sa.Column("num_after", sa.Integer(), nullable=False),
        sa.CheckConstraint(
            "kind in ('appeared', 'disappeared', 'moved', 'recoloured', 'replaced', 'lighting')",
            name=op.f("ck_changes_kind"),
        ),
        sa.CheckConstraint("symmetry in ('none', 'half', 'any')", name=op.f("ck_changes_symmetry")),
        sa.ForeignKeyConstraint(["comparison"], ["comparisons.number"], name=op.f("fk_changes_comparison_comparisons")),
        sa.ForeignKeyConstraint(["same_as"], ["changes.number"], name=op.f("fk_changes_same_as_changes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_changes")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_changes_comparison"), "changes", ["comparison"], unique=False)
    op.create_table(
        "reviews",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("pair", sa.Text(), nullable=False),
        sa.Column("review", sa.Text(), nullable=False),
        sa.Column("registration", sa.Integer(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name=op.f("ck_reviews_review")),
        sa.ForeignKeyConstraint(
            ["registration"], ["registrations.number"], name=op.f("fk_reviews_registration_registrations")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_reviews")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_reviews_pair"), "reviews", ["pair"], unique=False)
    op.create_table(
        "tiles",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("export", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("recipe", sa.Text(), nullable=True),
        sa.Column("component", sa.Integer(), nullable=False),
        sa.Column("bounds", sa.Text(), nullable=False),
        sa.Column("poses", sa.Text(), nullable=False),
        sa.Column("num_gaussians", sa.Integer(), nullable=False),
        sa.Column("truncated", sa.Integer(), nullable=False),
        sa.Column("notes", sa.Text(), server_default="[]", nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("sha256", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.Column("removed_at", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(["export"], ["exports.number"], name=op.f("fk_tiles_export_exports")),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_tiles_recipe_recipes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_tiles")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_tiles_key"), "tiles", ["key"], unique=False)
    op.create_table(
        "change_reviews",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("change", sa.Integer(), nullable=False),
        sa.Column("review", sa.Text(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Text(), nullable=False),
        sa.CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name=op.f("ck_change_reviews_review")),
        sa.ForeignKeyConstraint(["change"], ["changes.number"], name=op.f("fk_change_reviews_change_changes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_change_reviews")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_change_reviews_change"), "change_reviews", ["change"], unique=False)
    # ### end Alembic commands ###
    _chunk_boxes()


def _chunk_boxes() -> None:
    """Create the R*Tree of the chunks of all scenes; a plain table where the database has none."""
    if op.get_bind().dialect.name == "sqlite":
        op.execute("CREATE VIRTUAL TABLE chunk_boxes USING rtree(id, s0, s1, x0, x1, y0, y1, z0, z1, +chunk INTEGER)")
        return
    sides: list[sa.Column[float]] = [
        sa.Column(name, sa.Double(), nullable=False) for name in ("x0", "x1", "y0", "y1", "z0", "z1")
    ]
    scene: list[sa.Column[int]] = [sa.Column(name, sa.Integer, nullable=False) for name in ("s0", "s1", "chunk")]
    op.create_table("chunk_boxes", sa.Column("id", sa.Integer, primary_key=True), *scene, *sides)
    op.create_index("ix_chunk_boxes_s0", "chunk_boxes", ["s0"])


def downgrade() -> None:
    op.drop_table("chunk_boxes")
    for table in (
        "change_reviews",
        "tiles",
        "reviews",
        "changes",
        "scene_facts",
        "registrations",
        "priors",
        "poses",
        "photo_sightings",
        "observations",
        "object_places",
        "lookups",
        "results",
        "exports",
        "edges",
        "comparisons",
        "scenes",
        "revisions",
        "object_facts",
        "files",
        "set_aside",
        "recipes",
        "purges",
        "objects",
        "models",
        "leases",
        "groups",
        "backups",
        "about",
    ):
        op.drop_table(table)
