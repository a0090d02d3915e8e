"""The first tables.

Written out once and never changed: a later migration starts from what this one made.
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_COMPRESSED = {"bodies": "body", "states": "state"}
_INDICES = {
    "ix_messages_work": ("messages", ["servo", "id"], "done IS NULL AND kind != 'proof'"),
    "ix_messages_proofs": ("messages", ["servo", "id"], "done IS NULL AND kind = 'proof'"),
    "ix_messages_windows": ("messages", ["servo", "id"], "kind = 'window'"),
    "ix_twins_ready": ("twins", ["ready"], "ready IS NOT NULL"),
    "ix_twins_asked": ("twins", ["asked"], "asked IS NOT NULL"),
    "ix_twins_wake": ("twins", ["wake"], "wake IS NOT NULL"),
    "ix_evidence_message": ("evidence", ["message"], None),
    "ix_evidence_version": ("evidence", ["servo", "kind", "version", "id"], None),
}


def upgrade() -> None:
    """Make the tables, then their indices."""
    for make in (_twins, _messages, _evidence, _outgoing):
        make()
    for name, (table, columns, where) in _INDICES.items():
        part = None if where is None else sa.text(where)
        op.create_index(name, table, columns, sqlite_where=part, postgresql_where=part)
    if op.get_bind().dialect.name == "postgresql":
        for table, column in _COMPRESSED.items():
            op.execute(f"ALTER TABLE {table} ALTER COLUMN {column} SET STORAGE EXTERNAL")


def _twins() -> None:
    op.create_table(
        "twins",
        sa.Column("servo", sa.Text, nullable=False),
        *(_count(name) for name in ("serial", "posted", "windows")),
        sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
        *(sa.Column(name, sa.Double) for name in ("ready", "asked", "wake", "heard")),
        sa.Column("lease_owner", sa.Text),
        *(sa.Column(name, sa.Double) for name in ("lease_until", "gap", "std")),
        sa.Column("status", sa.Text, nullable=False, server_default=""),
        sa.Column("version", sa.BigInteger),
        sa.Column("receipt", sa.Text, nullable=False, server_default=""),
        sa.PrimaryKeyConstraint("servo", name="pk_twins"),
    )
    op.create_table(
        "states",
        sa.Column("servo", sa.Text, nullable=False),
        sa.Column("state", sa.LargeBinary, nullable=False),
        sa.PrimaryKeyConstraint("servo", name="pk_states"),
        _of_twin("states"),
    )


def _messages() -> None:
    op.create_table(
        "messages",
        sa.Column("id", _ID, nullable=False),
        *(sa.Column(name, sa.Text, nullable=False) for name in ("servo", "kind", "key", "boot")),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.Column("start", sa.Double, nullable=False),
        sa.Column("encoding", sa.Text, nullable=False),
        sa.Column("digest", sa.LargeBinary, nullable=False),
        sa.Column("received", sa.Double, nullable=False),
        sa.Column("done", sa.Double),
        sa.PrimaryKeyConstraint("id", name="pk_messages"),
        sa.UniqueConstraint("servo", "key", name="uq_messages_servo_key"),
        _of_twin("messages"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "bodies",
        sa.Column("message", _ID, nullable=False, autoincrement=False),
        sa.Column("body", sa.LargeBinary, nullable=False),
        sa.PrimaryKeyConstraint("message", name="pk_bodies"),
        sa.ForeignKeyConstraint(["message"], ["messages.id"], name="fk_bodies_message"),
    )


def _evidence() -> None:
    op.create_table(
        "contexts",
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("text", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("key", name="pk_contexts"),
    )
    op.create_table(
        "evidence",
        sa.Column("id", _ID, nullable=False),
        sa.Column("servo", sa.Text, nullable=False),
        sa.Column("message", _ID),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("version", sa.BigInteger),
        sa.Column("gap", sa.Double),
        sa.Column("std", sa.Double),
        sa.Column("status", sa.Text, nullable=False),
        sa.Column("tail", sa.Double),
        sa.Column("context", sa.Text),
        sa.Column("made", sa.Double, nullable=False),
        sa.Column("body", sa.LargeBinary, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_evidence"),
        _of_twin("evidence"),
        sa.ForeignKeyConstraint(["message"], ["messages.id"], name="fk_evidence_message"),
        sa.ForeignKeyConstraint(["context"], ["contexts.key"], name="fk_evidence_context"),
        sqlite_autoincrement=True,
    )


def _outgoing() -> None:
    op.create_table(
        "outgoing",
        sa.Column("servo", sa.Text, nullable=False),
        sa.Column("serial", sa.BigInteger, nullable=False, autoincrement=False),
        sa.Column("body", sa.LargeBinary, nullable=False),
        sa.Column("made", sa.Double, nullable=False),
        sa.PrimaryKeyConstraint("servo", "serial", name="pk_outgoing"),
        _of_twin("outgoing"),
    )


def _count(name: str) -> sa.Column[int]:
    return sa.Column(name, sa.BigInteger, nullable=False, server_default="0")


def _of_twin(table: str) -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(["servo"], ["twins.servo"], name=f"fk_{table}_servo")
