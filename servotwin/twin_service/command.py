"""`servotwin twin`: the service as a process."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import sqlalchemy as sa

from servotwin.config.named_file import check_named
from servotwin.config.table import named, of_key
from servotwin.errors import InvalidInput
from servotwin.link.broker import check_broker
from servotwin.runtime.locks import lock_beside, locked
from servotwin.store.engine import StoreUnavailable, parse_address, sqlite_file
from servotwin.store.store import Store, open_store
from servotwin.twin_service.auth import read_tokens
from servotwin.twin_service.config import ServiceConfig
from servotwin.twin_service.http_server import HttpServer, check_tls
from servotwin.twin_service.listening import listening_socket, raise_descriptor_limit
from servotwin.twin_service.monitoring import configure_logging
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import TwinFile, read_twin
from servotwin.twin_service.worker_pool import WorkerPool, pool_of

log = logging.getLogger(__name__)


def run(path: Path, port: int | None = None) -> None:
    """Serve until SIGINT or SIGTERM; prints the address as one line once requests are accepted.

    Raises
    ------
    InvalidInput
        The file, the tokens, the store or the address cannot be used, or another process uses the store.
    """
    twin = read_twin(path, models=False)
    _check(twin)
    configure_logging(twin.service.log_level)
    pool = pool_of(twin)
    with (
        # First: a worker checks the models before a store is made.
        pool.launched(),
        _exclusive_store(twin.service.store),
        closing(_open_configured_store(twin.service)) as store,
        listening_socket(twin.service, port) as listener,
    ):
        check_fleet(store, twin.service.tokens)
        serve(twin, store, listener, pool)


def _check(twin: TwinFile) -> None:
    """Check what the service needs besides its store, before that is made; raises InvalidInput."""
    config, table = twin.service, twin.service_table
    with named(table):
        check_tls(config)
    if config.tokens is not None:
        with of_key(table, "tokens"):
            read_tokens(config.tokens)
    if config.mqtt is not None:
        check_broker(config.mqtt.broker)


def serve(twin: TwinFile, store: Store, listener: socket.socket, pool: WorkerPool) -> None:
    """Serve on a listening socket; raises SystemExit where the service does not start."""
    if twin.service.tokens is None:
        log.warning("no tokens: whoever reaches this machine itself may do everything")
    raise_descriptor_limit()
    service = TwinService(twin, store, pool=pool)
    server = HttpServer(
        twin.service, service.http_app(), service.end_streams, service.unauthenticated, lambda: service.dispatching
    )
    asyncio.run(server.serve([listener]))


def _open_configured_store(config: ServiceConfig) -> Store:
    """Open the store, with its password and the certificates that its server's is checked against."""
    address = config.store
    if config.store_ca is not None:
        verified = {"sslmode": "verify-full", "sslrootcert": str(config.store_ca)}
        address = sa.make_url(address).update_query_dict(verified).render_as_string(hide_password=False)
    return open_store(address, config.store_password)


def check_fleet(store: Store, tokens: Path | None) -> None:
    """Have a new store keep the name of its fleet, which is in the file of tokens.

    Servos of two fleets may have the same names: one machine's updates would follow from the other's past.

    Raises
    ------
    InvalidInput
        The store is another fleet's.
    """
    fleet = known = "" if tokens is None else read_tokens(tokens).fleet
    with suppress(StoreUnavailable):  # a full disk: the service says so itself, and recovers when there is room
        known = store.fleet(fleet) if fleet else ""
    if known != fleet:
        raise InvalidInput(
            f"store {store.name}: belongs to the fleet {known!r}, and {tokens} to {fleet!r}; give the store of this "
            f"fleet, or, where the tokens were made anew for the same machines, write fleet = {known!r} there"
        )


def open_existing_store(config: ServiceConfig) -> Store:
    """Open the store of a twin that has run; a reader creates none.

    Raises
    ------
    InvalidInput
        There is none, or it cannot be opened.
    """
    file = sqlite_file(parse_address(config.store))
    if file is not None:
        check_named(file, "store ")
    if file is not None and not file.is_file():
        raise InvalidInput(f"store {file}: there is no such file; the twin makes it when it first runs")
    if file is not None and not any(_size(file.with_name(file.name + end)) for end in ("", "-wal")):
        raise InvalidInput(
            f"store {file}: is empty: cut short, or never written; restore a backup, or let the twin begin anew"
        )
    return _open_configured_store(config)


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0


@contextmanager
def _exclusive_store(store: str) -> Iterator[None]:
    """Lock an SQLite store for this process; PostgreSQL is shared and not locked.

    Two services on one SQLite store would release each other's leases and not notify each other's edges.

    Raises
    ------
    InvalidInput
        It is no file, another process has the lock, or the lock file cannot be made.
    """
    file = sqlite_file(parse_address(store))
    with ExitStack() as stack:
        if file is not None:
            check_named(file, "store ")
            try:
                stack.enter_context(locked(lock_beside(file)))
            except BlockingIOError:
                raise InvalidInput(
                    f"store {file}: another twin works on it; end that one first, or let several share a PostgreSQL"
                ) from None
            except OSError as error:
                raise InvalidInput(f"{lock_beside(file)}: cannot be made ({error.strerror})") from None
            _check_one_name(file)
        yield


def _check_one_name(file: Path) -> None:
    """Refuse a file with several names: lock and log are beside each, so that two twins would damage it unnoticed."""
    if file.is_file() and (names := file.stat().st_nlink) > 1:
        raise InvalidInput(
            f"store {file}: has {names} names (hard links), under each of which another twin could write it; "
            f"copy it to a name of its own: cp {file.name} copy && mv copy {file.name}"
        )
