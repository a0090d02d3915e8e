"""A machine for tests of the edge process: the simulated drive's protocol, and a position that follows the voltage."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from math import nan

from servotwin.drives.simulated import wire

PER_TICK = 1e-5
"""m that 1 V moves it in one sample."""


class StubMachine:
    """One client at a time; paced by the clock; samples are only taken while there is a client.

    Parameters
    ----------
    rate : float
        Hz.
    every : int
        Samples between steps of the reference by 1 mm.
    """

    def __init__(self, rate: float = 500.0, every: int = 125) -> None:
        self.rate, self.every = rate, every
        self.number = 0
        self.voltages: list[float] = []
        self.clients = 0
        self.position = 0.0
        self.spoil: Callable[[int, float, float, float], tuple[int, float, float, float]] = lambda *sample: sample
        self._stop = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.1)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    def reference(self, number: int) -> float:
        return 1e-3 * (number // self.every % 2)

    def wait_for(self, number: int, seconds: float = 60.0) -> None:
        """Until that sample has been taken."""
        end = time.monotonic() + seconds
        while self.number < number:
            assert time.monotonic() < end, f"only {self.number} samples"
            time.sleep(0.01)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(10.0)
        self._listener.close()

    def __enter__(self) -> "StubMachine":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(OSError):
                connection, _ = self._listener.accept()
                with connection:
                    connection.settimeout(10.0)
                    self._serve(connection)

    def _serve(self, connection: socket.socket) -> None:
        wire.disable_nagle(connection)
        connection.recv(wire.HELLO.size, socket.MSG_WAITALL)
        connection.sendall(wire.WELCOME.pack(wire.MAGIC, wire.VERSION, wire.CONTROL, b"machine0", self.rate))
        self.clients += 1
        due = time.monotonic()
        while not self._stop.is_set():
            due = max(due + 1.0 / self.rate, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            self._tick(connection)

    def _tick(self, connection: socket.socket) -> None:
        sample = self.spoil(self.number, self.reference(self.number), 50.0 * self.position, self.position)
        connection.sendall(wire.SAMPLE.pack(*sample, 0.0))
        data = connection.recv(wire.VOLTAGE.size, socket.MSG_WAITALL)
        if len(data) < wire.VOLTAGE.size:
            raise ConnectionError
        (voltage,) = wire.VOLTAGE.unpack(data)
        self.voltages.append(voltage)
        self.position += PER_TICK * (0.0 if voltage is nan else voltage)
        self.number += 1
