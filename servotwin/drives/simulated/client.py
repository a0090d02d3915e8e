"""Clients of a simulated machine, one for each role; standard library only."""

import socket
import sys
from array import array
from dataclasses import dataclass
from math import nan
from pathlib import Path

from servotwin.drives.simulated import wire
from servotwin.edge.drive import Block, DriveLost, DriveRefused, DriveSample
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput


@dataclass(frozen=True)
class _Welcome:
    """Rate (Hz) and run of a machine, as it reports them to a new client."""

    rate: float
    machine: str


class _MachineConnection:
    """Connection to a machine in one role.

    Parameters
    ----------
    address : str
        "unix:PATH" or "127.0.0.1:PORT".
    role : str
        "control" or "supervise".
    silence : float
        Time without an answer after which the machine counts as lost, s; 0: never.
    """

    def __init__(self, address: str, role: str, silence: float) -> None:
        self._address, self._role, self._silence = wire.parse_address(address), role, silence
        self._socket: socket.socket | None = None
        self.welcome = _Welcome(0.0, "")

    def connect(self) -> None:
        """Connect to the machine, at first or again."""
        self.close()
        self._socket = wire.new_socket(self._address)
        wire.set_timeout(self._socket, self._silence)
        wire.disable_nagle(self._socket)
        if _is_linked(self._address):
            self.close()
            raise DriveLost(f"machine {self._address}: is a hard link to the socket of another folder; remove it")
        try:
            self._socket.connect(wire.socket_address(self._address))
            self._socket.sendall(wire.HELLO.pack(wire.MAGIC, wire.VERSION, wire.ROLES[self._role]))
            answer = wire.receive(self._socket, wire.WELCOME.size)
        except OSError as error:
            raise self.lost(error) from None
        self.welcome = self._decode_welcome(answer)

    def _decode_welcome(self, answer: bytes) -> _Welcome:
        magic, version, role, run, rate = wire.WELCOME.unpack(answer)
        if magic != wire.MAGIC or version != wire.VERSION or role != wire.ROLES[self._role]:
            self.close()
            offered = "" if magic != wire.MAGIC else f" (its role is {role}, its protocol {version})"
            required = f"the role {self._role} in protocol {wire.VERSION}"
            raise InvalidInput(f"machine address {self._address}: does not offer {required}{offered}")
        return _Welcome(rate, run.hex())

    def send(self, data: bytes) -> None:
        """Send all bytes; raises `DriveLost`."""
        try:
            self._connected.sendall(data)
        except OSError as error:
            raise self.lost(error) from None

    def receive(self, size: int) -> bytes:
        """Receive `size` bytes; raises `DriveLost`."""
        try:
            return wire.receive(self._connected, size)
        except OSError as error:
            raise self.lost(error) from None

    @property
    def _connected(self) -> socket.socket:
        if self._socket is None:
            raise DriveLost(f"machine {self._address}: not connected")
        return self._socket

    def lost(self, error: OSError) -> DriveLost:
        """Close the connection, and return the error to raise."""
        self.close()
        reason = f"silent for {self._silence:g} s" if isinstance(error, BlockingIOError) else str(error)
        if isinstance(error, ConnectionRefusedError) and self._address.path is not None:
            reason = "nobody listens at this socket: its machine does not run, or the file was copied"
        return DriveLost(f"machine {self._address}: {reason}")

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _is_linked(address: wire.Address) -> bool:
    """True for a socket with a second name: a folder copied by hard links would lead to the first one's machine."""
    try:
        return address.path is not None and Path(address.path).stat().st_nlink > 1
    except OSError:  # connecting says why
        return False


class SimulatedControl:
    """`edge.drive.ControlDrive` of a simulated machine.

    Parameters
    ----------
    address : str
        "unix:PATH" or "127.0.0.1:PORT".
    silence : float
        Time without an answer after which the machine counts as lost, s; 0: never.
    """

    def __init__(self, address: str, silence: float = 5.0) -> None:
        self._connection = _MachineConnection(address, "control", silence)
        self._voltage_due = False
        self._lag = 0.0

    @property
    def rate(self) -> float:
        """Samples per second of machine time, Hz."""
        return self._connection.welcome.rate

    @property
    def machine(self) -> str:
        """Name of the machine's present run."""
        return self._connection.welcome.machine

    @property
    def lag(self) -> float:
        """Time by which the machine is behind its pace, s."""
        return self._lag

    def connect(self) -> None:
        """Connect to the machine; its last voltage holds until the first `write`."""
        self._connection.connect()
        self._voltage_due = False

    def read(self) -> DriveSample | None:
        """Wait for the next sample; if the last one was not answered, the voltage holds."""
        if self._voltage_due:
            self.write(nan)
        number, reference, theta_m, position, self._lag = wire.SAMPLE.unpack(self._connection.receive(wire.SAMPLE.size))
        if number == wire.LAST:
            return None
        self._voltage_due = True
        return DriveSample(number, reference, theta_m, position)

    def write(self, voltage: float) -> None:
        """Answer the last sample with a voltage (V), once."""
        if self._voltage_due:
            self._voltage_due = False
            self._connection.send(wire.VOLTAGE.pack(voltage))

    def close(self) -> None:
        """Close the connection; the machine runs on."""
        self._connection.close()


class SimulatedSupervised:
    """`edge.drive.SupervisedDrive` of a simulated machine; parameters as of `SimulatedControl`.

    After a reconnection to the same run it continues with the next sample, if the machine still has it.
    """

    can_move, patient = True, False

    def __init__(self, address: str, silence: float = 5.0) -> None:
        self._connection = _MachineConnection(address, "supervise", silence)
        self._next = wire.NOW
        self._lag = 0.0

    @property
    def rate(self) -> float:
        """Samples per second of machine time, Hz."""
        return self._connection.welcome.rate

    @property
    def machine(self) -> str:
        """Name of the machine's present run."""
        return self._connection.welcome.machine

    @property
    def lag(self) -> float:
        """Time by which the machine is behind its pace, s."""
        return self._lag

    def connect(self) -> None:
        """Connect to the machine; where it was restarted, reading begins with the present sample."""
        before = self.machine
        self._connection.connect()
        if self.machine != before:
            self._next = wire.NOW

    def read(self, most: int = 0) -> Block | None:
        """Return the next samples; None: the run is over."""
        status, count, first, version = self._request(wire.READ, self._next, most=most)
        if status == wire.OVER:
            return None
        signals = [array("d") for _ in range(4)]
        data = self._connection.receive(32 * count) if count else b""
        for k, signal in enumerate(signals):
            signal.frombytes(data[8 * count * k : 8 * count * (k + 1)])
            if sys.byteorder == "big":
                signal.byteswap()
        self._next = first + count
        return Block(first, version, *signals)

    def write(self, parameters: Parameters) -> None:
        """Put parameters in force from the next sample on."""
        setting = parameters.setting
        status, count, _, _ = self._request(
            wire.WRITE, parameters.version, setting.tolerance, wire.packed_gains(setting.gains)
        )
        if status == wire.REFUSED:
            raise DriveRefused(self._connection.receive(count).decode("utf-8", "replace"))

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference from the next sample on."""
        self._request(wire.MOVE, 0, offset)

    def close(self) -> None:
        """Close the connection; the machine runs on."""
        self._connection.close()

    def _request(
        self,
        kind: int,
        number: int,
        length: float = 0.0,
        gains: wire.PackedGains = wire.NO_GAINS,
        most: int = 0,
    ) -> tuple[int, int, int, int]:
        """Send one request, with a tolerance or an offset (m) and gains; return its reply without the lag."""
        self._connection.send(wire.REQUEST.pack(kind, gains.kind, most, number, length, *gains.numbers))
        status, count, first, version, self._lag = wire.REPLY.unpack(self._connection.receive(wire.REPLY.size))
        return status, count, first, version
