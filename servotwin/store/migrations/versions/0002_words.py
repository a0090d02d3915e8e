"""Names of columns, kinds and indices as everywhere else: a verification was called "proof" here."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

_COLUMNS = (
    ("twins", "asked", "verification_ready"),
    ("twins", "heard", "last_message"),
    ("evidence", "made", "created"),
    ("outgoing", "made", "created"),
)
_DROPPED = {"messages": ("ix_messages_work", "ix_messages_proofs"), "twins": ("ix_twins_asked",)}
_INDICES = {
    "ix_messages_work": ("messages", ["servo", "id"], "done IS NULL AND kind != 'verification'"),
    "ix_messages_verifications": ("messages", ["servo", "id"], "done IS NULL AND kind = 'verification'"),
    "ix_twins_verification_ready": ("twins", ["verification_ready"], "verification_ready IS NOT NULL"),
}


def upgrade() -> None:
    """Rename, between the old indices and the new ones."""
    for table, names in _DROPPED.items():
        for name in names:
            op.drop_index(name, table)
    for table, old, new in _COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {old} TO {new}")
    for table in ("messages", "evidence"):
        op.execute(f"UPDATE {table} SET kind = 'verification' WHERE kind = 'proof'")
    for name, (table, columns, where) in _INDICES.items():
        part = sa.text(where)
        op.create_index(name, table, columns, sqlite_where=part, postgresql_where=part)
