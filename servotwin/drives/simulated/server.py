"""Server of a simulated machine, the same in both roles: a listening socket, one client at a time, the clock."""

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

ALONE = 0.01
"""s from one look at the plant to the next while nobody is connected."""

GREETING = 1.0
"""s within which a new client must say what it wants."""

Tend = Callable[[int, float], None]
"""Told the present sample and the clock's time (s), now and then, where the clock drives the machine."""


def untended(_sample: int, _now: float) -> None:
    """Nothing has to be done between samples."""


class Ending:
    """Lets a machine end between two samples.

    As a signal's handler it only closes what is waited for: an exception raised in a handler may come out in the
    middle of a call of compiled code, which does not survive it (a machine at 20 kHz fell every other time).

    Attributes
    ----------
    wanted : bool
    woken : socket
        Becomes readable.
    """

    def __init__(self) -> None:
        self.wanted = False
        self._wake, self.woken = socket.socketpair()
        self._connection: socket.socket | None = None

    def __call__(self, *_: object) -> None:
        self.wanted = True
        with suppress(OSError):
            self._wake.send(b"e")
        self._hang_up()

    def close(self) -> None:
        """Let go of its sockets."""
        self._wake.close()
        self.woken.close()

    @contextmanager
    def hanging_up(self, connection: socket.socket) -> Iterator[None]:
        """A client's connection ends with the machine."""
        self._connection = connection
        try:
            if self.wanted:
                self._hang_up()
            yield
        finally:
            self._connection = None

    def _hang_up(self) -> None:
        if self._connection is not None:
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)


class Server(Protocol):
    """One role of a machine."""

    def serve(self, connection: socket.socket) -> None:
        """One client, until it goes away (`ConnectionError` or a return) or the run is over."""

    def run_alone(self) -> float | None:
        """Whatever is due without a client; returns when to look again, None: when one comes."""

    @property
    def over(self) -> bool:
        """The run has ended."""


def run(
    server: Server, listener: socket.socket, settings: MachineSettings, name: bytes, ending: Ending | None = None
) -> None:
    """Serve one client after the other, the plant running on between them, until a client knows that the run is over.

    Parameters
    ----------
    name : bytes
        8 bytes that name this run of the machine.
    ending : Ending, optional
        Ends it before.
    """
    with nullcontext(ending) if ending is not None else closing(Ending()) as asked:
        _serve(server, listener, settings, name, asked)


def _serve(server: Server, listener: socket.socket, settings: MachineSettings, name: bytes, ending: Ending) -> None:
    while not ending.wanted:
        with _client(server, listener, ending) as connection:
            if connection is None:
                return
            try:
                _greet(connection, settings, name)
                server.serve(connection)
            except OSError:
                continue
        if server.over:
            return


@contextmanager
def listening(address: wire.Address) -> Iterator[socket.socket]:
    """A socket that listens there; a path is the owner's only, and taken away in the end.

    Raises
    ------
    InvalidInput
        Another machine listens there, or nobody can.
    """
    path = None if address.path is None else Path(address.path)
    with wire.new_socket(address) as listener:
        try:
            if path is not None and path.is_socket() and not _answers(address):
                path.unlink()
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(wire.place(address))
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
    """Address in use: port 0 became another one."""
    return address if address.path is not None else address._replace(port=listener.getsockname()[1])


def start_pace(settings: MachineSettings) -> Pace | None:
    """The clock, from now on; None: lock-step."""
    if settings.speed == 0.0:
        return None
    return Pace(settings.rate, settings.speed, settings.slack, time.monotonic())


@contextmanager
def _client(server: Server, listener: socket.socket, ending: Ending) -> Iterator[socket.socket | None]:
    """The next client, the plant running on until it comes; None: it is time to end."""
    came: list[socket.socket] = []
    while not came:
        again = server.run_alone()
        waited = None if again is None else max(0.0, again - time.monotonic())
        came = select.select([listener, ending.woken], [], [], waited)[0]
    if ending.wanted:
        yield None
        return
    with listener.accept()[0] as connection, ending.hanging_up(connection):
        wire.at_once(connection)
        yield connection


def _greet(connection: socket.socket, settings: MachineSettings, name: bytes) -> None:
    """Hear what the client wants, and say what there is."""
    wire.patient(connection, GREETING)
    magic, version, role = wire.HELLO.unpack(wire.receive(connection, wire.HELLO.size))
    own = wire.ROLES[settings.role]
    connection.sendall(wire.WELCOME.pack(wire.MAGIC, wire.VERSION, own, name, settings.rate))
    if (magic, version, role) != (wire.MAGIC, wire.VERSION, own):
        raise ConnectionError("a client of another protocol or role")


def _answers(address: wire.Address) -> bool:
    """True where a process listens at a path."""
    with wire.new_socket(address) as trial:
        return trial.connect_ex(wire.place(address)) == 0
