"""Protocol between a simulated machine and its client: messages of fixed sizes, little-endian.

The client sends HELLO once, and the machine answers WELCOME once. In the role control the machine then sends a SAMPLE
at each sample instant, and the client answers each with a VOLTAGE. In the role supervise the client sends one REQUEST
at a time, and the machine answers each with a REPLY; `count` samples follow it (signal after signal, doubles) or, after
a refusal, `count` bytes of text.
"""

import socket
import struct
from typing import NamedTuple

from msgspec import convert
from msgspec.structs import astuple

from servotwin.errors import InvalidInput
from servotwin.messages import AnyGains, CascadeGains, Gains, LinearGains

MAGIC, VERSION = b"STDR", 5
CONTROL, SUPERVISE = 1, 2
ROLES = {"control": CONTROL, "supervise": SUPERVISE}
HELLO = struct.Struct("<4sHBx")  # magic, version, role
WELCOME = struct.Struct("<4sHB x8sd")  # magic, version, role; the machine's run, rate in Hz
SAMPLE = struct.Struct("<qdddd")  # number, reference, theta_m, position, lag in s
VOLTAGE = struct.Struct("<d")  # V; where it is not finite the last one holds
REQUEST = struct.Struct("<BB2xIq15d")  # kind, kind of gains, most; number or version; tolerance or offset, gains
REPLY = struct.Struct("<B3xIqqd")  # kind, count; first, version, lag in s
READ, WRITE, MOVE = 1, 2, 3
DONE, REFUSED, OVER = 0, 1, 2
NOW, LAST = -1, -1
"""READ with number NOW begins at the present sample; a SAMPLE with number LAST ends the run."""

MAX_SAMPLES = 4096
"""Largest number of samples in one block: 128 KiB."""

LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Address(NamedTuple):
    """Address of a machine: a path, or a host on this machine and a port."""

    path: str | None
    host: str = ""
    port: int = 0

    def __str__(self) -> str:
        return f"unix:{self.path}" if self.path is not None else f"{self.host}:{self.port}"


class PackedGains(NamedTuple):
    """Gains in a request: their kind (0: none), and their numbers, all as doubles, with zeros behind them."""

    kind: int
    numbers: tuple[float, ...]


_KINDS: tuple[type[AnyGains], ...] = (Gains, CascadeGains, LinearGains)
_NUMBERS = len(Gains.__struct_fields__)
NO_GAINS = PackedGains(0, (0.0,) * _NUMBERS)


def packed_gains(gains: AnyGains | None) -> PackedGains:
    """Gains of any law as a request has them."""
    if gains is None:
        return NO_GAINS
    numbers = astuple(gains)
    return PackedGains(1 + _KINDS.index(type(gains)), (*numbers, *(0.0,) * (_NUMBERS - len(numbers))))


def gains_of(packed: PackedGains) -> AnyGains | None:
    """Gains of a request.

    Raises
    ------
    InvalidInput
        Their kind is unknown.
    msgspec.ValidationError
        A number is out of its range.
    """
    if packed.kind == 0:
        return None
    if packed.kind > len(_KINDS):
        raise InvalidInput(f"kind of gains {packed.kind}: is unknown; allowed are 0 (none) to {len(_KINDS)}")
    kind = _KINDS[packed.kind - 1]
    named = dict(zip(kind.__struct_fields__, packed.numbers, strict=False))
    return convert({**named, "integral_only": named["integral_only"] > 0.5}, kind)


def parse_address(text: str) -> Address:
    """Parse "unix:PATH" or "127.0.0.1:PORT".

    Raises
    ------
    InvalidInput
        It is neither: the protocol has no authentication, so it is limited to this computer.
    """
    kind, _, rest = text.partition(":")
    if kind == "unix" and rest:
        return Address(rest)
    host, _, port = text.rpartition(":")
    if host.strip("[]") not in LOOPBACK or not port.isdecimal() or int(port) > 65535:
        raise InvalidInput(f"machine address {text!r} is not allowed; give unix:PATH or 127.0.0.1:PORT")
    return Address(None, host.strip("[]"), int(port))


def new_socket(address: Address) -> socket.socket:
    """Create a stream socket of the address's family."""
    family = socket.AF_UNIX if address.path is not None else socket.AF_INET6 if ":" in address.host else socket.AF_INET
    return socket.socket(family, socket.SOCK_STREAM)


def socket_address(address: Address) -> str | tuple[str, int]:
    """Address in the form that `socket` takes."""
    return address.path if address.path is not None else (address.host, address.port)


def disable_nagle(connection: socket.socket) -> None:
    """Send each message at once: Nagle's algorithm would delay a small one until the last one is acknowledged."""
    if connection.family != socket.AF_UNIX:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def set_timeout(connection: socket.socket, seconds: float) -> None:
    """Limit the time that one send or receive may take, s; 0: no limit."""
    # Not `settimeout`, which polls before each call: these options keep a tick at one system call each way.
    limit = struct.pack("ll", int(seconds), int(seconds % 1.0 * 1e6))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


def receive(connection: socket.socket, size: int) -> bytes:
    """Receive `size` bytes.

    Raises
    ------
    BlockingIOError
        They did not arrive within the time limit.
    ConnectionError
        The other end closed the connection, perhaps within a message.
    """
    data = connection.recv(size, socket.MSG_WAITALL)
    if len(data) != size:
        raise ConnectionError("closed by the other end" if not data else "stopped within a message")
    return data
