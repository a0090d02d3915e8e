"""Lock-step: the deployed twin, and the machine as a separate process, under the co-simulation's clock.

Sample time drives the link: delays, losses and duplicates are those of the scenario. Each message goes to the real
service over HTTP and is committed, processed in its pool, committed again and answered before time advances. So
estimates and versions equal the co-simulation's bit for bit; a difference is a defect of one of them.
"""

from __future__ import annotations

import ssl
from array import array
from http.client import HTTPConnection, HTTPSConnection
from typing import Any
from urllib.parse import urlsplit

import msgspec

from servotwin.cosim.driver import Cosimulation, Progress, Remote
from servotwin.cosim.scenario import Scenario
from servotwin.edge.drive import Block, DriveLost, SupervisedDrive
from servotwin.edge.outlet import CHANNELS
from servotwin.edge.parameters import Parameters
from servotwin.edge.recorder import Floats
from servotwin.errors import InvalidInput
from servotwin.link.url import in_clear
from servotwin.messages import Fallback, Message, Receipt, WindowMessage, decode, encode

_TIMEOUT_S = 300.0
"""s for one response, which may include a verification."""


class _LockstepResponse(msgspec.Struct, frozen=True):
    """Response of the service in lock-step.

    Attributes
    ----------
    messages : list of bytes
    wake : float or None
        Sample time at which the twin is to be woken.
    """

    messages: list[bytes]
    wake: float | None


_response = msgspec.msgpack.Decoder(_LockstepResponse)


class HttpTwin:
    """Client of a twin in lock-step: a service whose file has `lockstep = true`.

    Parameters
    ----------
    url : str
        http://127.0.0.1:8765
    servo : str
    token : str
        Empty: the service needs none.
    context : ssl.SSLContext, optional
        For https.
    """

    def __init__(self, url: str, servo: str, token: str = "", context: ssl.SSLContext | None = None) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or parts.hostname is None:
            raise InvalidInput(f"twin url = {url!r}: must be http://HOST:PORT or https://HOST:PORT")
        if token and in_clear(url):
            raise InvalidInput(f"twin url = {url!r}: would send the token in clear to another machine; give https://")
        address: Any = {"host": parts.hostname, "port": parts.port, "timeout": _TIMEOUT_S}
        self._connection = (
            HTTPConnection(**address) if parts.scheme == "http" else HTTPSConnection(**address, context=context)
        )
        self._path = f"/v1/servos/{servo}/lockstep"
        self._headers = {"authorization": f"Bearer {token}"} if token else {}
        self._wake: float | None = None

    def receive(self, message: Message, now: float) -> list[Message]:
        """Send a message at `now` (s); returns the messages that the twin sends after it."""
        return self._request("receive", now, encode(message))

    def wake(self, now: float) -> list[Message]:
        """Wake the twin at `now` (s); returns the messages that it sends by itself."""
        return self._request("wake", now, b"")

    def next_wake(self) -> float | None:
        """Time at which the twin is to be woken, s, as of its last response."""
        return self._wake

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _request(self, action: str, now: float, body: bytes) -> list[Message]:
        self._connection.request("POST", f"{self._path}/{action}?now={now!r}", body, self._headers)
        response = self._connection.getresponse()
        data = response.read()
        if response.status != 200:
            raise InvalidInput(f"twin {self._path}/{action} at {now:g} s: {response.status} {data[:500].decode()}")
        decoded = _response.decode(data)
        self._wake = decoded.wake
        return [decode(each) for each in decoded.messages]


class _DrivenMachine:
    """A `cosim.Machine` behind the drive protocol: another process, in lock-step.

    Parameters
    ----------
    drive : SupervisedDrive
        Connected, at its first sample.
    scenario : Scenario
        Gives the number of samples.
    """

    def __init__(self, drive: SupervisedDrive, scenario: Scenario) -> None:
        self.samples = scenario.samples
        self._drive, self._index = drive, 0
        self._signals = {name: array("d") for name in CHANNELS}

    @property
    def index(self) -> int:
        """Present sample."""
        return self._index

    def advance(self, index: int) -> None:
        """Advance to a sample."""
        while self._index < index:
            block = self._drive.read(index - self._index)
            if block is None or block.first != self._index:
                raise DriveLost(f"the machine did not give sample {self._index}")
            self._append(block)

    def measured(self, name: str, first: int, last: int) -> Floats:
        """Samples first to last - 1 of a channel."""
        return self._signals[name][first:last]

    def write(self, parameters: Parameters) -> None:
        """Put tolerance and gains in force from the present sample on."""
        self._drive.write(parameters)

    def move(self, _offset: float) -> None:
        """Refuse: lock-step has no excitation.

        Raises
        ------
        InvalidInput
        """
        raise InvalidInput("lock-step has no probing moves: leave [twin.excitation] out of the scenario")

    def _append(self, block: Block) -> None:
        for name in CHANNELS:
            self._signals[name].extend(getattr(block, name))
        self._index = block.last


class LockStep(msgspec.Struct, frozen=True):
    """Messages that crossed the link in lock-step, each once, in the order of sending.

    Attributes
    ----------
    windows, receipts, fallbacks : tuple
        From the edge.
    sent : tuple of Message
        From the twin: acknowledgements, updates, requests.
    """

    windows: tuple[WindowMessage, ...]
    receipts: tuple[Receipt, ...]
    fallbacks: tuple[Fallback, ...]
    sent: tuple[Message, ...]


def lock_step(scenario: Scenario, twin: Remote, drive: SupervisedDrive, progress: Progress | None = None) -> LockStep:
    """Run a scenario on a real twin and a machine behind a drive.

    Parameters
    ----------
    scenario : Scenario
        The one that machine and twin run.
    twin : Remote
        `HttpTwin`, or any other.
    drive : SupervisedDrive
    progress : callable, optional
        Called with the completed share.
    """
    run = Cosimulation(scenario, _DrivenMachine(drive, scenario), twin=twin)
    while not run.done:
        run.advance()
        if progress is not None:
            progress(run.share)
    up = {record.serial: decode(record.data) for record in run.link.up.records}
    down = {record.serial: decode(record.data) for record in run.link.down.records}
    windows = {each.identity: each for each in up.values() if isinstance(each, WindowMessage)}
    return LockStep(tuple(windows.values()), tuple(run.edge.receipts), tuple(run.edge.fallbacks), tuple(down.values()))
