"""Servos of which rows are damaged: found to be these alone, left out by all who read or write the rows of all."""

import math
from contextlib import closing

import pytest
import sqlalchemy as sa
from store_cases import claim, letter, outcome, verification, window

from servotwin.store import overview
from servotwin.store.claims import StoredClaim
from servotwin.store.clock_gaps import newest_receipt, old_messages
from servotwin.store.engine import ServoSetAside, StoreDamaged, StoreUnavailable
from servotwin.store.integrity import (
    check_all,
    check_bodies,
    check_pages,
    fault_of_servo,
    message_digest,
    missing_windows,
    newest_message,
)
from servotwin.store.records import EvidenceRecord
from servotwin.store.retention import delete_old_bodies
from servotwin.store.schema import metadata
from servotwin.store.store import Store, open_store
from servotwin.store.stored_value import WrongRow

pytest_plugins = ("store_fixtures",)

FLEET = ("ax-0", "ax-1", "ax-2", "ax-3")
HIT = FLEET[0]
SHARED = ("twins.servo", "messages.id", "messages.servo", "bodies.message", "evidence.id", "outgoing.serial")
NUMBERS = ("twins.serial", "twins.ready", "twins.wake", "messages.received", "messages.sequence", "evidence.created",
           "outgoing.created", "claims.number")  # fmt: skip
OWN = sorted(
    f"{table.name}.{column.name}"
    for table in metadata.tables.values()
    if table.name not in ("contexts", "set_aside")
    for column in table.columns
    if not column.primary_key and not column.foreign_keys and column.name != "servo"
)
"""Columns with values of one servo alone, all of them."""


def digested(servo: str, sequence: int) -> object:
    plain = window(servo, sequence, b"%d" % sequence)
    return plain._replace(digest=message_digest(plain.body))


def fill(store: Store) -> Store:
    """Windows, letters, verifications, results and messages to edges of some servos, in part not yet processed."""
    for servo in FLEET:
        store.put([digested(servo, n) for n in range(3)])
        store.raise_claim(servo, StoredClaim("run", 1), 1, 100.0)
    for lease in claim(store):
        store.commit([outcome(lease, EvidenceRecord("estimate", lease.messages[0].id, b"\x80", gap=0.1),
                              outgoing=(b"\x80",), wake=300.0)], 200.0)  # fmt: skip
    for servo in FLEET:
        plain = letter(servo, servo.encode()), verification(servo)
        store.put([digested(servo, 3), *(each._replace(digest=message_digest(each.body)) for each in plain)])
    return store


def hit(store: Store, column: str, value: str, servo: str = HIT) -> None:
    """Change a value of the servo's first row in a table."""
    table, name = column.split(".")
    of_servo = "message IN (SELECT id FROM messages WHERE" if table == "bodies" else "("
    key = next(iter(metadata.tables[table].primary_key)).name
    with store.engines.writer.begin() as connection:
        row = connection.exec_driver_sql(
            f"SELECT {key} FROM {table} WHERE {of_servo} servo = '{servo}') ORDER BY {key} LIMIT 1"
        ).scalar_one()
        connection.execute(sa.text(f"UPDATE {table} SET {name} = {value} WHERE {key} = :row"), {"row": row})


def rows_of(store: Store) -> list[object]:
    """All that is stored of the servo, as it is."""
    held = []
    with store.engines.reader.connect() as connection:
        for table in metadata.sorted_tables:
            if "servo" in table.columns:
                held += connection.execute(sa.text(f"SELECT * FROM {table.name} WHERE servo = '{HIT}'")).all()
        held += connection.execute(sa.text("SELECT * FROM bodies ORDER BY message")).all()
    return held


def use(store: Store, others: tuple[str, ...]) -> None:
    """Do what a twin does for its fleet; nothing of it may meet a row of the servo."""
    assert store.put([digested(servo, 9) for servo in others])
    assert store.backlog(400.0).messages == 3 * len(others)
    assert store.turn_lag(400.0) == 300.0
    assert [each.servo for each in store.servos()] == list(others)
    assert set(store.posted(FLEET)) == set(others)
    assert list(store.reading(lambda c: overview.names_after(c, "", 10, store.aside))) == list(others)
    changed = store.sound(store.reading(lambda c: overview.changed(c, overview.StorePosition(0, 0), 10)))
    assert sorted(changed) == list(others)
    assert len(store.reading(lambda c: overview.facts(c, changed, 0.0))) == len(others)
    assert store.reading(overview.position).message == newest_message(store)
    assert newest_receipt(store) == 100.0
    assert old_messages(store, 400.0, 100.0).through >= 0
    leases = claim(store, now=400.0) + claim(store, now=400.0, kinds=("verification",))
    assert {lease.servo for lease in leases} == set(others)
    for lease in leases:
        store.renew("me", [lease.servo, HIT], 500.0)
        store.commit([outcome(lease)], 400.0)
    store.release("me")
    store.release("me", FLEET)
    assert delete_old_bodies(store, newest_message(store)).emptied >= len(others)
    after, complete = 0, False
    while not complete:
        report, after = check_bodies(store, after, 2, store.aside)
        assert not report.faults
        complete = report.complete


def set_aside(store: Store, column: str) -> None:
    report = check_all(store)
    assert report.complete
    (wrong,) = report.rows
    assert wrong.servo == HIT
    assert column.split(".")[0] in wrong.clause or "its body differs" in wrong.clause
    store.set_aside(report.rows)


@pytest.mark.parametrize("column", OWN)
def test_a_value_of_a_wrong_type_concerns_its_servo_alone_and_nobody_meets_it(url: str, column: str) -> None:
    with closing(fill(open_store(url))) as store:
        binary = metadata.tables[column.split(".")[0]].columns[column.split(".")[1]].type.kind is bytes
        hit(store, column, "'abc'" if binary else "x'00'")
        set_aside(store, column)
        before = [row for row in rows_of(store) if HIT in row]
        use(store, tuple(servo for servo in FLEET if servo != HIT))
        assert [row for row in rows_of(store) if HIT in row] == before
        assert fault_of_servo(store, store.aside[HIT])
        assert {row.servo for row in check_pages(store, math.inf).rows} <= {HIT}


@pytest.mark.parametrize("column", NUMBERS)
def test_a_number_that_cannot_be_concerns_its_servo_alone_in_both_systems(store: Store, column: str) -> None:
    hit(fill(store), column, "-7")
    set_aside(store, column)
    use(store, tuple(servo for servo in FLEET if servo != HIT))
    assert column in fault_of_servo(store, store.aside[HIT])
    hit(store, column, "1")
    assert fault_of_servo(store, store.aside[HIT]) == ""
    store.take_back(store.aside[HIT])


def test_a_body_that_changed_concerns_its_servo_until_the_body_is_gone(store: Store) -> None:
    fill(store)
    changed = "x'00'" if store.engines.writer.dialect.name == "sqlite" else r"'\x00'"
    hit(store, "bodies.body", changed)
    set_aside(store, "bodies.body")
    wrong = store.aside[HIT]
    assert fault_of_servo(store, wrong) == wrong.clause
    with store.engines.writer.begin() as connection:
        connection.exec_driver_sql(f"DELETE FROM bodies WHERE message = {wrong.message}")
    assert fault_of_servo(store, wrong) == ""
    hit(store, "bodies.body", changed)  # the next one of the same servo
    assert fault_of_servo(store, wrong)
    store.take_back(store.aside[HIT])


def test_a_wrong_value_in_the_note_itself_is_over_once_the_servo_is_noted_anew(store: Store) -> None:
    hit(fill(store), "twins.serial", "-7")
    set_aside(store, "twins.serial")
    hit(store, "set_aside.message", "-7")
    with pytest.raises(StoreDamaged, match=r"column set_aside\.message holds -7"):
        store.put([digested("ax-1", 20)])
    hit(store, "twins.serial", "0")
    (wrong,) = check_all(store).rows
    store.set_aside([wrong])
    assert store.put([digested("ax-1", 20)])
    store.take_back(store.aside[HIT])
    assert store.put([digested(HIT, 20)])


def test_a_servo_is_taken_back_only_for_the_row_that_was_looked_at(store: Store) -> None:
    """Another twin may have found another row meanwhile."""
    fill(store).set_aside([WrongRow(HIT, "one")])
    store.set_aside([WrongRow(HIT, "other", 3), WrongRow("ax-2", "its own")])
    store.take_back(WrongRow(HIT, "one"))
    assert store.aside == {HIT: WrongRow(HIT, "other", 3), "ax-2": WrongRow("ax-2", "its own")}
    for wrong in list(store.aside.values()):
        store.take_back(wrong)
    assert store.aside == {}


@pytest.mark.parametrize("hits", [("ax-1", "ax-2", "ax-3"), FLEET])
@pytest.mark.parametrize(("column", "value"), [("twins.serial", "-7"), ("messages.received", "-7")])
def test_rows_of_many_servos_are_damage_of_the_store(store: Store, hits: tuple[str, ...], column: str, value: str
) -> None:  # fmt: skip
    fill(store)
    for servo in hits[:2]:
        hit(store, column, value, servo)
    assert {row.servo for row in check_all(store).rows} == set(hits[:2])
    for servo in hits[2:]:
        hit(store, column, value, servo)
    report = check_all(store)
    assert report.rows == ()
    assert report.faults
    assert not report.complete


@pytest.mark.parametrize("column", SHARED)
def test_a_wrong_key_is_damage_of_the_store(url: str, column: str) -> None:
    """Nobody knows whose row it was, and numbers of all servos follow on it."""
    with closing(fill(open_store(url))) as store:
        with store.engines.writer.connect() as connection:
            connection.exec_driver_sql("ROLLBACK")
            connection.exec_driver_sql("PRAGMA foreign_keys = OFF")
        hit(store, column, "-7" if column.endswith((".id", ".message", ".serial")) else "x'00'")
        report = check_all(store)
        assert report.faults
        assert report.rows == ()


def test_a_context_and_a_page_are_damage_of_the_store(url: str) -> None:
    with closing(fill(open_store(url))) as store:
        hit(store, "twins.gap", "'abc'")
        with store.engines.writer.begin() as connection:
            connection.exec_driver_sql("INSERT INTO contexts VALUES ('key', x'00')")
        report = check_all(store)
        assert any("contexts.text" in fault for fault in report.faults)
        assert report.rows == ()


def test_nothing_is_written_or_read_under_the_name_of_a_servo_that_is_set_aside(store: Store) -> None:
    hit(fill(store), "twins.serial", "-7")
    set_aside(store, "twins.serial")
    new = digested(HIT, 50)
    for call in (
        lambda: store.put([digested("ax-2", 60), new]),
        lambda: store.post({HIT: b""}, 1.0),
        lambda: store.add_alarm("no", 1.0, HIT),
        lambda: store.raise_claim(HIT, StoredClaim("run", 2), 2, 1.0),
        lambda: store.skip_to_serial(HIT, 5),
        lambda: store.outgoing(HIT, 0),
        lambda: store.servo(HIT),
        lambda: missing_windows(store, HIT, "boot"),
    ):
        with pytest.raises(ServoSetAside, match="record of servo 'ax-0' is damaged and set aside"):
            call()
    assert store.window("ax-2", "boot", 60) is None
    assert issubclass(ServoSetAside, StoreUnavailable)
    store.take_back(store.aside[HIT])
