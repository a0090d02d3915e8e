"""Tables, rows and rights that are gone from a PostgreSQL store."""

import math
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from typing import Any

import postgres
import psycopg
import pytest
import sqlalchemy as sa
import waiting
from relay import Relay, State
from store_cases import claim, outcome, postgresql_addresses, window
from waiting import until

from servotwin.errors import InvalidInput
from servotwin.store import engine
from servotwin.store.engine import StoreDamaged, StoreUnavailable, parse_address
from servotwin.store.integrity import check_pages
from servotwin.store.records import EvidenceRecord, PutResult
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)

TRIGGER = """
CREATE FUNCTION no() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN RAISE EXCEPTION 'not today'; END $$;
CREATE TRIGGER no BEFORE INSERT ON messages FOR EACH ROW EXECUTE FUNCTION no()
"""


@pytest.fixture
def filled(postgres_server: postgres.Server) -> Iterator[Store]:
    """Three windows, and what followed from them."""
    store = open_store(postgresql_addresses(postgres_server)())
    store.put([window(sequence=n) for n in range(3)])
    [lease] = claim(store)
    evidence = [EvidenceRecord("estimate", each.id, b"evidence") for each in lease.messages]
    assert store.commit([outcome(lease, *evidence, outgoing=(b"update",))], 300.0) == [True]
    yield store
    store.close()


def run(store: Store, *statements: str) -> None:
    with store.engines.writer.begin() as connection:
        for statement in statements:
            connection.execute(sa.text(statement))


@pytest.mark.slow
def test_a_table_that_somebody_locks_is_not_waited_for_without_end(
    postgres_server: postgres.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "_BUSY_S", 2.0)
    address = postgresql_addresses(postgres_server)()
    with closing(open_store(address)) as store:
        # A session of somebody else: one of a twin that does nothing in a transaction is ended sooner.
        name = str(store.engines.writer.url.database)
        with postgres_server.connect(name) as connection, connection.transaction():
            connection.execute("LOCK TABLE messages IN ACCESS EXCLUSIVE MODE")
            with pytest.raises(
                StoreUnavailable, match=r"not available now \(canceling statement due to lock timeout\)"
            ):
                store.put([window()])
        assert store.put([window()]) == [PutResult.NEW]


def test_a_call_whose_answer_a_proxy_has_swallowed_ends_when_connections_are_cut(
    postgres_server: postgres.Server,
) -> None:
    name = parse_address(postgresql_addresses(postgres_server)()).database
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(1))
        relay = stack.enter_context(Relay(postgres_server.folder / ".s.PGSQL.5432"))
        address = f"postgresql://{postgres_server.user}@127.0.0.1:{relay.port}/{name}"
        store = stack.enter_context(closing(open_store(address)))
        assert store.put([window()]) == [PutResult.NEW]
        relay.become(State.HALF_OPEN)
        lost = pool.submit(store.put, [window(sequence=5)])
        until(lambda: relay.counts["swallowed"])
        relay.become(State.FLOWING)
        store.engines.opened.cut()
        with pytest.raises(StoreUnavailable):
            lost.result(waiting.PATIENCE)
        assert store.put([window(sequence=5)]) == [PutResult.NEW]


@pytest.mark.parametrize("given", ["", "&connect_timeout=3"])
def test_a_server_that_does_not_answer_is_not_waited_for_without_end(
    postgres_server: postgres.Server, given: str
) -> None:
    with (
        closing(open_store(postgresql_addresses(postgres_server)() + given)) as store,
        store.engines.reader.connect() as c,
    ):
        used = c.connection.driver_connection.info.get_parameters()
        assert (used["connect_timeout"], used["tcp_user_timeout"]) == ("3" if given else "10", "25000")


def test_a_sound_store_is_read_whole(filled: Store) -> None:
    assert check_pages(filled, math.inf)[:2] == ((), True)


@pytest.mark.parametrize(
    ("lost", "fault"),
    [
        ("messages WHERE sequence = 1", "table messages: 1 rows of table bodies refer to rows that are gone"),
        ("twins", "table twins: 3 rows of table messages refer to rows that are gone"),
    ],
)
def test_rows_that_are_gone_with_their_page_are_missed(filled: Store, lost: str, fault: str) -> None:
    # As superuser: without its triggers the server does not notice, as where a page was overwritten with zeros.
    run(filled, "SET session_replication_role = replica", f"DELETE FROM {lost}")
    assert fault in check_pages(filled, math.inf).faults


def test_an_index_that_does_not_have_the_rows_of_its_table_is_found(filled: Store) -> None:
    # As superuser: the server does not enter the row, as where a page of the index, or of the table, is lost.
    entered = "UPDATE pg_index SET indisready = {} WHERE indexrelid = 'ix_evidence_message'::regclass"
    run(filled, entered.format("false"))
    run(
        filled, "INSERT INTO evidence (servo, message, kind, status, created, body) VALUES ('a', 1, 'trend', '', 0, '')"
    )
    run(filled, entered.format("true"))
    expected = "table evidence: 4 rows, and 3 in its index ix_evidence_message"
    assert check_pages(filled, math.inf).faults == (expected,)


def crash(server: postgres.Server, name: str) -> None:
    """Have the server begin with empty buffers, as after a crash of one of its processes."""
    with server.connect(name) as idle:
        with server.connect(name) as victim:
            os.kill(victim.info.backend_pid, signal.SIGKILL)
        until(lambda: is_cut(idle))
    until(server.answers)


def is_cut(connection: psycopg.Connection[Any]) -> bool:
    try:
        connection.execute("SELECT 1")
    except psycopg.OperationalError:
        return True
    return False


@pytest.mark.slow
def test_every_page_of_zeros_in_an_index_is_found_above_its_leaves_too() -> None:
    with postgres.running() as server:
        address = server.database("wide")
        open_store(address).close()
        server.run("wide", "INSERT INTO twins (servo) VALUES ('a'); "
            "INSERT INTO messages (servo, kind, key, boot, sequence, start, encoding, digest, received) "
            "SELECT 'a', 'window', repeat('b', 400) || lpad(g::text, 8, '0'), 'b', g, 0, '', '', 0 "
            "FROM generate_series(1, 3000) g; "
            "INSERT INTO bodies SELECT id, '' FROM messages; CREATE EXTENSION pageinspect; CHECKPOINT")  # fmt: skip
        with server.connect("wide") as connection:
            above = connection.execute(
                "SELECT page FROM generate_series(1, pg_relation_size('uq_messages_servo_key') / 8192 - 1) AS page, "
                "LATERAL bt_page_stats('uq_messages_servo_key', page) AS stats WHERE type IN ('i', 'r') ORDER BY page"
            ).fetchall()
            place = connection.execute("SELECT pg_relation_filepath('uq_messages_servo_key')").fetchone()
        assert len(above) > 3
        assert place is not None
        file = server.folder / "data" / place[0]
        whole = file.read_bytes()
        for (page,) in above:
            with file.open("r+b") as index:
                index.seek(8192 * page)
                index.write(bytes(8192))
            crash(server, "wide")
            with closing(open_store(address)) as store:
                [fault] = check_pages(store, math.inf).faults
            assert f"contains unexpected zero page at block {page}" in fault
            with file.open("r+b") as index:
                index.write(whole)


@pytest.mark.slow
def test_a_check_of_tables_ends_in_time_and_says_so(filled: Store) -> None:
    run(filled, "INSERT INTO evidence (servo, kind, status, created, body) "
        "SELECT 'a', 'trend', '', 0, '' FROM generate_series(1, 300000)")  # fmt: skip
    assert check_pages(filled, 0.0)[:2] == ((), False)


@pytest.mark.slow
def test_rows_with_null_in_an_index_are_sought_as_fast_as_others(filled: Store) -> None:
    """Nearly all evidence has no version; 0.9 s, and 100 s where each of these rows is compared with all others."""
    run(filled, "INSERT INTO evidence (servo, kind, status, created, body) "
        "SELECT 'a', 'trend', '', 0, '' FROM generate_series(1, 200000)")  # fmt: skip
    assert check_pages(filled, 30.0)[:2] == ((), True)


def test_a_table_that_is_gone_is_damage(filled: Store) -> None:
    run(filled, "DROP TABLE outgoing")
    assert check_pages(filled, math.inf).faults == ("table outgoing: is missing",)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("twins SET last_message = 'NaN'", "column twins.last_message holds nan where a time, "),
        ("messages SET sequence = -1", "column messages.sequence holds -1 where a count up to 2**53 belongs"),
        ("messages SET kind = '{'", "column messages.kind holds '{' where one of window, letter, act, verification "),
    ],
)
def test_a_value_that_cannot_be_is_damage_with_its_row(filled: Store, change: str, why: str) -> None:
    run(filled, f"UPDATE {change}")
    (fault,) = check_pages(filled, math.inf).faults
    assert fault.startswith(why)
    assert ", in the row of " in fault


@pytest.mark.parametrize(
    ("column", "kind", "made"),
    [("messages.received", "text", "double precision"), ("messages.sequence", "text", "bigint")],
)
def test_a_column_of_another_type_is_damage(filled: Store, column: str, kind: str, made: str) -> None:
    """Workers ended one after the other, and a task of the service did, since a time was a text."""
    table, name = column.split(".")
    run(filled, f"ALTER TABLE {table} ALTER {name} TYPE {kind} USING {name}::{kind}")
    filled.engines.dispose()
    assert check_pages(filled, math.inf).faults == (f"column {column} is of type {kind}, and was made as {made}",)
    with pytest.raises(StoreDamaged, match=f"column {column} holds a text where a (whole )?number belongs"):
        filled.audit("a")


@pytest.mark.parametrize(
    "statement",
    [
        "ALTER TABLE messages ALTER key TYPE bytea USING key::bytea",
        "ALTER SEQUENCE messages_id_seq MAXVALUE 3",
        TRIGGER,
    ],
)
def test_a_table_that_takes_no_more_rows_makes_a_store_not_available(filled: Store, statement: str) -> None:
    run(filled, statement)
    filled.engines.dispose()
    with pytest.raises(StoreUnavailable, match="not available now"):
        filled.put([window(sequence=9)])


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("ALTER TABLE messages RENAME TO other", 'relation "messages" does not exist'),
        ("ALTER TABLE messages RENAME COLUMN encoding TO other", "encoding"),
    ],
)
def test_a_store_that_is_not_as_it_was_made_is_not_available(filled: Store, statement: str, reason: str) -> None:
    run(filled, statement)
    for use in (lambda: filled.put([window(sequence=9)]), lambda: filled.window("a", "boot", 0)):
        with pytest.raises(StoreUnavailable, match="not available now") as error:
            use()
        assert reason in str(error.value)
        assert "\n" not in str(error.value)


def test_a_right_that_was_taken_away_makes_a_store_not_available(
    filled: Store, postgres_server: postgres.Server
) -> None:
    name = str(filled.engines.writer.url.database)
    run(filled, "CREATE ROLE reader LOGIN", "GRANT SELECT ON servotwin_version TO reader")
    try:
        other = open_store(f"postgresql://reader@/{name}?host={postgres_server.folder}")
        with pytest.raises(StoreUnavailable, match="permission denied for table twins"):
            other.servos()
        other.close()
    finally:
        run(filled, "DROP OWNED BY reader", "DROP ROLE reader")


def test_an_address_with_an_unknown_option_is_one_sentence(postgres_server: postgres.Server) -> None:
    address = postgresql_addresses(postgres_server)()
    with pytest.raises(InvalidInput, match='invalid connection option "colour"') as refused:
        open_store(f"{address}&colour=red")
    assert "\n" not in str(refused.value)
