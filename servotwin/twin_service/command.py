"""`servotwin twin`: the service as a process."""

from __future__ import annotations

import asyncio
import logging
import resource
import signal
import socket
import ssl
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import sqlalchemy as sa
import uvicorn

from servotwin.errors import InvalidInput
from servotwin.store.engine import parse_address, sqlite_file
from servotwin.store.store import Store, open_store
from servotwin.twin_service import logs
from servotwin.twin_service.alone import alone
from servotwin.twin_service.config import ServiceConfig
from servotwin.twin_service.protocol import Protocol
from servotwin.twin_service.system import System
from servotwin.twin_service.twin_file import TwinFile, read_twin

log = logging.getLogger(__name__)
BACKLOG = 2048
GRACE_S = 20
"""s that requests may take to their end when the service is told to stop."""
CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Of TLS 1.2; those of 1.3 are all good. Older uvicorns would name some without any encryption."""
IDLE_S = 75
"""s after which a connection that says nothing is closed."""


def run(path: Path, port: int | None = None) -> None:
    """Serve until a signal says stop; the address is printed as one line once requests are taken.

    Raises
    ------
    InvalidInput
        The file, the tokens, the store or the address are not usable, or another process has the store.
    """
    twin = read_twin(path)
    check_tls(twin.service)
    logs.configure(twin.service.log_level)
    with (
        alone(twin.service.store),
        closing(store_of(twin.service)) as store,
        listening(twin.service, port) as listener,
    ):
        serve(twin, store, listener)


def serve(twin: TwinFile, store: Store, listener: socket.socket) -> None:
    """Serve on a socket that listens; SystemExit where it cannot begin."""
    if twin.service.tokens is None:
        log.warning("no tokens: whoever reaches this machine itself may do everything")
    _raise_file_limit()
    system = System(twin, store)
    asyncio.run(_Server(config_of(twin.service, system), system).serve([listener]))


def store_of(config: ServiceConfig) -> Store:
    """The store, open."""
    address = config.store
    if config.store_password is not None:
        address = sa.make_url(address).set(password=config.store_password).render_as_string(hide_password=False)
    return open_store(address)


def present_store(config: ServiceConfig) -> Store:
    """The store of a twin that has run, open: whoever only reads makes none.

    Raises
    ------
    InvalidInput
        There is none, or it cannot be opened.
    """
    file = sqlite_file(parse_address(config.store))
    if file is not None and not file.is_file():
        raise InvalidInput(f"store {file}: there is no such file; the twin makes it when it first runs")
    return store_of(config)


def listening(config: ServiceConfig, port: int | None = None) -> socket.socket:
    """A socket at the service's address.

    Raises
    ------
    InvalidInput
        The address is taken, or is not this machine's.
    """
    where = config.bind, config.port if port is None else port
    family = socket.AF_INET6 if ":" in config.bind else socket.AF_INET
    # Named as TCP: asyncio sends small packets at once only where a socket says that it is; else answers take 50 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(BACKLOG)
        return listener
    except OSError as error:
        listener.close()
        raise InvalidInput(f"bind = {where[0]!r}, port = {where[1]}: cannot listen there ({error.strerror})") from None


def check_tls(config: ServiceConfig) -> None:
    """Refuse a certificate and a key that are none, or do not belong together, before anything listens.

    Raises
    ------
    InvalidInput
    """
    certificate, key = config.tls_certificate, config.tls_key
    if certificate is None or key is None:
        return
    try:
        # A password is not asked for: nobody sits before a service.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"tls_certificate {certificate}, tls_key {key}: are no certificate with its own key, in PEM and without a "
            f"password ({getattr(error, 'reason', None) or error})"
        ) from None


def config_of(config: ServiceConfig, system: System) -> uvicorn.Config:
    """How uvicorn serves it."""
    return uvicorn.Config(
        system.app,
        http=Protocol,
        ws="none",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        backlog=BACKLOG,
        timeout_keep_alive=IDLE_S,
        timeout_graceful_shutdown=GRACE_S,
        ssl_certfile=config.tls_certificate,
        ssl_keyfile=config.tls_key,
        ssl_ciphers=CIPHERS,
    )


class _Server(uvicorn.Server):
    """Says where it is once it takes requests, and lets those that wait for messages go when it has to end."""

    def __init__(self, config: uvicorn.Config, system: System) -> None:
        super().__init__(config)
        self._system = system

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Both signals mean: come to an end; it is a good one, so that they are not raised again afterwards."""
        former = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for each in sockets or ():
            print(f"servotwin twin: listening on {_url(each, self.config.is_ssl)}", flush=True)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._system.outgoing.close()
        await super().shutdown(sockets)


def _url(listener: socket.socket, tls: bool) -> str:
    host, port = listener.getsockname()[:2]
    return f"{'https' if tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"


def _raise_file_limit() -> None:
    """As many connections as the system lets one process have."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
