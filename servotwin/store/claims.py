"""Claims of edges: the newest run of each servo's edge, and its number, in one row per servo."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import msgspec
import sqlalchemy as sa

from servotwin.store.incoming import insert_once
from servotwin.store.schema import claims, evidence, twins


class StoredClaim(NamedTuple):
    """The newest claim of a servo; run "" and number 0: there is none."""

    run: str
    number: int


NO_CLAIM = StoredClaim("", 0)
LOST_ANSWERS = (
    "Versions that were sent since, and the edge's answers to them, are missing in this record; the edge is asked for "
    "the windows that it keeps"
)
"""Sentence for the record of a servo whose store was put back."""


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


def add_alarm(connection: sa.Connection, servos: Collection[str], sentence: str, now: float) -> None:
    """Store an alarm about each of some servos as evidence without a window."""
    if servos:
        connection.execute(insert_once(connection.dialect.name, twins), [{"servo": servo} for servo in sorted(servos)])
        connection.execute(sa.insert(evidence), [alarm_row(servo, sentence, now) for servo in sorted(servos)])


def alarm_row(servo: str, sentence: str, now: float) -> dict[str, Any]:
    """Row of the evidence for an alarm."""
    body = msgspec.msgpack.encode({"sentence": sentence})
    return {"servo": servo, "kind": "alarm", "status": sentence, "created": now, "body": body}
