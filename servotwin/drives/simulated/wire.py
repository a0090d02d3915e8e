"""Protocol between a simulated machine and its client: messages of fixed sizes, little-endian.

Client: HELLO, once; machine: WELCOME, once. Then in control the machine sends a SAMPLE at each sample instant and the
client answers each with a VOLTAGE. In supervise the client sends a REQUEST at a time and the machine answers each with
a REPLY, which `count` samples follow (signal after signal, doubles) or, where it refuses, `count` bytes of text.
"""

import socket
import struct
from typing import NamedTuple

from servotwin.errors import InvalidInput

MAGIC, VERSION = b"STDR", 1
CONTROL, SUPERVISE = 1, 2
ROLES = {"control": CONTROL, "supervise": SUPERVISE}
HELLO = struct.Struct("<4sHBx")  # magic, version, role
WELCOME = struct.Struct("<4sHB x8sd")  # magic, version, role; the machine's run, rate in Hz
SAMPLE = struct.Struct("<qdddd")  # number, reference, theta_m, position, lag in s
VOLTAGE = struct.Struct("<d")  # V; one that is not finite lets the last one hold
REQUEST = struct.Struct("<BB2xIq8d")  # kind, with gains, most; number or version; tolerance or offset, gains
REPLY = struct.Struct("<B3xIqqd")  # kind, count; first, version, lag in s
READ, WRITE, MOVE = 1, 2, 3
DONE, REFUSED, OVER = 0, 1, 2
NOW, LAST = -1, -1
"""Reads from the present sample on; the number of a sample that is none, since the run is over."""

MOST = 4096
"""Samples in one block."""

LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Address(NamedTuple):
    """Address of a machine: a path, or a host on this machine and a port."""

    path: str | None
    host: str = ""
    port: int = 0

    def __str__(self) -> str:
        return f"unix:{self.path}" if self.path is not None else f"{self.host}:{self.port}"


def address_of(text: str) -> Address:
    """From "unix:PATH" or "127.0.0.1:PORT".

    Raises
    ------
    InvalidInput
        It is neither: this protocol knows no password, so it does not leave the machine.
    """
    kind, _, rest = text.partition(":")
    if kind == "unix" and rest:
        return Address(rest)
    host, _, port = text.rpartition(":")
    if host.strip("[]") not in LOOPBACK or not port.isdecimal() or int(port) > 65535:
        raise InvalidInput(f"machine address {text!r} is not allowed; give unix:PATH or 127.0.0.1:PORT")
    return Address(None, host.strip("[]"), int(port))


def new_socket(address: Address) -> socket.socket:
    """A socket of the address's family."""
    family = socket.AF_UNIX if address.path is not None else socket.AF_INET6 if ":" in address.host else socket.AF_INET
    return socket.socket(family, socket.SOCK_STREAM)


def place(address: Address) -> str | tuple[str, int]:
    """As `socket` wants it."""
    return address.path if address.path is not None else (address.host, address.port)


def at_once(connection: socket.socket) -> None:
    """Send without waiting for more."""
    if connection.family != socket.AF_UNIX:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def patient(connection: socket.socket, seconds: float) -> None:
    """Let receiving and sending give up after a time; 0: never. One system call each, unlike `settimeout`."""
    limit = struct.pack("ll", int(seconds), int(seconds % 1.0 * 1e6))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


def receive(connection: socket.socket, size: int) -> bytes:
    """So many bytes.

    Raises
    ------
    BlockingIOError
        Nothing came in time.
    ConnectionError
        The other end is gone, or stopped within a message.
    """
    data = connection.recv(size, socket.MSG_WAITALL)
    if len(data) != size:
        raise ConnectionError("closed by the other end" if not data else "stopped within a message")
    return data
