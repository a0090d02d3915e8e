"""Queue of the servos that wait for an estimate of a window that was glanced at."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add the column and its index; no servo waits in a store that is migrated."""
    op.add_column("twins", sa.Column("estimate_ready", sa.Double))
    part = sa.text("estimate_ready IS NOT NULL")
    op.create_index("ix_twins_estimate_ready", "twins", ["estimate_ready"], sqlite_where=part, postgresql_where=part)
