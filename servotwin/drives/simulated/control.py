"""Server of the role control: at each sample instant it sends a sample, and the client answers with a voltage."""

from __future__ import annotations

import select
import socket
import time

from servotwin.drives.simulated import wire
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.plants import ControlledPlant
from servotwin.drives.simulated.server import POLL_S, OnSample, ignore_sample


class ControlServer:
    """Serves a plant whose voltage the client sets.

    Parameters
    ----------
    plant : ControlledPlant
    pace : Pace, optional
        None: lock-step.
    timeout : float
        s by the clock after which a tick without an answer counts as missed; lock-step waits for ever.
    on_sample : OnSample
    """

    def __init__(
        self, plant: ControlledPlant, pace: Pace | None, timeout: float, on_sample: OnSample = ignore_sample
    ) -> None:
        self._plant, self._pace, self._timeout, self._on_sample = plant, pace, timeout, on_sample

    @property
    def over(self) -> bool:
        """True once the run has ended."""
        return self._plant.over

    def run_alone(self) -> float | None:
        """Simulate every sample that is due without a client, and return when to call again."""
        if self._pace is None:
            return None
        now = time.monotonic()
        self._on_sample(self._plant.index, now)
        self._pace.catch_up(self._plant.index, now)
        due = self._pace.reached(time.monotonic())
        while self._plant.index < due and not self._plant.over:
            self._plant.run_alone()
        return time.monotonic() + POLL_S

    def serve(self, connection: socket.socket) -> None:
        """Serve tick after tick until the run is over."""
        wire.set_timeout(connection, 0.0 if self._pace is None else self._timeout)
        plant, pack, size = self._plant, wire.SAMPLE.pack, wire.VOLTAGE.size
        while not plant.over:
            late = 0.0 if self._pace is None else self._wait(self._pace)
            connection.sendall(pack(plant.index, *plant.sample(), late))
            try:
                data = wire.receive(connection, size)
            except BlockingIOError:
                data = self._miss(connection)
            plant.tick(*wire.VOLTAGE.unpack(data))
        connection.sendall(pack(wire.LAST, 0.0, 0.0, 0.0, 0.0))

    def _wait(self, pace: Pace) -> float:
        """Wait until the present sample is due; return its delay, s of machine time."""
        remaining = pace.due(self._plant.index) - time.monotonic()
        if remaining > 0.0:
            time.sleep(remaining)
        now = time.monotonic()
        self._on_sample(self._plant.index, now)
        return pace.catch_up(self._plant.index, now)

    def _miss(self, connection: socket.socket) -> bytes:
        """Run as without a client until its late answer comes; that voltage holds from the present sample on."""
        while not self._plant.over:
            due = self.run_alone()
            timeout = 0.0 if due is None else max(0.0, due - time.monotonic())
            if select.select([connection], [], [], timeout)[0]:
                break
        return wire.receive(connection, wire.VOLTAGE.size)
