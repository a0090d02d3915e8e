"""IntegrityReport of a store: damaged pages, wrong values, bodies that differ from their digests, lost messages."""

from __future__ import annotations

import logging
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import closing
from functools import partial
from hashlib import blake2b
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import sqlalchemy as sa

from servotwin.messages import MAX_BYTES, InvalidMessage
from servotwin.messages.codec import decompress
from servotwin.runtime.sqlite_damage import damage_words
from servotwin.store.engine import POSTGRESQL, StoreDamaged, is_damage, sqlite_file, transaction
from servotwin.store.migrate import VERSIONS
from servotwin.store.postgresql_tables import table_faults
from servotwin.store.schema import WINDOWS, bodies, messages, metadata, twins
from servotwin.store.set_aside import without
from servotwin.store.store import Store
from servotwin.store.stored_value import WrongRow, wrong_row_of, wrong_rows

log = logging.getLogger(__name__)

_OWN_TABLES = ("sqlite_sequence", VERSIONS)
_TABLES = (
    *_OWN_TABLES, "set_aside", "twins", "claims", "states", "contexts", "outgoing", "evidence", "messages", "bodies",
)  # fmt: skip
"""By size, the smallest first: in a bounded time as many as possible are checked. The first two are SQLite's, which
counts ids there, and that of the migrations."""
_STEPS = 20_000
"""Instructions of SQLite's machine between two looks at the time: a few ms."""
_CHUNK = 2047
"""Bytes; see `message_digest`."""
_DIGEST_BYTES = 16
_MOST_FAULTS = 3
_READ_FILES = """
import sys
for name in sys.argv[1:]:
    try:
        with open(name, "rb", 0) as opened:
            while opened.read(1 << 20):
                pass
    except FileNotFoundError:
        pass
    except OSError as error:
        sys.exit(print(f"{error.strerror}, in {name}"))
"""
_READ_S = 600.0
_BODIES_AT_ONCE = 256
_UNLIMITED_S = 20.0 * 86400.0
"""s that no check takes. Not infinite: PostgreSQL's would then seek every row by each index, for four times as long."""


class IntegrityReport(NamedTuple):
    """Result of a check.

    Attributes
    ----------
    faults : tuple of str
        The first ones found; empty: none.
    complete : bool
        False where the time was over before everything was checked.
    checked : int
        Tables, or messages.
    rows : tuple of WrongRow
        Where nothing is wrong but rows of a few servos: one row of each. Empty: the faults concern all, or there are
        none.
    """

    faults: tuple[str, ...] = ()
    complete: bool = True
    checked: int = 0
    rows: tuple[WrongRow, ...] = ()


def message_digest(data: bytes) -> bytes:
    """Digest of a decoded message, in chunks so small that hashlib does not release the interpreter lock.

    With larger ones another thread takes the lock, and the event loop waits for that thread: 270 us instead of 25 for
    20 kB while commits are being written.
    """
    whole, digest = memoryview(data), blake2b(digest_size=_DIGEST_BYTES)
    for begin in range(0, len(data), _CHUNK):
        digest.update(whole[begin : begin + _CHUNK])
    return digest.digest()


def check_files(store: Store) -> IntegrityReport:
    """Check that the files of an SQLite store are those that it was opened with; raises StoreUnavailable."""
    try:
        with transaction(store.engines.writer):  # its beginning compares them
            return IntegrityReport()
    except StoreDamaged as error:
        return IntegrityReport((str(error),), False)


def check_pages(
    store: Store, seconds: float, deep: bool = False, ended: Callable[[], bool] = lambda: False
) -> IntegrityReport:
    """Check the pages of a store, table by table, for a bounded time.

    Reading happens on a connection of its own and delays nobody; the log of SQLite cannot be shortened meanwhile.

    Parameters
    ----------
    seconds : float
    deep : bool
        Of SQLite: compare tables with their indexes too, as PostgreSQL's are in every case.
    ended : callable
        True: stop.

    Raises
    ------
    StoreUnavailable
        The PostgreSQL server does not answer.
    """
    if store.engines.writer.dialect.name == POSTGRESQL:
        try:
            most = _few_of(store)
        except StoreDamaged as error:
            return IntegrityReport((str(error),), False)
        faults, complete, wrong = table_faults(store.engines.reader, seconds, most + 1)
        return _report(faults, complete, len(metadata.tables), wrong, most)
    file = sqlite_file(store.engines.writer.url)
    if file is None:
        return IntegrityReport()
    checked, until, check = 0, time.monotonic() + seconds, "integrity_check" if deep else "quick_check"
    wrong, most = list[WrongRow](), 0
    try:
        with closing(_opened(file, lambda: time.monotonic() > until or ended())) as connection:
            most = _few(connection.execute(str(_SERVOS)).fetchone()[0])
            for table in _TABLES:
                rows = connection.execute(f"PRAGMA {check}('{table}')").fetchmany(_MOST_FAULTS)
                faults = tuple(f"table {table}: {row[0].splitlines()[-1]}" for row in rows if row[0] != "ok")
                if faults:
                    return IntegrityReport(faults, False, checked)
                if table in metadata.tables:
                    wrong += wrong_rows(connection, metadata.tables[table], most + 1)
                checked += 1
    except sqlite3.Error as error:
        if is_damage(error):
            return IntegrityReport((damage_words(error),), False, checked)
        # The time is over, or something passes: no free file descriptor, a locked file. The next check tells.
        if time.monotonic() < until:
            log.warning("store not checked", extra={"why": str(error)})
        return _report((), False, checked, wrong, most)
    return _report((), True, checked, wrong, most)


def _few_of(store: Store) -> int:
    return _few(store.reading(lambda connection: connection.execute(_SERVOS).scalar_one()))


def _few(servos: int) -> int:
    """Number of servos, of so many, up to which wrong rows concern these alone: of 10, 3; of 1000, 9.

    What changes a value here and there hits few of many; what hits more is at work everywhere. Of one servo none.
    """
    return max(0, servos.bit_length() - 1)


def _report(
    faults: tuple[str, ...], complete: bool, checked: int, wrong: Iterable[WrongRow], most: int
) -> IntegrityReport:
    """Report of faults of the store and of wrong rows, which concern their servos alone where those are `most`."""
    rows = list(wrong)
    told = (*faults, *(row.clause for row in rows))[:_MOST_FAULTS]
    first_of = {row.servo: row for row in reversed(rows)}
    apart = not faults and None not in first_of and len(first_of) <= most
    if rows and not apart:
        return IntegrityReport(told, False, checked)
    return IntegrityReport(told, complete, checked, tuple(first_of.values()) if apart else ())


def check_bodies(store: Store, after: int, most: int, aside: Collection[str] = ()) -> tuple[IntegrityReport, int]:
    """Compare the bodies of messages with their digests, from the one that follows the id `after`.

    Those of the servos `aside` are left out; `rows` has those that differ, of however many servos.

    Returns
    -------
    IntegrityReport, int
        `complete` where these were the last ones; and the id of the last one, with which to go on.
    """
    try:
        with transaction(store.engines.reader) as connection:
            query = without(_BODIES, messages.c.servo, aside)
            rows = connection.execute(query, {"_after": after, "_most": most}).all()
    except StoreDamaged as error:
        return IntegrityReport((str(error),), False), after
    wrong = tuple(WrongRow(row.servo, fault, row.id) for row in rows if (fault := body_fault(*row)))
    faults = tuple(row.clause for row in wrong[:_MOST_FAULTS])
    result = IntegrityReport(faults, len(rows) < most, len(rows), wrong)
    return result, rows[-1].id if rows else after


def check_all(store: Store, ended: Callable[[], bool] = lambda: False) -> IntegrityReport:
    """Check files, pages and bodies of a store that was found damaged, however long it takes; `complete` where all was
    checked, and all of it is sound, or all but `rows`.

    Parameters
    ----------
    ended : callable
        True: stop.

    Raises
    ------
    StoreUnavailable
        The store does not answer.
    """
    report = IntegrityReport()
    for check in (partial(check_files, store), partial(check_pages, store, _UNLIMITED_S, True, ended)):
        report = check()
        if not report.complete or (report.faults and not report.rows):
            return report
    store.engines.reader.dispose()  # its connections may hold pages as they were read when the store was damaged
    most = _few_of(store)
    wrong, after, checked = {row.servo: row for row in report.rows}, 0, 0
    while not ended():
        report, after = check_bodies(store, after, _BODIES_AT_ONCE, [row.servo for row in wrong.values() if row.servo])
        checked += report.checked
        wrong = {row.servo: row for row in reversed(report.rows)} | wrong
        if report.complete or len(wrong) > most or (report.faults and not report.rows):
            faults = () if report.rows else report.faults
            return _report(faults, report.complete, checked, wrong.values(), most)
    return IntegrityReport((), False, checked)


def fault_of_servo(store: Store, found: WrongRow) -> str:
    """First fault of the rows of a servo of which one was found wrong, that one first; empty: they are sound.

    Raises
    ------
    StoreUnavailable
    """
    try:
        with transaction(store.engines.reader) as connection:
            of_servo = STORED_BODIES.where(messages.c.servo == found.servo)
            faults = (body_fault(*row) for row in connection.execute(of_servo.where(messages.c.id == found.message)))
            if fault := next(filter(None, faults), ""):
                return fault
            for table in metadata.sorted_tables:
                if "servo" in table.columns and (wrong := wrong_row_of(connection, table, str(found.servo))):
                    return wrong.clause
            with connection.execution_options(yield_per=_BODIES_AT_ONCE).execute(of_servo) as rows:
                return next(filter(None, (body_fault(*row) for row in rows)), "")
    except StoreDamaged as error:  # a body that is no bytes
        return str(error)


def read_error(store: Store) -> str:
    """Error with which the system does not give all of an SQLite store's files; empty: it gives all.

    SQLite reports a page that the disk does not give in the words and with the code of a damaged one.
    """
    file = sqlite_file(store.engines.writer.url)
    if file is None:
        return ""
    places = [str(file.with_name(f"{file.name}{end}").absolute()) for end in ("", "-wal")]
    # In a process of its own: a process that closes a file gives up all locks that its SQLite has on that file.
    command = [sys.executable, "-I", "-c", _READ_FILES, *places]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=_READ_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""  # not known
    return result.stdout.strip()


def missing_windows(store: Store, servo: str, boot: str, newest: int = 256) -> list[tuple[int, int]]:
    """Ranges of sequences, both included, that are missing among the newest windows of a boot."""
    store.require_sound(servo)
    with transaction(store.engines.reader) as connection:
        rows = connection.execute(_NEWEST, {"_servo": servo, "_newest": newest}).all()
        sequences = {row.sequence for row in rows if row.boot == boot}
        if sequences and len(rows) < newest:
            sequences.add(-1)  # a boot counts from 0
        if holes := _holes(sequences):
            # Windows that were sent again are the newest by their arrival, and those around them came long before.
            between = {"_servo": servo, "_boot": boot, "_first": holes[0][0], "_last": holes[-1][1]}
            holes = _holes(sequences.union(connection.execute(_BETWEEN, between).scalars()))
    return holes


def _holes(sequences: set[int]) -> list[tuple[int, int]]:
    pairs = pairwise(sorted(sequences))
    return [(one + 1, other - 1) for one, other in pairs if other > one + 1]


def newest_message(store: Store) -> int:
    """Highest id of a message; 0: there is none."""
    with transaction(store.engines.reader) as connection:
        return int(connection.execute(sa.select(sa.func.coalesce(sa.func.max(messages.c.id), 0))).scalar_one())


def _opened(file: Path, over: Callable[[], bool]) -> sqlite3.Connection:
    connection = sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None)
    connection.set_progress_handler(over, _STEPS)
    return connection


def body_fault(message: int, servo: str, encoding: str, digest: bytes, body: bytes) -> str:
    """Fault of a stored body; empty: none. A digest of another length was not made by `message_digest`."""
    if len(digest) != _DIGEST_BYTES:
        return ""
    try:
        sound = message_digest(decompress(body, encoding, MAX_BYTES)) == digest
    except (InvalidMessage, TypeError):  # SQLite keeps a text where a body belongs
        sound = False
    return "" if sound else f"message {message} of servo {servo!r}: its body differs from its digest"


STORED_BODIES = (
    sa.select(messages.c.id, messages.c.servo, messages.c.encoding, messages.c.digest, bodies.c.body)
    .select_from(bodies.join(messages, messages.c.id == bodies.c.message))
    .order_by(bodies.c.message)
)
"""Arguments of `body_fault` for each stored body."""
_BODIES = STORED_BODIES.where(bodies.c.message > sa.bindparam("_after")).limit(sa.bindparam("_most"))
_SERVOS = sa.select(sa.func.count()).select_from(twins)
_NEWEST = (
    sa.select(messages.c.boot, messages.c.sequence)
    .where(WINDOWS, messages.c.servo == sa.bindparam("_servo"))
    .order_by(messages.c.id.desc())
    .limit(sa.bindparam("_newest"))
)
_BETWEEN = sa.select(messages.c.sequence).where(
    WINDOWS,
    messages.c.servo == sa.bindparam("_servo"),
    messages.c.boot == sa.bindparam("_boot"),
    messages.c.sequence.between(sa.bindparam("_first"), sa.bindparam("_last")),
)
