"""What surrounds the tables: addresses, migrations, backup and restore, retention, passwords that are not shown."""

import os
import random
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import postgres
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from store_cases import SYSTEMS, addresses, letter, outcome, window

from servotwin.errors import InvalidInput
from servotwin.store import migrate as migrations
from servotwin.store.address import address_of, shown
from servotwin.store.backup import Counts, backup, restore
from servotwin.store.engine import engines_of, transaction
from servotwin.store.errors import StoreUnavailable
from servotwin.store.retention import Forgotten, forget
from servotwin.store.rows import Evidence, Put
from servotwin.store.schema import REVISION, bodies, metadata
from servotwin.store.store import Store, open_store

MORE = """
import sqlalchemy as sa
from alembic import op
revision = "0002"
down_revision = "0001"
def upgrade():
    op.add_column("twins", sa.Column("colour", sa.Text, nullable=False, server_default="grey"))
"""
SECRET = "unspeakable"


@pytest.fixture(scope="module", params=SYSTEMS)
def new_address(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable]:
    with addresses(request.param, tmp_path_factory.mktemp("stores")) as found:
        yield found


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/store.db"


@pytest.fixture
def later_scripts(tmp_path: Path) -> Path:
    """The migrations of some later servotwin."""
    folder = tmp_path / "migrations"
    shutil.copytree(migrations.SCRIPTS, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "versions" / "0002_more.py").write_text(MORE)
    return folder


def filled(url: str, windows: int = 5) -> Store:
    store = open_store(url)
    store.put([window(sequence=n, body=os.urandom(3000), received=100.0 + n) for n in range(windows)])
    return store


# Migrations


def test_the_migrations_make_the_tables_that_the_code_knows(new_address: Callable[[], str]) -> None:
    store = open_store(new_address())
    with transaction(store.engines.reader) as connection:
        options = {"version_table": migrations.VERSIONS}
        assert compare_metadata(MigrationContext.configure(connection, opts=options), metadata) == []
        found = sa.inspect(connection)
        for table in metadata.tables.values():
            known = {index["name"] for index in found.get_indexes(table.name)}
            assert {index.name for index in table.indexes} <= known
    store.close()


def test_the_newest_migration_is_the_revision_of_the_code() -> None:
    assert ScriptDirectory(str(migrations.SCRIPTS)).get_current_head() == REVISION


def test_an_old_database_is_brought_up_to_date_with_all_it_holds(
    new_address: Callable[[], str], later_scripts: Path
) -> None:
    url = new_address()
    store = filled(url)
    before = store.audit("a")
    migrations.migrate(store.engines.writer, "0002", later_scripts)
    assert store.audit("a") == before
    with transaction(store.engines.reader) as connection:
        assert connection.execute(sa.text("SELECT colour FROM twins")).scalars().all() == ["grey"]
    store.close()


def test_a_newer_database_is_refused(new_address: Callable[[], str], later_scripts: Path) -> None:
    url = new_address()
    store = filled(url)
    migrations.migrate(store.engines.writer, "0002", later_scripts)
    store.close()
    with pytest.raises(InvalidInput, match=r"its schema 0002 is newer than 0001.*install the newer servotwin$"):
        open_store(url)


def test_a_migration_that_fails_leaves_nothing(new_address: Callable[[], str], later_scripts: Path) -> None:
    url = new_address()
    filled(url).close()
    broken = later_scripts / "versions" / "0002_more.py"
    broken.write_text(MORE + '    op.execute("INSERT INTO nowhere VALUES (1)")\n')
    engines = engines_of(address_of(url))
    with pytest.raises((StoreUnavailable, sa.exc.DBAPIError)):
        migrations.migrate(engines.writer, "0002", later_scripts)
    engines.dispose()
    store = open_store(url)
    assert "colour" not in {column["name"] for column in sa.inspect(store.engines.reader).get_columns("twins")}
    assert store.servo("a").windows == 5
    store.close()


def test_a_database_of_another_program_is_refused(new_address: Callable[[], str]) -> None:
    url = new_address()
    engines = engines_of(address_of(url))
    with transaction(engines.writer) as connection:
        connection.execute(sa.text("CREATE TABLE messages (words TEXT)"))
    engines.dispose()
    with pytest.raises(InvalidInput, match="holds a table 'messages' that is not servotwin's"):
        open_store(url)


def test_processes_that_open_a_new_database_at_once_make_it_once(new_address: Callable[[], str]) -> None:
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


# Addresses


def test_a_new_file_is_its_owners_alone(tmp_path: Path) -> None:
    mask = os.umask(0)
    try:
        store = filled(str(tmp_path / "store.db"))
        found = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    finally:
        os.umask(mask)
    assert found == {"store.db": 0o600, "store.db-wal": 0o600, "store.db-shm": 0o600}
    with transaction(store.engines.writer) as connection:
        values = {n: connection.exec_driver_sql(f"PRAGMA {n}").scalar() for n in ("journal_mode", "synchronous")}
        assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1
    assert values == {"journal_mode": "wal", "synchronous": 2}
    store.close()


def test_a_store_in_memory() -> None:
    store = open_store("sqlite://")
    assert store.put([window()]) == [Put.NEW]
    (claim,) = store.claim("me", 1, 1.0, 200.0)
    assert store.commit([outcome(claim)], 200.0) == [True]
    store.close()


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    path.write_bytes(random.Random(1).randbytes(5000))
    with pytest.raises(InvalidInput, match="file is not a database"):
        open_store(str(path))


def test_a_file_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="cannot be made"):
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
    seen = [str(refused.value), repr(refused.value), shown(address_of(url)), repr(refused.value.__cause__)]
    assert SECRET not in " ".join(seen)


def test_a_password_of_its_own_replaces_that_of_the_address() -> None:
    assert address_of("postgresql://u:old@h/d", SECRET).password == SECRET
    assert address_of("postgresql://u:old@h/d").password == "old"


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
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    assert said.strip().endswith("PostgreSQL needs the package psycopg; install servotwin[postgres]")
    assert SECRET not in said


def test_a_server_that_cuts_its_connections_is_survived() -> None:
    with postgres.running() as server:
        store = open_store(server.database("cut"))
        store.put([window()])
        server.run("postgres", "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = 'cut'")
        with pytest.raises(StoreUnavailable, match="not available now"):
            store.put([window(sequence=2)])
        assert store.put([window(sequence=2)]) == [Put.NEW]
        assert store.servo("a").windows == 2
        store.close()


# Backup and restore


def test_a_backup_restored_holds_the_same(url: str, tmp_path: Path) -> None:
    store = filled(url)
    (claim,) = store.claim("me", 1, 30.0, 200.0)
    store.commit([outcome(claim, Evidence("estimate", claim.messages[0].id, b"e"), outgoing=(b"u",))], 201.0)
    pages: list[tuple[int, int]] = []
    saved = tmp_path / "backup.db"
    counts = backup(url, saved, lambda *of: pages.append(of))
    assert counts == Counts(twins=1, messages=5, bodies=5, evidence=1, outgoing=1)
    assert pages[-1][0] == 0
    assert saved.stat().st_mode & 0o777 == 0o600
    store.put([window(sequence=9)])

    again = f"sqlite:///{tmp_path}/again.db"
    assert restore(saved, again) == counts
    restored = open_store(again)
    assert restored.audit("a") == store.audit("a")[1:]
    assert restored.outgoing("a", 0) == store.outgoing("a", 0)
    assert restored.window("a", "boot", 3) == store.window("a", "boot", 3)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith(("backup", ".backup"))) == ["backup.db"]
    restored.close()
    store.close()


def test_a_backup_while_it_is_written_to_is_of_one_moment(url: str, tmp_path: Path) -> None:
    store = filled(url, 50)
    stop = threading.Event()

    def write() -> None:
        sequence = 50
        while not stop.is_set():
            store.put([window(sequence=n, body=os.urandom(3000)) for n in (sequence, sequence + 1)])
            sequence += 2

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for number in range(5):
            counts = backup(url, tmp_path / f"backup-{number}.db")
            assert counts.messages == counts.bodies
            assert counts.messages % 2 == 0
    finally:
        stop.set()
        writer.join()
    store.close()


def test_what_cannot_be_backed_up(url: str, tmp_path: Path) -> None:
    to = tmp_path / "backup.db"
    with pytest.raises(InvalidInput, match="there is no such file"):
        backup(url, to)
    with pytest.raises(InvalidInput, match=r"call pg_dump --format=custom --file=.*backup.db DATABASE$") as refused:
        backup(f"postgresql://u:{SECRET}@h/d", to)
    assert SECRET not in str(refused.value)
    other = tmp_path / "other.db"
    sqlite3.connect(other).close()
    with pytest.raises(InvalidInput, match="is not one of servotwin's"):
        backup(str(other), to)
    store = filled(url)
    with pytest.raises(InvalidInput, match="is the store itself"):
        backup(url, tmp_path / "store.db")
    with pytest.raises(InvalidInput, match="cannot be written"):
        backup(url, tmp_path / "nowhere" / "backup.db")
    assert not to.exists()
    store.close()


def test_a_restore_overwrites_nothing(url: str, tmp_path: Path) -> None:
    store, saved = filled(url), tmp_path / "backup.db"
    backup(url, saved)
    with pytest.raises(InvalidInput, match="holds something already"):
        restore(saved, url)
    empty = tmp_path / "empty.db"
    in_use = open_store(str(empty))
    with pytest.raises(InvalidInput, match="is in use"):
        restore(saved, str(empty))
    in_use.close()
    assert restore(saved, str(empty)).messages == 5
    opened = open_store(str(empty))
    assert opened.servo("a").windows == 5
    opened.close()
    left = tmp_path / "gone.db"
    left.with_name("gone.db-wal").write_bytes(b"log")
    with pytest.raises(InvalidInput, match=r"its log gone\.db-wal is there"):
        restore(saved, str(left))
    store.close()


def test_a_damaged_or_newer_backup_is_not_restored(url: str, tmp_path: Path, later_scripts: Path) -> None:
    store, saved, to = filled(url, 40), tmp_path / "backup.db", tmp_path / "restored.db"
    backup(url, saved)
    whole = saved.read_bytes()
    middle = len(whole) // 2
    saved.write_bytes(whole[:middle] + os.urandom(20_000) + whole[middle + 20_000 :])
    with pytest.raises(InvalidInput):
        restore(saved, str(to))
    saved.write_bytes(whole[:middle])
    with pytest.raises(InvalidInput):
        restore(saved, str(to))
    migrations.migrate(store.engines.writer, "0002", later_scripts)
    store.close()
    shutil.copy(tmp_path / "store.db", saved)
    with pytest.raises(InvalidInput, match="newer than 0001"):
        restore(saved, str(to))
    assert not to.exists()
    with pytest.raises(InvalidInput, match="there is no such file"):
        restore(tmp_path / "nothing.db", str(to))
    with pytest.raises(InvalidInput, match="call pg_restore"):
        restore(saved, "postgresql://u@h/d")


# Retention


def test_retention_empties_old_windows_but_those_that_matter(new_address: Callable[[], str]) -> None:
    store = open_store(new_address())
    store.put([window(sequence=n, body=bytes(1000), received=100.0 + n) for n in range(10)])
    store.put([letter(received=100.0)])
    (claim,) = store.claim("me", 1, 30.0, 200.0, per_servo=8)
    led = Evidence("update", claim.messages[2].id, b"", version=1)
    every = [Evidence("estimate", message.id, b"e") for message in claim.messages]
    store.commit([outcome(claim, led, *every)], 201.0)
    pauses: list[None] = []
    assert forget(store, 109.0, 3, lambda: pauses.append(None)) == Forgotten(emptied=7, bytes=7000, kept=2)
    assert pauses
    bodies = {n: store.window("a", "boot", n).body for n in range(10)}
    assert [n for n, body in bodies.items() if body] == [2, 8, 9]
    assert len([link for link in store.audit("a") if link.found or link.steps]) == 8
    assert store.put([window(body=bytes(1000))]) == [Put.KNOWN]
    (rest,) = store.claim("me", 1, 30.0, 300.0)
    assert len(rest.messages) == 3
    assert forget(store, 109.0) == Forgotten(0, 0, 2)
    store.close()


def test_retention_gives_the_disk_back(url: str, tmp_path: Path) -> None:
    store = open_store(url)
    store.put([window(sequence=n, body=os.urandom(20_000), received=100.0) for n in range(100)])
    while claims := store.claim("me", 1, 30.0, 200.0):
        store.commit([outcome(claim) for claim in claims], 201.0)

    def pages() -> int:
        with transaction(store.engines.reader) as connection:
            return connection.exec_driver_sql("PRAGMA page_count").scalar_one()

    before = pages()
    assert forget(store, 1000.0, 10).emptied == 100
    assert pages() < before / 5
    store.close()


def test_retention_ended_early_goes_on_next_time(url: str) -> None:
    store = open_store(url)
    store.put([window(sequence=n, received=100.0) for n in range(10)])
    store.commit([outcome(claim) for claim in store.claim("me", 1, 30.0, 200.0)], 201.0)

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        forget(store, 1000.0, 4, stop)
    assert forget(store, 1000.0, 4).emptied == 6
    with transaction(store.engines.reader) as connection:
        assert connection.execute(sa.select(sa.func.count()).select_from(bodies)).scalar_one() == 0
    with pytest.raises(InvalidInput, match="must be at least 1"):
        forget(store, 1000.0, 0)
    store.close()
