"""Who is at work, where backups went, what was purged, and which map a revision came from."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "leases",
        sa.Column("what", sa.Text, nullable=False),
        sa.Column("token", sa.Text, nullable=False),
        sa.Column("host", sa.Text, nullable=False),
        sa.Column("process", sa.Text, nullable=False),
        sa.Column("task", sa.Text, nullable=False),
        sa.Column("since", sa.Text, nullable=False),
        sa.Column("expires_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("what", name=op.f("pk_leases")),
        sqlite_strict=True,
    )
    op.create_table(
        "backups",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("snapshot", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("num_bytes", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_backups")),
        sqlite_strict=True,
    )
    op.create_table(
        "purges",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("receipt", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_purges")),
        sqlite_strict=True,
    )
    op.execute("ALTER TABLE revisions ADD COLUMN origin TEXT")


def downgrade() -> None:
    op.execute("ALTER TABLE revisions DROP COLUMN origin")
    for table in ("purges", "backups", "leases"):
        op.drop_table(table)
