"""Servos of which rows are damaged, and which no twin serves until these are right."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Make the table; without a row a servo is served."""
    op.create_table(
        "set_aside",
        sa.Column("servo", sa.Text, nullable=False),
        sa.Column("clause", sa.Text, nullable=False),
        sa.Column("message", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("servo", name="pk_set_aside"),
    )
