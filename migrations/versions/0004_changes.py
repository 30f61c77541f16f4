"""What changed between two captures, and what people said of it."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_KINDS = "kind in ('appeared', 'disappeared', 'moved', 'recoloured', 'replaced', 'lighting')"


def upgrade() -> None:
    real = sa.Double().with_variant(sa.REAL(), "sqlite")
    op.create_table(
        "comparisons",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("older", sa.Text, nullable=False),
        sa.Column("newer", sa.Text, nullable=False),
        sa.Column("pair", sa.Text, nullable=False),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("recipe", sa.Text),
        sa.Column("S_newer_older", sa.Text, nullable=False),
        sa.Column("S_frame_newer", sa.Text, nullable=False),
        sa.Column("seen_share", real, nullable=False),
        sa.Column("gains", sa.Text, nullable=False),
        sa.Column("notes", sa.Text, nullable=False),
        sa.Column("group_id", sa.Text),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["older"], ["scenes.id"], name=op.f("fk_comparisons_older_scenes")),
        sa.ForeignKeyConstraint(["newer"], ["scenes.id"], name=op.f("fk_comparisons_newer_scenes")),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_comparisons_recipe_recipes")),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_comparisons_group_id_groups")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_comparisons")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_comparisons_pair"), "comparisons", ["pair"])
    op.create_index(op.f("ix_comparisons_key"), "comparisons", ["key"])
    op.create_table(
        "changes",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("comparison", sa.Integer, nullable=False),
        sa.Column("place", sa.Integer, nullable=False),
        sa.Column("same_as", sa.Integer),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("box", sa.Text, nullable=False),
        sa.Column("S_after_before", sa.Text),
        sa.Column("symmetry", sa.Text, nullable=False),
        sa.Column("confidence", real, nullable=False),
        sa.Column("evidence", sa.Text, nullable=False),
        sa.Column("num_voxels", sa.Integer, nullable=False),
        sa.Column("num_before", sa.Integer, nullable=False),
        sa.Column("num_after", sa.Integer, nullable=False),
        sa.CheckConstraint(_KINDS, name=op.f("ck_changes_kind")),
        sa.CheckConstraint("symmetry in ('none', 'half', 'any')", name=op.f("ck_changes_symmetry")),
        sa.ForeignKeyConstraint(["comparison"], ["comparisons.number"], name=op.f("fk_changes_comparison_comparisons")),
        sa.ForeignKeyConstraint(["same_as"], ["changes.number"], name=op.f("fk_changes_same_as_changes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_changes")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_changes_comparison"), "changes", ["comparison"])
    op.create_table(
        "change_reviews",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("change", sa.Integer, nullable=False),
        sa.Column("review", sa.Text, nullable=False),
        sa.Column("note", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name=op.f("ck_change_reviews_review")),
        sa.ForeignKeyConstraint(["change"], ["changes.number"], name=op.f("fk_change_reviews_change_changes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_change_reviews")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_change_reviews_change"), "change_reviews", ["change"])


def downgrade() -> None:
    for table in ("change_reviews", "changes", "comparisons"):
        op.drop_table(table)
