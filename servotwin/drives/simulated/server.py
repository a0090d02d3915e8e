"""Server of a simulated machine, common to both roles: it listens, serves one client at a time, and runs on between."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Protocol

from servotwin.drives.simulated import wire
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.errors import InvalidInput

POLL_S = 0.01
"""Interval at which the plant advances while no client is connected."""

_HELLO_S = 1.0
"""Longest time that a new client may take to send its HELLO: a silent one would lock out the edge."""

OnSample = Callable[[int, float], None]
"""Called between samples with the present sample's number and the clock's time (s); not in lock-step."""


def ignore_sample(_sample: int, _now: float) -> None:
    """Do nothing between samples."""


class StopRequest:
    """Request that a machine stop between two samples.

    As the handler of a signal it only sets a flag and ends the wait: an exception raised in a handler may surface in
    the middle of compiled code, which does not survive it (a machine at 20 kHz crashed every other time).

    Attributes
    ----------
    requested : bool
    readable : socket
        Becomes readable with the request, so that a `select` ends.
    """

    def __init__(self) -> None:
        self.requested = False
        self._writable, self.readable = socket.socketpair()
        self._connection: socket.socket | None = None

    def __call__(self, *_: object) -> None:
        self.requested = True
        with suppress(OSError):
            self._writable.send(b"e")
        self._disconnect()

    def close(self) -> None:
        """Close its sockets."""
        self._writable.close()
        self.readable.close()

    @contextmanager
    def disconnecting(self, connection: socket.socket) -> Iterator[None]:
        """Shut a client's connection down when the machine stops."""
        self._connection = connection
        try:
            if self.requested:
                self._disconnect()
            yield
        finally:
            self._connection = None

    def _disconnect(self) -> None:
        if self._connection is not None:
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)


class Server(Protocol):
    """Serves the plant in one role."""

    def serve(self, connection: socket.socket) -> None:
        """Serve one client until it disconnects (`ConnectionError` or a return) or the run is over."""

    def run_alone(self) -> float | None:
        """Simulate what is due without a client; return when to call again. None: when a client comes."""

    @property
    def over(self) -> bool:
        """True once the run has ended."""


def run(
    server: Server, listener: socket.socket, settings: MachineSettings, name: bytes, stop: StopRequest | None = None
) -> None:
    """Serve one client after the other until a client has received the end of the run.

    Between clients the plant runs on.

    Parameters
    ----------
    name : bytes
        8 bytes that name this run of the machine.
    stop : StopSignal, optional
        Stops it earlier.
    """
    with nullcontext(stop) if stop is not None else closing(StopRequest()) as signal:
        _serve(server, listener, settings, name, signal)


def _serve(server: Server, listener: socket.socket, settings: MachineSettings, name: bytes, stop: StopRequest) -> None:
    while not stop.requested:
        with _client(server, listener, stop) as connection:
            if connection is None:
                return
            try:
                _handshake(connection, settings, name)
                server.serve(connection)
            except OSError:
                continue
        if server.over:
            return


@contextmanager
def listening(address: wire.Address) -> Iterator[socket.socket]:
    """Open a listening socket; a path is accessible to its owner only, and is removed in the end.

    Raises
    ------
    InvalidInput
        Another process listens there, or the address cannot be used.
    """
    path = None if address.path is None else Path(address.path)
    with wire.new_socket(address) as listener:
        try:
            # A killed machine leaves its socket's path behind; that of a machine which runs must stay.
            if path is not None and path.is_socket() and not _answers(address):
                path.unlink()
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(wire.socket_address(address))
            if path is not None:
                path.chmod(0o600)
            listener.listen()
        except OSError as error:
            raise InvalidInput(f"listen = {str(address)!r}: cannot be listened at ({error.strerror})") from None
        try:
            yield listener
        finally:
            if path is not None:
                path.unlink(missing_ok=True)


def address_in_use(listener: socket.socket, address: wire.Address) -> wire.Address:
    """Address on which the socket listens, with the port that replaced port 0."""
    return address if address.path is not None else address._replace(port=listener.getsockname()[1])


def start_pace(settings: MachineSettings) -> Pace | None:
    """Start the schedule of samples now; None in lock-step."""
    if settings.speed == 0.0:
        return None
    return Pace(settings.rate, settings.speed, settings.slack, time.monotonic())


@contextmanager
def _client(server: Server, listener: socket.socket, stop: StopRequest) -> Iterator[socket.socket | None]:
    """Yield the next client, with the plant running on until it comes; None: the machine must stop."""
    ready: list[socket.socket] = []
    while not ready:
        due = server.run_alone()
        timeout = None if due is None else max(0.0, due - time.monotonic())
        ready = select.select([listener, stop.readable], [], [], timeout)[0]
    if stop.requested:
        yield None
        return
    with listener.accept()[0] as connection, stop.disconnecting(connection):
        wire.disable_nagle(connection)
        yield connection


def _handshake(connection: socket.socket, settings: MachineSettings, name: bytes) -> None:
    """Receive the client's HELLO and send the WELCOME; raises ConnectionError where they do not fit."""
    wire.set_timeout(connection, _HELLO_S)
    magic, version, role = wire.HELLO.unpack(wire.receive(connection, wire.HELLO.size))
    own = wire.ROLES[settings.role]
    # Sent to a client of another role too: it reports the mismatch to its user.
    connection.sendall(wire.WELCOME.pack(wire.MAGIC, wire.VERSION, own, name, settings.rate))
    if (magic, version, role) != (wire.MAGIC, wire.VERSION, own):
        raise ConnectionError("a client of another protocol or role")


def _answers(address: wire.Address) -> bool:
    """True where a process listens at the path."""
    with wire.new_socket(address) as trial:
        return trial.connect_ex(wire.socket_address(address)) == 0
