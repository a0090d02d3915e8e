"""Fixtures for tests of the store: every test on SQLite and on PostgreSQL."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import postgres
import pytest
import sqlalchemy as sa
from store_cases import MORE, NEXT, SYSTEMS, NewAddress, postgresql_addresses, sqlite_addresses

from servotwin.store import migrate as migrations
from servotwin.store.engine import transaction
from servotwin.store.schema import metadata
from servotwin.store.store import Store, open_store


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[postgres.Server]:
    """One for all tests of this process: its start takes longer than most of them."""
    with postgres.running() as server:
        yield server


@pytest.fixture(scope="module", params=SYSTEMS)
def new_address(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> NewAddress:
    if request.param == "sqlite":
        return sqlite_addresses(tmp_path_factory.mktemp("stores"))
    return postgresql_addresses(request.getfixturevalue("postgres_server"))


@pytest.fixture(scope="module")
def opened(new_address: NewAddress) -> Iterator[Store]:
    store = open_store(new_address())
    yield store
    store.close()


@pytest.fixture
def store(opened: Store) -> Store:
    """An empty one."""
    with transaction(opened.engines.writer) as connection:
        for table in reversed(metadata.sorted_tables):
            connection.execute(sa.delete(table))
    return opened


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/store.db"


@pytest.fixture
def later_scripts(tmp_path: Path) -> Path:
    """The migrations of some later servotwin."""
    folder = tmp_path / "migrations"
    shutil.copytree(migrations.SCRIPTS, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "versions" / f"{NEXT}_more.py").write_text(MORE)
    return folder
