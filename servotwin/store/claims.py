"""Claims of edges: the newest run of each servo's edge, and its number, in one row per servo."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import sqlalchemy as sa

from servotwin.store.incoming import insert_once
from servotwin.store.schema import claims, evidence, twins


class StoredClaim(NamedTuple):
    """The newest claim of a servo; run "" and number 0: there is none."""

    run: str
    number: int


NO_CLAIM = StoredClaim("", 0)


def claim_of(connection: sa.Connection, servo: str) -> StoredClaim:
    """Newest claim of a servo."""
    row = connection.execute(sa.select(claims.c.run, claims.c.number).where(claims.c.servo == servo)).one_or_none()
    return NO_CLAIM if row is None else StoredClaim(*row)


def raise_claim(connection: sa.Connection, servo: str, new: StoredClaim, below: int, now: float) -> StoredClaim:
    """Store a claim where the servo's newest has a number below `below`; return the one that counts then."""
    values = {"servo": servo, "run": "", "number": 0, "created": now}
    connection.execute(insert_once(connection.dialect.name, claims), values)
    older = sa.update(claims).where(claims.c.servo == servo, claims.c.number < below)
    connection.execute(older.values(run=new.run, number=new.number, created=now))
    return claim_of(connection, servo)


def add_alarm(connection: sa.Connection, servo: str, sentence: str, now: float) -> None:
    """Store an alarm about a servo's edge as evidence without a window."""
    connection.execute(insert_once(connection.dialect.name, twins), {"servo": servo})
    body = msgspec.msgpack.encode({"sentence": sentence})
    row = {"servo": servo, "kind": "alarm", "status": sentence, "created": now, "body": body}
    connection.execute(sa.insert(evidence), row)
