"""Statements of a transaction: their number, each of which is a round trip on PostgreSQL, and the binding of rows."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import sqlalchemy as sa
from store_cases import letter, outcome, window

from servotwin.store.records import EvidenceRecord, Lease, WorkResult
from servotwin.store.row_statement import RowStatement
from servotwin.store.schema import twins
from servotwin.store.store import Store

pytest_plugins = ("store_fixtures",)

MANY = 16
WRITE, LEASE = 11, 6
"""Statements of messages with results, and of a lease, whatever the number of servos."""


@contextmanager
def counted(store: Store) -> Iterator[list[str]]:
    """Statements that a store makes within the block, without those that begin a transaction."""
    made: list[str] = []

    def note(_c: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if not statement.startswith("BEGIN"):
            made.append(statement)

    engines = store.engines.distinct
    for engine in engines:
        sa.event.listen(engine, "before_cursor_execute", note)
    try:
        yield made
    finally:
        for engine in engines:
            sa.event.remove(engine, "before_cursor_execute", note)


def leased(store: Store) -> list[Lease]:
    return store.lease("me", MANY, 60.0, 100.0, newest_first=True)


def glanced(lease: Lease) -> WorkResult:
    seen = EvidenceRecord("glance", lease.messages[0].id, b"1", version=1, gap=0.1, std=0.01, context="c")
    return outcome(lease, seen, contexts=(("c", "{}"),))


@pytest.mark.parametrize("servos", [1, MANY])
def test_windows_and_results_take_eleven_statements_for_one_servo_and_for_many(store: Store, servos: int) -> None:
    names = [f"s{n:02d}" for n in range(servos)]
    store.put([window(name, 1) for name in names])
    made = [glanced(lease) for lease in leased(store)]
    with counted(store) as statements:
        new, valid = store.write([window(name, 2) for name in names], made, 100.0)
    assert valid == [True] * servos
    assert new == ["new"] * servos
    assert len(statements) <= WRITE, statements


@pytest.mark.parametrize("servos", [1, MANY])
def test_a_lease_takes_few_statements_for_one_servo_and_for_many(store: Store, servos: int) -> None:
    names = [f"s{n:02d}" for n in range(servos)]
    store.put([window(name, n) for name in names for n in (1, 2)] + [letter(name) for name in names])
    with counted(store) as statements:
        leases = leased(store)
    assert [len(lease.messages) for lease in leases] == [3] * servos
    assert len(statements) <= LEASE, statements


def test_a_lease_of_a_single_servo_takes_as_few_statements(store: Store) -> None:
    store.put([window("a", 1), window("b", 1)])
    with counted(store) as statements:
        (lease,) = store.lease("me", 1, 60.0, 200.0, newest_first=True)
    assert len(lease.messages) == 1
    assert len(statements) <= LEASE, statements


def test_a_statement_is_bound_to_rows_by_their_names(store: Store) -> None:
    store.put([window("a", 1), window("b", 1)])
    named = RowStatement(
        lambda _: sa.update(twins).where(twins.c.servo == sa.bindparam("_servo")).values(
            status=sa.bindparam("_status"), attempts=7, gap=None
        )
    )  # fmt: skip
    rows = [{"_status": "first", "_servo": "a"}, {"_servo": "b", "_status": "second"}, {"_servo": "c", "_status": ""}]
    with store.writing() as connection:
        assert named.run(connection, rows) == 2
        found = connection.execute(sa.select(twins.c.status, twins.c.attempts, twins.c.gap).order_by(twins.c.servo))
        assert [tuple(row) for row in found] == [("first", 7, None), ("second", 7, None)]


def test_no_rows_are_no_statement(store: Store) -> None:
    def refuse(_dialect: str) -> sa.Update:
        raise AssertionError("compiled for nothing")

    with counted(store) as statements, store.writing() as connection:
        assert RowStatement(refuse).run(connection, []) == 0
    assert [statement for statement in statements if "set_aside" not in statement] == []
