"""What people say of a scene's unit: metres per unit, as a fact like its name and date."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_BEFORE = ("name", "captured_at", "note", "tag", "untag")


def upgrade() -> None:
    _kinds((*_BEFORE, "metres_per_unit"))


def downgrade() -> None:
    op.execute("DELETE FROM scene_facts WHERE kind = 'metres_per_unit'")
    _kinds(_BEFORE)


def _kinds(kinds: tuple[str, ...]) -> None:
    """Let facts be of these kinds. SQLite changes no constraint of a table, so it gets another table."""
    check = f"kind in ({', '.join(repr(kind) for kind in kinds)})"
    if op.get_context().dialect.name != "sqlite":
        op.drop_constraint(op.f("ck_scene_facts_kind"), "scene_facts", type_="check")
        op.create_check_constraint(op.f("ck_scene_facts_kind"), "scene_facts", check)
        return
    op.drop_index(op.f("ix_scene_facts_scene"), table_name="scene_facts")
    op.rename_table("scene_facts", "older_scene_facts")
    op.create_table(
        "scene_facts",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("author", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint(check, name=op.f("ck_scene_facts_kind")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_scene_facts_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_scene_facts")),
        sqlite_strict=True,
    )
    columns = "number, scene, kind, value, author, created_at"
    op.execute(f"INSERT INTO scene_facts ({columns}) SELECT {columns} FROM older_scene_facts")
    op.drop_table("older_scene_facts")
    op.create_index(op.f("ix_scene_facts_scene"), "scene_facts", ["scene"], unique=False)
