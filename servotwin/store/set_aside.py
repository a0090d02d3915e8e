"""Servos that are set aside, as rows of theirs are damaged; noted in the database, for all twins and their restarts."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import sqlalchemy as sa

from servotwin.store.incoming import insert_once
from servotwin.store.schema import set_aside
from servotwin.store.stored_value import WrongRow


def without(query: sa.Select[Any], servo: sa.ColumnElement[str], aside: Collection[str]) -> sa.Select[Any]:
    """Leave out the rows of servos that are set aside; most often there are none, and the query stays as it is."""
    return query.where(servo.not_in(sorted(aside))) if aside else query


def noted(connection: sa.Connection) -> Mapping[str, WrongRow]:
    """Servos that are set aside, each with a wrong row of its own."""
    return {row.servo: WrongRow(row.servo, row.clause, row.message) for row in connection.execute(_NOTED)}


def note(connection: sa.Connection, wrong: Iterable[WrongRow]) -> None:
    """Note servos by wrong rows of theirs; the later row of a servo takes the place of the one before."""
    for row in sorted(wrong):  # in one order, as another twin may find and note the same
        connection.execute(sa.update(set_aside).where(set_aside.c.servo == row.servo).values(row._asdict()))
        connection.execute(insert_once(connection.dialect.name, set_aside), row._asdict())


def strike(connection: sa.Connection, wrong: WrongRow) -> None:
    """Strike a servo out, unless another row of it was found wrong meanwhile."""
    same = set_aside.c.servo == wrong.servo, set_aside.c.clause == wrong.clause
    connection.execute(sa.delete(set_aside).where(*same))


_NOTED = sa.select(set_aside.c.servo, set_aside.c.clause, set_aside.c.message)
