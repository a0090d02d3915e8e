"""Around the tables: addresses, migrations, and passwords that are never shown."""

import os
import random
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import psycopg
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from postgres import Server
from smalldisk import small_disk
from store_cases import MORE, NEXT, NewAddress, filled, outcome, window

from servotwin.errors import InvalidInput
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.store import migrate as migrations
from servotwin.store.engine import (
    OpenConnections,
    StoreUnavailable,
    _set_pragma,
    engines_of,
    parse_address,
    public_address,
    transaction,
)
from servotwin.store.records import MessageKind, PutResult
from servotwin.store.results import _locked_serials
from servotwin.store.schema import REVISION, metadata, twins
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)
SECRET = "unspeakable"


# Migrations


@pytest.mark.slow
def test_the_migrations_make_the_tables_that_the_code_knows(new_address: NewAddress) -> None:
    store = open_store(new_address())
    with transaction(store.engines.reader) as connection:
        options = {"version_table": migrations.VERSIONS}
        assert compare_metadata(MigrationContext.configure(connection, opts=options), metadata) == []
        result = sa.inspect(connection)
        for table in metadata.tables.values():
            known = {index["name"] for index in result.get_indexes(table.name)}
            assert {index.name for index in table.indexes} <= known
    store.close()


def test_the_newest_migration_is_the_revision_of_the_code() -> None:
    assert ScriptDirectory(str(migrations.SCRIPTS)).get_current_head() == REVISION


def test_a_verification_that_waits_in_a_database_of_the_version_before_is_found_under_its_new_kind(
    new_address: NewAddress,
) -> None:
    engines = engines_of(parse_address(url := new_address()))
    migrations.migrate(engines.writer, "0001")
    with transaction(engines.writer) as connection:
        for statement in (
            "INSERT INTO twins (servo, heard, asked) VALUES ('a', 5.0, 6.0)",
            "INSERT INTO messages (servo, kind, key, boot, sequence, start, encoding, digest, received) "
            "VALUES ('a', 'proof', 'k', '', 0, 0.0, '', :body, 6.0)",
            "INSERT INTO bodies SELECT id, :body FROM messages",
            "INSERT INTO evidence (servo, kind, status, made, body) VALUES ('a', 'proof', '', 7.0, :body)",
        ):
            connection.execute(sa.text(statement), {"body": b"body"} if ":body" in statement else {})
    engines.dispose()
    store = open_store(url)
    [lease] = store.lease("me", 1, 60.0, 10.0, (MessageKind.VERIFICATION,))
    assert [(one.kind, one.body) for one in lease.messages] == [(MessageKind.VERIFICATION, b"body")]
    assert store.servo("a").last_message == 5.0
    assert store.backlog(20.0).verifications == 1
    assert [(one.kind, one.created) for one in store.events("a")] == [("verification", 7.0)]
    store.close()


@pytest.mark.slow
def test_an_old_database_is_brought_up_to_date_with_all_it_holds(new_address: NewAddress, later_scripts: Path) -> None:
    url = new_address()
    store = filled(url)
    before = store.audit("a")
    migrations.migrate(store.engines.writer, NEXT, later_scripts)
    assert store.audit("a") == before
    with transaction(store.engines.reader) as connection:
        assert connection.execute(sa.text("SELECT colour FROM twins")).scalars().all() == ["grey"]
    store.close()


def test_a_newer_database_is_refused(new_address: NewAddress, later_scripts: Path) -> None:
    url = new_address()
    store = filled(url)
    migrations.migrate(store.engines.writer, NEXT, later_scripts)
    store.close()
    with pytest.raises(
        InvalidInput, match=rf"its schema {NEXT} is newer than {REVISION}.*install the newer servotwin$"
    ):
        open_store(url)


def test_a_migration_that_fails_leaves_nothing(new_address: NewAddress, later_scripts: Path) -> None:
    url = new_address()
    filled(url).close()
    broken = later_scripts / "versions" / f"{NEXT}_more.py"
    broken.write_text(MORE + '    op.execute("INSERT INTO nowhere VALUES (1)")\n')
    engines = engines_of(parse_address(url))
    with pytest.raises((StoreUnavailable, sa.exc.DBAPIError)):
        migrations.migrate(engines.writer, NEXT, later_scripts)
    engines.dispose()
    store = open_store(url)
    assert "colour" not in {column["name"] for column in sa.inspect(store.engines.reader).get_columns("twins")}
    assert store.servo("a").windows == 5
    store.close()


def test_a_database_of_another_program_is_refused(new_address: NewAddress) -> None:
    url = new_address()
    engines = engines_of(parse_address(url))
    with transaction(engines.writer) as connection:
        connection.execute(sa.text("CREATE TABLE messages (words TEXT)"))
    engines.dispose()
    with pytest.raises(InvalidInput, match="holds a table 'messages' that is not servotwin's"):
        open_store(url)


def test_an_edges_outbox_is_no_store(tmp_path: Path) -> None:
    SqliteOutbox(tmp_path / "outbox.sqlite", "ax-1").close()
    before = (tmp_path / "outbox.sqlite").read_bytes()
    with pytest.raises(InvalidInput, match=r"is the outbox of an edge, no store of a twin"):
        open_store(str(tmp_path / "outbox.sqlite"))
    assert (tmp_path / "outbox.sqlite").read_bytes() == before


def test_processes_that_open_a_new_database_at_once_make_it_once(new_address: NewAddress) -> None:
    url = new_address()
    barrier, opened = threading.Barrier(4), []

    def start() -> None:
        barrier.wait()
        opened.append(open_store(url))

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(opened) == 4
    for store in opened:
        store.close()


def test_the_switch_to_a_log_waits_for_another_process(tmp_path: Path) -> None:
    other, own = (
        sqlite3.connect(tmp_path / "store.db", check_same_thread=False, isolation_level=None) for _ in range(2)
    )
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        own.execute("PRAGMA journal_mode = WAL")  # at once, whatever the connection's patience
    timer = threading.Timer(0.1, other.close)
    timer.start()
    _set_pragma(own, "journal_mode = WAL")
    timer.join()
    assert own.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    own.close()


# Addresses


def test_a_new_file_is_its_owners_alone(tmp_path: Path) -> None:
    mask = os.umask(0)
    try:
        store = filled(str(tmp_path / "store.db"))
        result = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    finally:
        os.umask(mask)
    assert result == {"store.db": 0o600, "store.db-wal": 0o600, "store.db-shm": 0o600}
    with transaction(store.engines.writer) as connection:
        values = {n: connection.exec_driver_sql(f"PRAGMA {n}").scalar() for n in ("journal_mode", "synchronous")}
        assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1
    assert values == {"journal_mode": "wal", "synchronous": 2}
    store.close()


def test_a_store_in_memory() -> None:
    store = open_store("sqlite://")
    assert store.put([window()]) == [PutResult.NEW]
    (claim,) = store.lease("me", 1, 1.0, 200.0)
    assert store.commit([outcome(claim)], 200.0) == [True]
    store.close()


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    path.write_bytes(random.Random(1).randbytes(5000))
    with pytest.raises(InvalidInput, match="file is not a database"):
        open_store(str(path))


def test_a_file_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="cannot be created"):
        open_store(str(tmp_path / "nowhere" / "store.db"))


@pytest.mark.parametrize(
    "url",
    [
        f"postgresql://user:{SECRET}@127.0.0.1:1/d?connect_timeout=1",
        f"postgresql://user@127.0.0.1:1/d?password={SECRET}&connect_timeout=1",
        f"postgresql+psycopg://user:{SECRET}@/d?host=/nowhere",
    ],
)
def test_a_password_is_never_shown(url: str) -> None:
    with pytest.raises(InvalidInput, match="not available now") as refused:
        open_store(url)
    observed = [
        str(refused.value),
        repr(refused.value),
        public_address(parse_address(url)),
        repr(refused.value.__cause__),
    ]
    assert SECRET not in " ".join(observed)


def test_an_address_is_shown_as_an_operator_writes_it() -> None:
    address = parse_address("postgresql://user@host:5433/d?sslmode=require", SECRET)
    assert public_address(address) == "postgresql://user@host:5433/d"


def test_a_password_of_its_own_replaces_that_of_the_address() -> None:
    assert parse_address("postgresql://u:old@h/d", SECRET).password == SECRET
    assert parse_address("postgresql://u:old@h/d").password == "old"


@pytest.mark.slow
def test_without_psycopg_the_error_names_the_extra() -> None:
    program = """
import sys
sys.modules["psycopg"] = None
from servotwin.errors import InvalidInput
from servotwin.store.store import open_store
try:
    open_store("postgresql://u:unspeakable@h/d")
except InvalidInput as error:
    print(error)
"""
    output = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    assert output.strip().endswith("PostgreSQL needs the package psycopg; install servotwin[postgres]")
    assert SECRET not in output


@pytest.mark.slow
def test_a_server_that_cuts_its_connections_is_survived(postgres_server: Server) -> None:
    store = open_store(postgres_server.database("cut"))
    store.put([window()])
    postgres_server.run("postgres", "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = 'cut'")
    with pytest.raises(StoreUnavailable, match="not available now"):
        store.put([window(sequence=2)])
    assert store.put([window(sequence=2)]) == [PutResult.NEW]
    assert store.servo("a").windows == 2
    store.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limit", "reason"),
    [("default_transaction_read_only = on", "read-only transaction"), ("statement_timeout = 1", "statement timeout")],
)
def test_limits_of_the_server_that_are_over_are_over_for_connections_that_began_under_them(
    postgres_server: Server, limit: str, reason: str
) -> None:
    """A session keeps the settings of its beginning; a twin whose pool kept such ones refused windows for ever."""
    name = limit.partition(" ")[0]
    url = postgres_server.database(name)
    open_store(url).close()
    with closing(open_store(url)) as store:
        postgres_server.run("postgres", f"ALTER DATABASE {name} SET {limit}")
        store.engines.dispose()
        with pytest.raises(StoreUnavailable, match=f"not available now .*{reason}"):
            _run(store, "SELECT pg_sleep(0.1)", "DELETE FROM claims")
        postgres_server.run("postgres", f"ALTER DATABASE {name} RESET {name}")
        assert store.put([window()]) == [PutResult.NEW]
        _run(store, "SELECT pg_sleep(0.1)")


def _run(store: Store, *statements: str) -> None:
    with transaction(store.engines.writer) as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)


@pytest.mark.slow
def test_servos_are_locked_in_one_order_whatever_language_the_database_sorts_in(
    postgres_server: Server,
) -> None:
    """Two twins that lock rows in different orders wait for each other until the server ends one of them."""
    names = ["ax-1", "Ax-2", "AX-3", "b", "B"]
    try:
        url = postgres_server.database("sorted", "en-US")
    except psycopg.Error as error:
        pytest.skip(f"this PostgreSQL has no ICU: {error}")
    store = open_store(url)
    store.put([window(name) for name in names])
    with store.engines.reader.connect() as connection:
        by_people = connection.scalars(sa.select(twins.c.servo).order_by(twins.c.servo)).all()
        held = connection.execute(_locked_serials("postgresql"), {"_servos": names}).all()
    store.close()
    assert by_people != sorted(names)
    assert [row.servo for row in held] == sorted(names)


def test_a_store_that_cannot_be_written_names_the_file_whose_mode_is_in_the_way(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = filled(url)
    log = tmp_path / "store.db-shm"
    assert log.exists()
    access = os.access
    monkeypatch.setattr(os, "access", lambda place, mode: (place != log or mode != os.W_OK) and access(place, mode))
    with pytest.raises(StoreUnavailable) as refused, transaction(store.engines.writer):
        raise sqlite3.OperationalError("attempt to write a readonly database")
    assert str(refused.value).endswith(f"(attempt to write a readonly database; this user may not write {log})")
    store.close()


def test_a_file_system_that_turned_read_only_is_named(tmp_path: Path) -> None:
    """SQLite calls that an error of the disk, as it does much else."""
    with small_disk(tmp_path / "disk", 4) as disk:
        store = filled(f"sqlite:///{disk.path}/twin.db")
        store.close()
        disk.remount("ro")
        with pytest.raises(StoreUnavailable) as refused:
            store.write_nothing()
        disk.remount("rw")
        store.write_nothing()
        store.close()
    assert str(refused.value).endswith(f"; the file system of {disk.path} is read-only)")


def test_a_log_whose_store_was_moved_away_is_not_deleted_by_a_new_store(url: str, tmp_path: Path) -> None:
    store = filled(url)
    (tmp_path / "store.db").rename(tmp_path / "moved.db")
    with pytest.raises(InvalidInput, match=r"store.db: is missing, but its log store.db-wal exists"):
        open_store(url)
    assert (tmp_path / "store.db-wal").stat().st_size > 0
    (tmp_path / "moved.db").rename(tmp_path / "store.db")
    open_store(url).close()
    store.close()


class Unconnected:
    """Connection that is closed already."""

    def fileno(self) -> int:
        raise OSError("closed")


def test_connections_are_cut_while_threads_make_others() -> None:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    opened, kept, done = OpenConnections(), [Unconnected() for _ in range(30_000)], threading.Event()

    def connect() -> None:
        for each in kept:
            opened.add(each)
        done.set()

    connecting = threading.Thread(target=connect)
    connecting.start()
    try:
        while not done.is_set():
            opened.cut()
    finally:
        connecting.join()
        sys.setswitchinterval(before)
