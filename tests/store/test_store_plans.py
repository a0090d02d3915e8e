"""No query scans a table that grows for years: SQLite's own plans of every statement of the store."""

import re
import sqlite3
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from store_cases import letter, outcome, verification, window

from servotwin.store.clock_gaps import old_messages
from servotwin.store.records import EvidenceRecord, MessageKind
from servotwin.store.retention import delete_old_bodies
from servotwin.store.store import Store, open_store

WAITING = re.compile(r"SCAN messages USING (COVERING )?INDEX ix_messages_(work|verifications)")
COUNTED = "count(*)"
"""What is not yet processed is counted, and is all that these indexes hold."""
SMALL = re.compile(r"SCAN (chosen|set_aside|anon_\d|\(subquery-\d+\)|\d+ CONSTANT ROWS?|CONSTANT ROW)")
"""Results of a query's own parts, each of them limited."""
AT_THE_END = "WHERE twins.lease_owner = ?"
"""What a service that ends gives back: once, over the servos."""


@pytest.fixture
def traced_store(tmp_path: Path) -> tuple[Store, dict[str, Any]]:
    """A store, and every statement that it made."""
    store, statements = open_store(f"sqlite:///{tmp_path}/twin.db"), dict[str, Any]()

    def note(_c: Any, _cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        many = bool(parameters) and isinstance(parameters[0], tuple)
        statements.setdefault(statement, parameters[0] if many else parameters)

    for engine in store.engines.distinct:
        sa.event.listen(engine, "before_cursor_execute", note)
    return store, statements


def exercise(store: Store) -> None:
    """Everything that a service, its operators and its keeping do."""
    sent = [window("a", 1), window("a", 2), window("b", 1), letter("b"), verification("a")]
    store.put(sent)
    store.put([*sent, window("a", 1, b"other")])
    for kinds in ((MessageKind.WINDOW, MessageKind.LETTER), (MessageKind.VERIFICATION,), (MessageKind.LETTER,)):
        for servo in (None, "a"):
            for claim in store.lease("me", 16, 60.0, 100.0, kinds, servo=servo):
                first = claim.messages[0].id
                result = (
                    EvidenceRecord("estimate", first, b"1", version=1, gap=0.1, std=0.01, status="ok", context="c"),
                    EvidenceRecord("update", first, b"2", version=2),
                    EvidenceRecord("receipt", 0, b"3", version=2, status="applied", window="boot/1"),
                )
                made = outcome(claim, *result, outgoing=(b"update",), contexts=(("c", "{}"),), wake=150.0)
                store.write([window("c", first)], [made], 100.0)
    store.lease("me", 16, 60.0, 300.0, newest_first=True)
    store.renew("me", ["a"], 400.0)
    store.hold("c", 400.0)
    store.release("me", ["a"])
    store.release("me")
    store.outgoing("a", 0)
    store.outgoing("a", 99)
    store.posted(["a", "b"])
    store.backlog(200.0)
    store.servos()
    store.servo("a")
    store.window("a", "boot", 1)
    store.windows("a", before=10)
    store.contexts(["c"])
    store.audit("a")
    store.audit("a", since=0.0, before=10)
    store.audit("a", window=("boot", 1))
    store.events("a")
    delete_old_bodies(store, 10**9)
    old_messages(store, 1e9, 1e3)


def plan(path: str, statement: str, parameters: Any) -> list[str]:
    with sqlite3.connect(path) as connection:
        return [row[3] for row in connection.execute(f"EXPLAIN QUERY PLAN {statement}", parameters)]


@pytest.mark.slow
def test_no_statement_scans_a_whole_table(traced_store: tuple[Store, dict[str, Any]]) -> None:
    store, statements = traced_store
    exercise(store)
    path = str(store.engines.writer.url.database)
    explained = {
        statement: plan(path, statement, parameters)
        for statement, parameters in statements.items()
        if statement.startswith(("SELECT", "INSERT", "UPDATE", "DELETE", "WITH")) and not statement.endswith(AT_THE_END)
    }
    store.close()
    assert len(explained) > 30
    walks = {
        statement: step
        for statement, steps in explained.items()
        for step in steps
        if step.startswith("SCAN") and not (SMALL.match(step) or (COUNTED in statement and WAITING.match(step)))
    }
    assert not walks
