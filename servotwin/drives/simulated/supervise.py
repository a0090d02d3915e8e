"""The role supervise: the plant's own controller runs, the client reads blocks of samples and writes parameters."""

from __future__ import annotations

import select
import socket
import time
from typing import NamedTuple

from servotwin.drives.simulated import wire
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.plants import SupervisedPlant
from servotwin.drives.simulated.server import Tend, untended
from servotwin.errors import InvalidInput
from servotwin.messages import Gains

SENDING = 5.0
"""s that a client may take to receive a reply."""


class DriveRequest(NamedTuple):
    """A request."""

    kind: int
    with_gains: int
    most: int
    number: int
    tolerance: float
    gains: tuple[float, ...]


class SuperviseServer:
    """A plant with its own controller.

    Parameters
    ----------
    plant : SupervisedPlant
    pace : Pace, optional
        None: lock-step, where a request to read lets the plant go on.
    tend : Tend
    """

    def __init__(self, plant: SupervisedPlant, pace: Pace | None, tend: Tend = untended) -> None:
        self._plant, self._pace, self._late, self._tend = plant, pace, 0.0, tend

    @property
    def over(self) -> bool:
        """The run has ended."""
        return self._plant.over

    def run_alone(self) -> float | None:
        """Every block that is due; returns when the next one is."""
        if self._pace is None:
            return None
        plant, pace = self._plant, self._pace
        now = time.monotonic()
        self._tend(plant.index, now)
        self._late = pace.keep(plant.index + plant.block, now)
        while plant.index + plant.block <= pace.reached(time.monotonic()) and not plant.over:
            plant.advance(plant.block)
        return pace.due(plant.index + plant.block)

    def serve(self, connection: socket.socket) -> None:
        """Request after request, until a reader has learnt that the run is over."""
        wire.patient(connection, SENDING)
        over = False
        while not over:
            self._run_until_asked(connection)
            asked = _asked(wire.receive(connection, wire.REQUEST.size))
            if asked.kind == wire.READ:
                over = self._read(connection, asked)
            else:
                self._obey(connection, asked)

    def _run_until_asked(self, connection: socket.socket) -> None:
        """Let the plant run until the client says something."""
        while True:
            again = self.run_alone()
            # In lock-step without limit: a twin may take longer over one request than a client may over a reply.
            patience = None if again is None else max(0.0, again - time.monotonic())
            if select.select([connection], [], [], patience)[0]:
                return

    def _read(self, connection: socket.socket, asked: DriveRequest) -> bool:
        """Answer with a block as soon as there is one; whether there is none any more."""
        plant, most = self._plant, min(asked.most or wire.MOST, wire.MOST)
        first = plant.index if asked.number == wire.NOW else asked.number
        if self._pace is None and first >= plant.index:
            plant.advance(min(asked.most or plant.block, wire.MOST))
        while (stretch := plant.read(first, most)) is None and not plant.over:
            again = self.run_alone()
            time.sleep(0.0 if again is None else max(0.0, again - time.monotonic()))
        if stretch is None:
            connection.sendall(wire.REPLY.pack(wire.OVER, 0, plant.index, plant.version, self._late))
            return True
        data = stretch.values.astype("<f8").tobytes()
        head = wire.REPLY.pack(wire.DONE, stretch.values.shape[1], stretch.first, stretch.version, self._late)
        connection.sendall(head + data)
        return False

    def _obey(self, connection: socket.socket, asked: DriveRequest) -> None:
        """Take parameters or a move, or say why not."""
        try:
            if asked.kind == wire.WRITE:
                gains = Gains(*asked.gains) if asked.with_gains else None
                self._plant.write(asked.number, asked.tolerance, gains)
            elif asked.kind == wire.MOVE:
                self._plant.move(asked.tolerance)
            else:
                raise InvalidInput(f"request {asked.kind}: is not known")
        except (InvalidInput, ValueError) as error:
            text = str(error).encode()
            connection.sendall(wire.REPLY.pack(wire.REFUSED, len(text), self._plant.index, 0, self._late) + text)
        else:
            connection.sendall(wire.REPLY.pack(wire.DONE, 0, self._plant.index, self._plant.version, self._late))


def _asked(data: bytes) -> DriveRequest:
    kind, with_gains, most, number, tolerance, *gains = wire.REQUEST.unpack(data)
    return DriveRequest(kind, with_gains, most, number, tolerance, tuple(gains))
