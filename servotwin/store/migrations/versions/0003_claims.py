"""Claims of edges: which run of a servo's edge is its only one."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Make the table; without a row a servo has no claim yet."""
    op.create_table(
        "claims",
        sa.Column("servo", sa.Text, nullable=False),
        sa.Column("run", sa.Text, nullable=False),
        sa.Column("number", sa.BigInteger, nullable=False),
        sa.Column("created", sa.Double, nullable=False),
        sa.PrimaryKeyConstraint("servo", name="pk_claims"),
    )
