"""`servotwin twin check`: check every page of the twin's store, and every body against its digest.

Commands that read a store check its pages for a second, and end with the same sentences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from servotwin.cli.output import progress_bar
from servotwin.errors import InvalidInput
from servotwin.store.encoded_contents import encoding_faults
from servotwin.store.engine import POSTGRESQL, SQLITE, StoreUnavailable
from servotwin.store.integrity import IntegrityReport, check_bodies, check_pages, newest_message, read_error
from servotwin.store.store import Store
from servotwin.store.stored_value import WrongRow
from servotwin.twin_service.command import open_existing_store
from servotwin.twin_service.store_mark import lost_messages
from servotwin.twin_service.twin_file import service_of

_BODIES = 256
_READING_S = 1.0
"""s for which a command that reads a store checks its pages: the tables that it reads are the first ones."""
_REMEDY = {SQLITE: "end the twin, move the file away", POSTGRESQL: "end all twins, create an empty database"}


def check_store(config: Path) -> None:
    """Check the store of a twin's file, and print one line.

    Raises
    ------
    InvalidInput
        The store is damaged, has lost messages, or cannot be opened.
    """
    with closing(open_existing_store(service_of(config))) as store:
        _require_whole(store, config, math.inf)
        checked = _check_bodies(store)
        _require_sound(store, IntegrityReport(encoding_faults(store)))
        print(f"store {store.name}: is sound ({checked} messages agree with their digests)")


@contextmanager
def store_to_read(config: Path) -> Iterator[Store]:
    """Open the store of a twin's file for a block that shows what is in it; say after it what is wrong with the store.

    Raises
    ------
    InvalidInput
        The store is damaged, has lost messages, or cannot be opened.
    """
    with closing(open_existing_store(service_of(config))) as store, telling_after(lambda: _require_all(store, config)):
        yield store


@contextmanager
def telling_after(require_sound: Callable[[], None]) -> Iterator[None]:
    """Raise the fault of a store after a block that shows what can still be read, or in place of the block's error."""
    try:
        yield
    except (InvalidInput, StoreUnavailable):
        require_sound()
        raise
    require_sound()


def _require_all(store: Store, config: Path) -> None:
    """Check the pages for a moment, and that no servo is left out."""
    _require_whole(store, config, _READING_S)
    if store.aside:
        raise InvalidInput(
            f"store {store.name}: servos that are set aside are left out ({_clauses(store.aside.values())}): put their "
            "rows right or delete them, as the operator's guide says; the twin takes them back by itself"
        )


def _clauses(wrong: Iterable[WrongRow]) -> str:
    return "; ".join(f"{row.servo}: {row.clause}" for row in wrong)


def _require_whole(store: Store, config: Path, seconds: float) -> None:
    """Check the pages for a time, s, and the number of the newest message."""
    _require_sound(store, check_pages(store, seconds))
    if lost := lost_messages(store, config):
        raise InvalidInput(
            f"store {store.name}: has lost messages ({lost}); a twin that starts on it asks the edges for the "
            "windows that they still keep, or end the twin and restore a newer backup"
        )


def _check_bodies(store: Store) -> int:
    """Compare all bodies; returns their number."""
    after, checked, complete = 0, 0, False
    with progress_bar() as progress:
        task = progress.add_task("comparing", total=newest_message(store))
        while not complete:
            result, after = check_bodies(store, after, _BODIES)
            _require_sound(store, result)
            checked, complete = checked + result.checked, result.complete
            progress.update(task, completed=after)
    return checked


def _require_sound(store: Store, result: IntegrityReport) -> None:
    if result.faults:
        if error := read_error(store):
            raise InvalidInput(
                f"store {store.name}: the disk does not give it ({error}); it need not be damaged: see to the disk, "
                "its cables and the system's log, and check again"
            )
        remedy = f"{_REMEDY[store.engines.writer.dialect.name]} and restore a backup"
        if result.rows:
            servos = ", ".join(sorted(str(row.servo) for row in result.rows))
            remedy = f"rows of {servos}: put them right or delete them, as the operator's guide says, or {remedy}"
        raise InvalidInput(
            f"store {store.name}: is damaged ({'; '.join(result.faults)}); {remedy}: edges send again what they still "
            "keep"
        )
