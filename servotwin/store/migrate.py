"""Migration of a database to the newest schema."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from servotwin.errors import InvalidInput
from servotwin.store.engine import POSTGRESQL, public_address, transaction
from servotwin.store.schema import REVISION, metadata
from servotwin.store.stored_value import WrongValue

log = logging.getLogger(__name__)

_REVISION = re.compile("[0-9]{4}")
VERSIONS = "servotwin_version"
"""Name of the table that holds the revision."""
_OUTBOXS_TABLES = {"windows", "letters", "acknowledged"}
SCRIPTS = Path(__file__).with_name("migrations")
# Key of PostgreSQL's advisory lock: an arbitrary number, the same in every process that migrates.
_LOCK = 7461127


def migrate(engine: sa.Engine, to: str = REVISION, scripts: Path = SCRIPTS) -> None:
    """Upgrade a database to a revision with a folder of scripts; one that is up to date stays as it is.

    Raises
    ------
    InvalidInput
        The database is of a newer servotwin, or holds tables that are not servotwin's.
    StoreUnavailable
        It cannot be read or written.
    """
    with transaction(engine) as connection:
        if connection.dialect.name == POSTGRESQL:
            # Another process may migrate for minutes; and this one reads its scripts between two statements.
            connection.execute(sa.text("SET LOCAL lock_timeout = 0"))
            connection.execute(sa.text("SET LOCAL idle_in_transaction_session_timeout = 0"))
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK)))
        # Read under the lock: another process may have migrated meanwhile.
        current = _revision(connection)
        if current != to:
            _check(connection, current, to)
            _upgrade(connection, to, scripts)
    if current is None:
        log.info("new store", extra={"store": public_address(engine.url)})


def is_newest(engine: sa.Engine) -> bool:
    """True where a database needs no migration; it is only read. Raises StoreUnavailable."""
    with transaction(engine) as connection:
        return _revision(connection) == REVISION


def newer_revision(engine: sa.Engine) -> str:
    """Revision of a database that a newer servotwin has migrated; empty: none has. Raises StoreUnavailable."""
    with transaction(engine) as connection:
        revision = _revision(connection)
    return revision if revision is not None and revision > REVISION else ""


def _revision(connection: sa.Connection) -> str | None:
    """Read the revision of a database; None: an empty one."""
    if not sa.inspect(connection).has_table(VERSIONS):
        return None
    return checked_revision(connection.execute(sa.text(f"SELECT version_num FROM {VERSIONS}")).scalar())


def checked_revision(revision: Any) -> str:
    """Return the revision that a database names; raises WrongValue where it is none."""
    if isinstance(revision, str) and _REVISION.fullmatch(revision):
        return revision
    held = "nothing" if revision is None else "bytes" if isinstance(revision, bytes) else repr(revision)
    raise WrongValue(f"column {VERSIONS}.version_num holds {held} where the four digits of a schema belong")


def _check(connection: sa.Connection, current: str | None, to: str) -> None:
    where = public_address(connection.engine.url)
    if current is None:
        tables = set(sa.inspect(connection).get_table_names())
        # A PostgreSQL may be shared with other programs; a file with tables is another program's, or an edge's outbox.
        foreign = sorted(tables & set(metadata.tables) if connection.dialect.name == POSTGRESQL else tables)
        if tables >= _OUTBOXS_TABLES and connection.dialect.name != POSTGRESQL:
            raise InvalidInput(f"store {where}: is the outbox of an edge, no store of a twin; give another one")
        if foreign:
            raise InvalidInput(f"store {where}: holds a table {foreign[0]!r} that is not servotwin's; give another one")
    elif current > to:
        raise InvalidInput(
            f"store {where}: its schema {current} is newer than {to}, the newest that this servotwin knows; "
            "install the newer servotwin"
        )


def _upgrade(connection: sa.Connection, to: str, scripts: Path) -> None:
    # Imported late: alembic takes longer to import than the rest of the store and is rarely needed.
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(scripts).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, to)
