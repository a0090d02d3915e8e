"""Tables. Bodies and states are in tables of their own, so that the rows that queries scan stay small."""

from __future__ import annotations

import sqlalchemy as sa

from servotwin.store.records import MessageKind
from servotwin.store.stored_value import OWNER, TIME, Content, check_values

REVISION = "0005"
"""Newest migration, which makes the tables below."""

metadata = sa.MetaData(
    naming_convention={
        "pk": "pk_%(table_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
    }
)
# SQLite numbers rows by itself only for an INTEGER key.
_Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

twins = sa.Table(
    "twins",
    metadata,
    sa.Column("servo", sa.Text, primary_key=True),
    sa.Column("serial", sa.BigInteger, nullable=False, server_default="0"),
    sa.Column("posted", sa.BigInteger, nullable=False, server_default="0"),
    sa.Column("windows", sa.BigInteger, nullable=False, server_default="0"),
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
    # Place in the queues: time at which the oldest verification, or the oldest window or letter since the servo's last
    # turn, was received; of a backlog alone, a later time (results.BACKLOG_LATER_S); null: nothing waits.
    sa.Column("ready", sa.Double),
    sa.Column("verification_ready", sa.Double),
    # Time at which a window was first deferred, since which the servo waits for an estimate; null: it does not.
    sa.Column("estimate_ready", sa.Double),
    sa.Column("wake", sa.Double),
    sa.Column("last_message", sa.Double),
    sa.Column("lease_owner", sa.Text),
    sa.Column("lease_until", sa.Double),
    sa.Column("gap", sa.Double),
    sa.Column("std", sa.Double),
    sa.Column("status", sa.Text, nullable=False, server_default=""),
    sa.Column("version", sa.BigInteger),
    sa.Column("receipt", sa.Text, nullable=False, server_default=""),
)

states = sa.Table(
    "states",
    metadata,
    sa.Column("servo", sa.Text, sa.ForeignKey(twins.c.servo), primary_key=True),
    sa.Column("state", sa.LargeBinary, nullable=False),
)

messages = sa.Table(
    "messages",
    metadata,
    sa.Column("id", _Id, primary_key=True),
    sa.Column("servo", sa.Text, sa.ForeignKey(twins.c.servo), nullable=False),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("boot", sa.Text, nullable=False),
    sa.Column("sequence", sa.BigInteger, nullable=False),
    sa.Column("start", sa.Double, nullable=False),
    sa.Column("encoding", sa.Text, nullable=False),
    sa.Column("digest", sa.LargeBinary, nullable=False),
    sa.Column("received", sa.Double, nullable=False),
    sa.Column("done", sa.Double),
    sa.UniqueConstraint("servo", "key"),
    sqlite_autoincrement=True,
)

bodies = sa.Table(
    "bodies",
    metadata,
    sa.Column("message", _Id, sa.ForeignKey(messages.c.id), primary_key=True, autoincrement=False),
    sa.Column("body", sa.LargeBinary, nullable=False),
    info={OWNER: "(SELECT messages.servo FROM messages WHERE messages.id = message)"},
)

contexts = sa.Table(
    "contexts",
    metadata,
    sa.Column("key", sa.Text, primary_key=True),
    sa.Column("text", sa.Text, nullable=False),
)

evidence = sa.Table(
    "evidence",
    metadata,
    sa.Column("id", _Id, primary_key=True),
    sa.Column("servo", sa.Text, sa.ForeignKey(twins.c.servo), nullable=False),
    sa.Column("message", _Id, sa.ForeignKey(messages.c.id)),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("version", sa.BigInteger),
    sa.Column("gap", sa.Double),
    sa.Column("std", sa.Double),
    sa.Column("status", sa.Text, nullable=False),
    sa.Column("tail", sa.Double),
    sa.Column("context", sa.Text, sa.ForeignKey(contexts.c.key)),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("body", sa.LargeBinary, nullable=False),
    sqlite_autoincrement=True,
)

outgoing = sa.Table(
    "outgoing",
    metadata,
    sa.Column("servo", sa.Text, sa.ForeignKey(twins.c.servo), primary_key=True),
    sa.Column("serial", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("body", sa.LargeBinary, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
)

# Not tied to `twins`: an edge claims its servo before its first message.
claims = sa.Table(
    "claims",
    metadata,
    sa.Column("servo", sa.Text, primary_key=True),
    sa.Column("run", sa.Text, nullable=False),
    sa.Column("number", sa.BigInteger, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
)

# Not tied to `twins` either: whoever puts a servo's record right may delete all of it. `message`: 0, or that whose body
# is damaged.
set_aside = sa.Table(
    "set_aside",
    metadata,
    sa.Column("servo", sa.Text, primary_key=True),
    sa.Column("clause", sa.Text, nullable=False),
    sa.Column("message", sa.BigInteger, nullable=False),
)

# Literals, not parameters: a planner uses a partial index only where a query repeats its condition word for word.
_VERIFICATION: sa.ColumnElement[str] = sa.literal_column("'verification'")
_WINDOW: sa.ColumnElement[str] = sa.literal_column("'window'")
WORK = sa.and_(messages.c.done.is_(None), messages.c.kind != _VERIFICATION)
VERIFICATIONS = sa.and_(messages.c.done.is_(None), messages.c.kind == _VERIFICATION)
WINDOWS = messages.c.kind == _WINDOW


def _index(name: str, *columns: sa.Column[object], where: sa.ColumnElement[bool] | None = None) -> None:
    sa.Index(name, *columns, sqlite_where=where, postgresql_where=where)


_index("ix_messages_work", messages.c.servo, messages.c.id, where=WORK)
_index("ix_messages_verifications", messages.c.servo, messages.c.id, where=VERIFICATIONS)
_index("ix_messages_windows", messages.c.servo, messages.c.id, where=WINDOWS)
_index("ix_twins_ready", twins.c.ready, where=twins.c.ready.is_not(None))
_index("ix_twins_verification_ready", twins.c.verification_ready, where=twins.c.verification_ready.is_not(None))
_index("ix_twins_estimate_ready", twins.c.estimate_ready, where=twins.c.estimate_ready.is_not(None))
_index("ix_twins_wake", twins.c.wake, where=twins.c.wake.is_not(None))
_index("ix_evidence_message", evidence.c.message)
_index("ix_evidence_version", evidence.c.servo, evidence.c.kind, evidence.c.version, evidence.c.id)

_TIMES = (
    "ready", "verification_ready", "estimate_ready", "wake", "last_message", "lease_until", "received", "done",
    "created",
)  # fmt: skip
_KINDS = Content(f"one of {', '.join(MessageKind)}", texts=tuple(kind.value for kind in MessageKind))
check_values(metadata, dict.fromkeys(_TIMES, TIME) | {"messages.kind": _KINDS})
