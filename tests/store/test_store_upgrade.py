"""A store with data of the revision before: upgraded it holds the same; its backup goes back, and forth again."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import sqlalchemy as sa
from servers import find
from store_cases import NewAddress, claim, outcome, window

from servotwin.store import migrate as migrations
from servotwin.store.backup import backup, restore
from servotwin.store.claims import NO_CLAIM, StoredClaim
from servotwin.store.engine import engines_of, parse_address, sqlite_file, transaction
from servotwin.store.records import EvidenceRecord, PutResult
from servotwin.store.schema import REVISION
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)

BEFORE = "0002"
Rows = dict[str, list[tuple[object, ...]]]


def rows(store: Store) -> Rows:
    """All rows of the tables of the revision before, without the columns that came since."""
    with transaction(store.engines.reader) as connection:
        return {
            table.name: sorted(map(tuple, connection.execute(sa.select(*_columns_before(table)))))
            for table in tables(connection)
        }


def tables(connection: sa.Connection) -> list[sa.Table]:
    """Tables of the revision before, each after those that it refers to."""
    known = sa.MetaData()
    known.reflect(connection)
    return [table for table in known.sorted_tables if table.name not in ("claims", "set_aside", migrations.VERSIONS)]


def _columns_before(table: sa.Table) -> list[sa.Column[object]]:
    return [column for column in table.columns if column.name != "estimate_ready"]


def revision(store: Store) -> str:
    with transaction(store.engines.reader) as connection:
        return str(connection.execute(sa.text(f"SELECT version_num FROM {migrations.VERSIONS}")).scalar())


def filled_before(url: str, folder: Path) -> Rows:
    """Fill a new database of the revision before, as this version would have; its rows."""
    store = open_store(f"sqlite:///{folder}/now.db")
    store.put([window(sequence=n, body=bytes([n]) * 500, received=100.0 + n) for n in range(5)])
    [lease] = claim(store)
    estimate = EvidenceRecord("estimate", lease.messages[0].id, b"evidence", gap=0.1, status="ok")
    assert store.commit([outcome(lease, estimate, outgoing=(b"update",))], 300.0) == [True]
    found = rows(store)
    assert len(found["messages"]) == len(found["bodies"]) == 5
    store.close()
    engines = engines_of(parse_address(url))
    migrations.migrate(engines.writer, BEFORE)
    with transaction(engines.writer) as connection:
        for table in tables(connection):
            names = [column.name for column in table.columns]
            for row in found[table.name]:
                connection.execute(sa.insert(table), dict(zip(names, row, strict=True)))
            if connection.dialect.name == "postgresql" and "id" in table.columns:
                # Rows with numbers of their own do not move the counter of numbers on.
                last = sa.select(sa.func.max(table.c.id)).scalar_subquery()
                connection.execute(sa.select(sa.func.setval(sa.func.pg_get_serial_sequence(table.name, "id"), last)))
    old = Store(engines)
    assert (revision(old), rows(old)) == (BEFORE, found)
    old.close()
    return found


def dumped(url: str, to: Path) -> Callable[[str], None]:
    """Back a database up by the means of its system; a function that restores it under another address."""
    file = sqlite_file(parse_address(url))
    if file is not None:
        shutil.copy(file, to)
        return lambda other: shutil.copy(to, str(sqlite_file(parse_address(other)))) and None
    server = sa.make_url(url)
    pg_dump = find("initdb")
    assert pg_dump is not None

    def run(program: str, database: str | None, *options: str) -> None:
        at = ["-h", str(server.query["host"]), "-U", str(server.username), "-d", str(database)]
        subprocess.run([pg_dump.resolve().with_name(program), *at, *options], check=True, timeout=60)

    run("pg_dump", server.database, "--format=custom", "-f", str(to))
    return lambda other: run("pg_restore", sa.make_url(other).database, "--no-owner", str(to))


@pytest.mark.slow
def test_a_store_of_the_revision_before_goes_forth_and_back_from_its_backup(
    new_address: NewAddress, tmp_path: Path
) -> None:
    url = new_address()
    before = filled_before(url, tmp_path)
    restore_to = dumped(url, tmp_path / "backup")
    for address in (url, new_address()):
        if address != url:
            restore_to(address)
            old = Store(engines_of(parse_address(address)))
            assert (revision(old), rows(old)) == (BEFORE, before), "an older servotwin finds what it left"
            old.close()
        store = open_store(address)
        assert (revision(store), rows(store)) == (REVISION, before)
        assert store.claim_of("a") == NO_CLAIM
        assert store.raise_claim("a", StoredClaim("b1-aa", 1), 1, 400.0) == StoredClaim("b1-aa", 1)
        assert store.put([window(sequence=4, body=bytes([4]) * 500), window(sequence=5)]) == [
            PutResult.KNOWN,
            PutResult.NEW,
        ]
        assert [each.body for each in store.outgoing("a", 0)] == [b"update"]
        assert [message.key for message in claim(store)[0].messages] == ["boot/5"]
        store.close()


def test_of_claims_only_a_higher_number_counts(new_address: NewAddress) -> None:
    store = open_store(new_address())
    assert store.raise_claim("x", StoredClaim("one", 3), 3, 1.0) == StoredClaim("one", 3)
    assert store.raise_claim("x", StoredClaim("two", 3), 3, 2.0) == StoredClaim("one", 3)
    assert store.raise_claim("x", StoredClaim("two", 4), 4, 3.0) == StoredClaim("two", 4)
    assert store.claim_of("y") == NO_CLAIM
    store.add_alarm("conflict: two edges", 5.0, "new")
    assert [(one.kind, one.status, one.created) for one in store.events("new")] == [
        ("alarm", "conflict: two edges", 5.0)
    ]
    store.close()


def test_a_backup_of_the_revision_before_is_made_and_restored_by_this_version(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/twin.db"
    before = filled_before(url, tmp_path)
    backup(url, tmp_path / "backup.db")
    other = f"sqlite:///{tmp_path}/other.db"
    restore(tmp_path / "backup.db", other)
    store = open_store(other)
    assert revision(store) == REVISION
    after = rows(store)
    del after["evidence"][len(before["evidence"]) :]  # an alarm: the backup lacks what came later
    assert {name: after[name] for name in ("messages", "bodies", "evidence")} == {
        name: before[name] for name in ("messages", "bodies", "evidence")
    }
    store.close()
