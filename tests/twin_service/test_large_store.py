"""A store whose check takes longer than any pause between two checks: it is checked to its end all the same."""

import asyncio
import time
from contextlib import closing

import pytest
from service_system import served, twin_file
from store_cases import SYSTEMS, postgresql_addresses
from watched_store import send, serve, until

from servotwin.store import engine
from servotwin.store.integrity import IntegrityReport
from servotwin.store.store import open_store
from servotwin.twin_service import store_watch
from servotwin.twin_service.twin_file import service_of

pytest_plugins = ("store_fixtures",)

MANY = 200_000
ROWS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < {}) "
    "INSERT INTO evidence (servo, kind, status, created, body) SELECT 'ax-1', 'trend', '', 0, {} FROM n"
)


@pytest.fixture(params=SYSTEMS)
def path(request: pytest.FixtureRequest, tmp_path):
    """A twin's file, with its store in each system."""
    if request.param == "sqlite":
        return twin_file(tmp_path)
    address = postgresql_addresses(request.getfixturevalue("postgres_server"))()
    return twin_file(tmp_path, f'store = "{address}"')


@pytest.mark.slow
def test_a_store_is_written_again_however_long_its_check_takes(path, monkeypatch):
    for name in ("_TELL_S", "_RECHECK_S", "_PAGES_S", "_LONGEST_RECHECK_S"):
        monkeypatch.setattr(store_watch, name, 0.002)

    async def body(system, client):
        assert await send(client, 0) == [201]
        with system.store.writing() as connection:
            nothing = "''" if connection.dialect.name == "postgresql" else "x''"
            connection.exec_driver_sql(ROWS.format(MANY, nothing))
        system.watch._found(IntegrityReport(("a page could not be read",), False))
        assert await send(client, 1) == [503]
        await until(lambda: not system.watch.fault)
        assert await send(client, 1) == [201]

    serve(path, body)


@pytest.mark.slow
def test_a_twin_that_ends_does_not_wait_for_a_check(tmp_path, postgres_server, monkeypatch):
    """Here of a table that somebody locks, which takes as long as one that is very large."""
    monkeypatch.setattr(store_watch, "_TELL_S", 0.01)
    monkeypatch.setattr(engine, "_BUSY_S", 60.0)
    path = twin_file(tmp_path, f'store = "{postgresql_addresses(postgres_server)()}"')

    async def body(locking) -> float:
        async with served(path) as (system, _client):
            system.store.engines.dispose()  # connections that were made before know the limit of then
            locking.exec_driver_sql("LOCK TABLE bodies IN ACCESS EXCLUSIVE MODE")
            system.watch._found(IntegrityReport(("a page could not be read",), False))
            await asyncio.sleep(1.0)
            begun = time.monotonic()
        return time.monotonic() - begun

    with closing(open_store(service_of(path).store)) as other, other.engines.writer.begin() as locking:
        assert asyncio.run(body(locking)) < 10.0
