"""Outcomes into the tables, each as a whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servotwin.store.address import SQLITE
from servotwin.store.putting import insert_once, named, of_names, put
from servotwin.store.rows import Evidence, Kind, Outcome
from servotwin.store.schema import PROOFS, WORK, contexts, evidence, messages, outgoing, states, twins

_ESTIMATES = ("glance", "estimate")


def commit(connection: sa.Connection, outcomes: Sequence[Outcome], now: float) -> list[bool]:
    """Write those whose serial is still the servo's; whether each was.

    The comparison with the serial makes an effect exactly once, whoever holds the lease: of two workers that had the
    same servo the first to commit wins, and what the other made is void.
    """
    valid = _valid(connection, outcomes)
    if valid:
        _write(connection, [(outcomes[i], last) for i, last in valid.items()], now)
    return [i in valid for i in range(len(outcomes))]


def _valid(connection: sa.Connection, outcomes: Sequence[Outcome]) -> dict[int, int]:
    """Of those that count, in the servos' order, the serial of the last message to the edge. Locks them."""
    if not outcomes:
        return {}
    servos = sorted({outcome.servo for outcome in outcomes})
    rows = connection.execute(_holding(connection.dialect.name), {"_servos": servos})
    held = {row.servo: (row.serial, row.posted) for row in rows}
    valid: dict[int, int] = {}
    for i in sorted(range(len(outcomes)), key=lambda i: outcomes[i].servo):
        serial, posted = held.get(outcomes[i].servo, (None, 0))
        if outcomes[i].serial == serial:
            valid[i] = posted + len(outcomes[i].outgoing)
            held[outcomes[i].servo] = serial + 1, valid[i]
    return valid


def pass_over(connection: sa.Connection, servo: str, serial: int) -> None:
    """Let the next message to the edge have a higher serial than that."""
    behind = twins.c.servo == servo, twins.c.posted < serial
    connection.execute(sa.update(twins).where(*behind).values(posted=serial))


def _write(connection: sa.Connection, valid: Sequence[tuple[Outcome, int]], now: float) -> None:
    outcomes = [outcome for outcome, _ in valid]
    _raise(connection, valid)
    _states(connection, outcomes)
    _done(connection, outcomes, now)
    known = {key: text for outcome in outcomes for key, text in outcome.contexts}
    _many(
        connection,
        insert_once(connection.dialect.name, contexts),
        ({"key": key, "text": text} for key, text in sorted(known.items())),
    )
    found = [(outcome.servo, one) for outcome in outcomes for one in outcome.evidence]
    windows = _windows(connection, found)
    _many(connection, sa.insert(evidence), (_found(servo, one, windows, now) for servo, one in found))
    _many(connection, sa.insert(outgoing), (row for outcome, last in valid for row in _posts(outcome, last, now)))
    put(connection, [item for outcome in outcomes for item in outcome.enqueue])
    connection.execute(_RECKON, {"_servos": sorted({outcome.servo for outcome in outcomes})})


def _raise(connection: sa.Connection, valid: Sequence[tuple[Outcome, int]]) -> None:
    """Raise the servos' serials, end their leases, and note what is newest of them; one statement for all in a row
    that tell of the same."""
    rows = [(_summary(outcome.evidence), outcome, last) for outcome, last in valid]
    for names, alike in groupby(rows, lambda row: tuple(sorted(row[0]))):
        bound = [
            {f"_{name}": value for name, value in known.items()}
            | {"_servo": outcome.servo, "_serial": outcome.serial + 1, "_posted": last, "_wake": outcome.wake}
            for known, outcome, last in alike
        ]
        connection.execute(_raising(names), bound)


def _states(connection: sa.Connection, outcomes: Sequence[Outcome]) -> None:
    rows = [{"servo": outcome.servo, "state": outcome.state} for outcome in outcomes]
    connection.execute(_replacing(connection.dialect.name), rows)


def _done(connection: sa.Connection, outcomes: Sequence[Outcome], now: float) -> None:
    rows = [
        {"_servo": outcome.servo, "_id": message, "_now": now}
        for outcome in outcomes
        for message in dict.fromkeys(outcome.done)
    ]
    if rows and connection.execute(_DONE, rows).rowcount != len(rows):
        servos = ", ".join(sorted({outcome.servo for outcome in outcomes}))
        raise ValueError(f"outcome of {servos}: covers a message that is not an unprocessed one of its own")


def _many(connection: sa.Connection, statement: Any, rows: Iterable[dict[str, Any]]) -> None:
    found = list(rows)
    if found:
        connection.execute(statement, found)


def _windows(connection: sa.Connection, found: Sequence[tuple[str, Evidence]]) -> dict[tuple[str, str], int]:
    """Ids of the windows that evidence names."""
    rows = named(connection, _NAMED, {(servo, one.window) for servo, one in found if one.window})
    return {(row.servo, row.key): row.id for row in rows if row.kind == Kind.WINDOW}


def _found(servo: str, found: Evidence, windows: Mapping[tuple[str, str], int], now: float) -> dict[str, Any]:
    row = found._asdict()
    message = windows.get((servo, row.pop("window")), found.message)
    return row | {"message": message or None, "context": found.context or None, "servo": servo, "made": now}


def _posts(outcome: Outcome, last: int, now: float) -> list[dict[str, Any]]:
    first = last - len(outcome.outgoing) + 1
    return [
        {"servo": outcome.servo, "serial": first + i, "body": body, "made": now}
        for i, body in enumerate(outcome.outgoing)
    ]


def _summary(found: Sequence[Evidence]) -> dict[str, Any]:
    """What the servo's row says of the newest estimate, update and receipt, where there is a new one."""
    known: dict[str, Any] = {}
    for one in found:
        if one.kind in _ESTIMATES:
            known |= {"gap": one.gap, "std": one.std, "status": one.status}
        elif one.kind == "update":
            known["version"] = one.version
        elif one.kind == "receipt":
            known["receipt"] = one.status
    return known


_NAMED = of_names(messages.c.id, messages.c.kind)

_DONE = (
    sa.update(messages)
    .where(messages.c.id == sa.bindparam("_id"), messages.c.servo == sa.bindparam("_servo"), messages.c.done.is_(None))
    .values(done=sa.bindparam("_now", type_=sa.Double))
)


@lru_cache(maxsize=2)
def _holding(dialect: str) -> sa.Select[Any]:
    """Serials of servos that are locked one after the other, in the order in which `put` does it: by code points,
    whatever the database's language says. The lock lets other messages of the servo refer to it."""
    order = twins.c.servo if dialect == SQLITE else twins.c.servo.collate("C")
    servos: sa.BindParameter[Any] = sa.bindparam("_servos", expanding=True)
    query = sa.select(twins.c.servo, twins.c.serial, twins.c.posted).where(twins.c.servo.in_(servos))
    return query.order_by(order).with_for_update(key_share=True)


@lru_cache(maxsize=32)
def _raising(names: tuple[str, ...]) -> sa.Update:
    """A servo's next serial, with what is new of these columns."""
    new = {name: sa.bindparam(f"_{name}", type_=twins.c[name].type) for name in ("serial", "posted", "wake", *names)}
    values = {"attempts": 0, "lease_owner": None, "lease_until": None} | new
    return sa.update(twins).where(twins.c.servo == sa.bindparam("_servo")).values(values)


@lru_cache(maxsize=2)
def _replacing(dialect: str) -> Any:
    """A servo's state, whether it had one or not."""
    new = (sqlite.insert if dialect == SQLITE else postgresql.insert)(states)
    return new.on_conflict_do_update(index_elements=[states.c.servo], set_={"state": new.excluded.state})


def _first(queue: sa.ColumnElement[bool]) -> sa.ScalarSelect[Any]:
    oldest = sa.select(messages.c.received).where(queue, messages.c.servo == twins.c.servo)
    return oldest.order_by(messages.c.id).limit(1).correlate(twins).scalar_subquery()


# A statement of its own after the serials were raised: on PostgreSQL those rows are locked then, and what was put
# before that is seen here, what is put after it waits and says so itself.
_RECKON = (
    sa.update(twins)
    .where(twins.c.servo.in_(sa.bindparam("_servos", expanding=True)))
    .values(ready=_first(WORK), asked=_first(PROOFS))
)
