"""The role control: each sample instant the client is told a sample and answers with a voltage."""

from __future__ import annotations

import select
import socket
import time

from servotwin.drives.simulated import wire
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.plants import ControlledPlant
from servotwin.drives.simulated.server import ALONE, Tend, untended


class ControlServer:
    """A plant whose voltage comes from the client.

    Parameters
    ----------
    plant : ControlledPlant
    pace : Pace, optional
        None: lock-step.
    patience : float
        s by the clock after which an unanswered tick counts as missed; lock-step waits for ever.
    tend : Tend
    """

    def __init__(self, plant: ControlledPlant, pace: Pace | None, patience: float, tend: Tend = untended) -> None:
        self._plant, self._pace, self._patience, self._tend = plant, pace, patience, tend

    @property
    def over(self) -> bool:
        """The run has ended."""
        return self._plant.over

    def run_alone(self) -> float | None:
        """Without a client: everything that is due, the voltage left alone until the watchdog's time is over."""
        if self._pace is None:
            return None
        now = time.monotonic()
        self._tend(self._plant.index, now)
        self._pace.keep(self._plant.index, now)
        due = self._pace.reached(time.monotonic())
        while self._plant.index < due and not self._plant.over:
            self._plant.run_alone()
        return time.monotonic() + ALONE

    def serve(self, connection: socket.socket) -> None:
        """Tick after tick."""
        wire.patient(connection, 0.0 if self._pace is None else self._patience)
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
        """Until the present sample is due; returns by how much it is late, s of machine time."""
        left = pace.due(self._plant.index) - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        now = time.monotonic()
        self._tend(self._plant.index, now)
        return pace.keep(self._plant.index, now)

    def _miss(self, connection: socket.socket) -> bytes:
        """Go on as without a client until its answer comes: to an old sample, it holds from the present one on."""
        while not self._plant.over:
            again = self.run_alone()
            waited = 0.0 if again is None else max(0.0, again - time.monotonic())
            if select.select([connection], [], [], waited)[0]:
                break
        return wire.receive(connection, wire.VOLTAGE.size)
