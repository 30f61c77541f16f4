"""How a scene is kept that newer ones supersede."""

from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute("ALTER TABLE scenes ADD COLUMN thinned TEXT")


def downgrade() -> None:
    op.execute("ALTER TABLE scenes DROP COLUMN thinned")
