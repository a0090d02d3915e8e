"""Server of the role supervise: the plant runs its own controller; the client reads samples and writes parameters."""

from __future__ import annotations

import select
import socket
import time
from typing import NamedTuple

from servotwin.drives.simulated import wire
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.plants import SupervisedPlant
from servotwin.drives.simulated.server import OnSample, ignore_sample
from servotwin.errors import InvalidInput

_TRANSFER_S = 5.0
"""Longest time that a client may take to send the rest of a request or to receive a reply."""


class DriveRequest(NamedTuple):
    """Request of a client; `number` is a sample or a version, `tolerance` (m) also the offset of a move."""

    kind: int
    most: int
    number: int
    tolerance: float
    gains: wire.PackedGains


class SuperviseServer:
    """Serves a plant that has its own controller.

    Parameters
    ----------
    plant : SupervisedPlant
    pace : Pace, optional
        None: lock-step, where a request to read advances the plant.
    on_sample : OnSample
    """

    def __init__(self, plant: SupervisedPlant, pace: Pace | None, on_sample: OnSample = ignore_sample) -> None:
        self._plant, self._pace, self._lag, self._on_sample = plant, pace, 0.0, on_sample

    @property
    def over(self) -> bool:
        """True once the run has ended."""
        return self._plant.over

    def run_alone(self) -> float | None:
        """Simulate every block that is due; return the time at which the next one is."""
        if self._pace is None:
            return None
        plant, pace = self._plant, self._pace
        now = time.monotonic()
        self._on_sample(plant.index, now)
        self._lag = pace.catch_up(plant.index + plant.block, now)
        while plant.index + plant.block <= pace.reached(time.monotonic()) and not plant.over:
            plant.advance(plant.block)
        return pace.due(plant.index + plant.block)

    def serve(self, connection: socket.socket) -> None:
        """Serve request after request, until a reader has received the end of the run."""
        wire.set_timeout(connection, _TRANSFER_S)
        over = False
        while not over:
            self._run_until_request(connection)
            request = _decode_request(wire.receive(connection, wire.REQUEST.size))
            if request.kind == wire.READ:
                over = self._read(connection, request)
            else:
                self._change(connection, request)

    def _run_until_request(self, connection: socket.socket) -> None:
        """Let the plant run until the client sends something."""
        while True:
            due = self.run_alone()
            # No limit in lock-step: until its next request a client may wait for its twin, longer than `_TRANSFER_S`.
            timeout = None if due is None else max(0.0, due - time.monotonic())
            if select.select([connection], [], [], timeout)[0]:
                return

    def _read(self, connection: socket.socket, request: DriveRequest) -> bool:
        """Send the next block as soon as there is one; return True where the run is over."""
        plant, most = self._plant, min(request.most or wire.MAX_SAMPLES, wire.MAX_SAMPLES)
        first = plant.index if request.number == wire.NOW else request.number
        if self._pace is None and first >= plant.index:
            plant.advance(min(request.most or plant.block, wire.MAX_SAMPLES))
        while (block := plant.read(first, most)) is None and not plant.over:
            due = self.run_alone()
            time.sleep(0.0 if due is None else max(0.0, due - time.monotonic()))
        if block is None:
            connection.sendall(wire.REPLY.pack(wire.OVER, 0, plant.index, plant.version, self._lag))
            return True
        data = block.values.astype("<f8").tobytes()
        head = wire.REPLY.pack(wire.DONE, block.values.shape[1], block.first, block.version, self._lag)
        connection.sendall(head + data)
        return False

    def _change(self, connection: socket.socket, request: DriveRequest) -> None:
        """Write parameters or begin a move, or reply with the reason of the refusal."""
        try:
            if request.kind == wire.WRITE:
                self._plant.write(request.number, request.tolerance, wire.gains_of(request.gains))
            elif request.kind == wire.MOVE:
                self._plant.move(request.tolerance)
            else:
                raise InvalidInput(f"request {request.kind}: is unknown; allowed are 1 (read), 2 (write) and 3 (move)")
        except (InvalidInput, ValueError) as error:
            text = str(error).encode()
            connection.sendall(wire.REPLY.pack(wire.REFUSED, len(text), self._plant.index, 0, self._lag) + text)
        else:
            connection.sendall(wire.REPLY.pack(wire.DONE, 0, self._plant.index, self._plant.version, self._lag))


def _decode_request(data: bytes) -> DriveRequest:
    kind, gains, most, number, tolerance, *numbers = wire.REQUEST.unpack(data)
    return DriveRequest(kind, most, number, tolerance, wire.PackedGains(gains, tuple(numbers)))
