"""OPC UA drive: it reads samples from ring buffers, and commits parameters as one."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from math import inf

import msgspec

from servotwin.drives.opcua import model, ring
from servotwin.drives.opcua.session import OpcUaSession
from servotwin.drives.opcua.settings import OpcUaSettings
from servotwin.edge.drive import Block, DriveLost, DriveRefused
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput

_MOST_CHANGES = 8
"""Number of versions whose first sample is stored: between two polls there are never more."""

_DECISION_POLL_S = 0.01
"""Time between two polls for the drive's decision about parameters."""


class OpcUaDrive:
    """`edge.drive.SupervisedDrive` of OPC UA nodes.

    Samples overwritten before they were read leave a gap in the blocks' numbers. After a reconnection to the same
    run it continues with the next sample, if the ring buffers still hold it.

    Parameters
    ----------
    settings : OpcUaSettings
    clock, sleep : callable
        Returns monotonic seconds; waits for a number of seconds.
    """

    can_move = patient = False
    lag = 0.0

    def __init__(
        self,
        settings: OpcUaSettings,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._settings, self._clock, self._sleep = settings, clock, sleep
        self._session: OpcUaSession | None = None
        self._ready: deque[Block] = deque()
        self._changes: deque[ring.VersionChange] = deque(maxlen=_MOST_CHANGES)
        self._next: int | None = None
        self._polled = -inf
        self._margin, self.rate, self.machine = 0, 0.0, ""

    def connect(self) -> None:
        """Connect to the server, at first or again; in a new run of the machine reading begins with the next sample."""
        self.close()
        self._session = OpcUaSession(self._settings)
        self.rate, self._margin, machine, count, version, since = self._session.read(
            (*model.FIXED, "Machine", "Count", "Version", "Since")
        )
        if not all(type(number) is int for number in (self._margin, count, version, since)) or not _is_rate(self.rate):
            raise InvalidInput(f"drive {self._settings.url}: its variables do not hold what the model says")
        if machine != self.machine:
            self.machine, self._next = machine, count
            self._ready.clear()
            self._changes.clear()
        self._note_change(ring.VersionChange(since, version))

    def read(self, most: int = 0) -> Block | None:
        """Return the next samples; never None, since the drive's run does not end."""
        deadline = self._clock() + self._settings.silence_s
        while not self._ready:
            self._sleep(max(0.0, self._polled + self._settings.poll_s - self._clock()))
            self._polled = self._clock()
            self._poll(self._connected)
            if not self._ready and self._clock() > deadline:
                raise self._lost(f"no new sample for {self._settings.silence_s:g} s")
        block = self._ready.popleft()
        if not 0 < most < len(block.reference):
            return block
        self._ready.appendleft(_part(block, most, None))
        return _part(block, 0, most)

    def write(self, parameters: Parameters) -> None:
        """Write all, commit, and wait for the drive's decision."""
        session = self._connected
        gains = parameters.setting.gains
        values = dict(
            zip(model.PARAMETERS, (parameters.version, parameters.setting.tolerance, gains is not None), strict=True)
        )
        if gains is not None:
            if missing := [name for name in model.needed(gains) if not session.has(name)]:
                raise DriveRefused(f"drive {self._settings.url}: has no variable {', '.join(missing)}")
            named = {model.variable(name): value for name, value in msgspec.structs.asdict(gains).items()}
            values |= {name: value for name, value in named.items() if session.has(name)}
        before, committed = session.read((model.COMMIT, model.DECISION[0]))
        session.write(values)
        commit = (max(before, committed) + 1) % 2**32
        session.write({model.COMMIT: commit})
        self._wait_for(session, commit)

    def move(self, _offset: float) -> None:
        """Do nothing: the model has no probing moves."""

    def close(self) -> None:
        """End the session."""
        if self._session is not None:
            self._session.close()
            self._session = None

    @property
    def _connected(self) -> OpcUaSession:
        if self._session is None:
            raise DriveLost(f"drive {self._settings.url}: not connected")
        return self._session

    def _poll(self, session: OpcUaSession) -> None:
        """Read the new samples of the rings."""
        machine, before, *signals, version, since, after = session.read(model.STATE)
        if machine != self.machine:
            raise self._lost("the machine began anew")
        reading = ring.RingReading(before, after, tuple(signals))
        if not ring.is_valid(reading) or type(version) is not int or type(since) is not int:
            raise self._lost("its variables do not hold what the model says")
        self._note_change(ring.VersionChange(since, version))
        due = before if self._next is None else self._next
        first, fresh = ring.whole(reading, due, self._margin)
        self._next = before
        self._ready.extend(ring.blocks(first, fresh, list(self._changes)) if len(fresh[0]) else ())

    def _note_change(self, change: ring.VersionChange) -> None:
        if not self._changes or self._changes[-1] != change:
            self._changes.append(change)

    def _wait_for(self, session: OpcUaSession, commit: int) -> None:
        """Wait until the drive has decided about a commit; raise where it refuses."""
        deadline = self._clock() + self._settings.silence_s
        while True:
            committed, refused, version, since = session.read((*model.DECISION, "Version", "Since"))
            if committed == commit:
                break
            if self._clock() > deadline:
                raise self._lost(f"parameters were not decided about for {self._settings.silence_s:g} s")
            self._sleep(_DECISION_POLL_S)
        if refused:
            raise DriveRefused(f"drive {self._settings.url}: {refused}")
        self._note_change(ring.VersionChange(since, version))

    def _lost(self, why: str) -> DriveLost:
        self.close()
        return DriveLost(f"drive {self._settings.url}: {why}")


def _is_rate(value: object) -> bool:
    return isinstance(value, float) and 0.0 < value < inf


def _part(block: Block, first: int, last: int | None) -> Block:
    signals = (block.reference, block.theta_m, block.position, block.voltage)
    return Block(block.first + first, block.version, *(signal[first:last] for signal in signals))
