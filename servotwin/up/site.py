"""All processes together: started in order, kept running, ended in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from servotwin.runtime.child_process import Child
from servotwin.up.folder import EDGE, MACHINE, TWIN, Folder
from servotwin.up.outages import Forwarder, Outages
from servotwin.up.plan import SERVOS

LISTENING = "servotwin twin: listening on "
READY_S, END_S, PIECE_S = 600.0, 20.0, 0.05
"""Compiling at the very first start takes its time."""

Stopping = Callable[[], int]
"""How often somebody has asked to stop: at the second time nothing is waited for."""


class Stopped(Exception):
    """Somebody asked to stop before everything ran."""


class Site:
    """Twin, machines, edges, and the link with outages.

    Parameters
    ----------
    folder : Folder
    outages : Outages
    stopping : Stopping
    """

    def __init__(self, folder: Folder, outages: Outages, stopping: Stopping) -> None:
        self._folder, self._outages, self._stopping = folder, outages, stopping
        self.twin = self._child("twin", ("servotwin", "twin", "--config", str(folder.path / TWIN), "--port", "0"))
        self.machines = {servo.name: self._machine(servo.name) for servo in SERVOS}
        self.edges = {servo.name: self._edge(servo.name) for servo in SERVOS}
        self.forwarder: Forwarder | None = None

    @property
    def url(self) -> str:
        """Of the twin."""
        return self.twin.address or ""

    @property
    def children(self) -> list[Child]:
        """Every process."""
        return [self.twin, *self.machines.values(), *self.edges.values()]

    @property
    def groups(self) -> set[int]:
        """Their process groups."""
        return {child.pid for child in self.children if child.pid is not None}

    def begin(self) -> None:
        """Start twin and machines, then the edges.

        Raises
        ------
        InvalidInput
            One does not start.
        Stopped
        """
        first = [self.twin, *self.machines.values()]
        for child in first:
            child.start()
        self._await(first)
        port = self.url.rpartition(":")[2]
        self.twin.command = (*self.twin.command[:-1], port)
        self.forwarder = Forwarder(int(port), self._outages)
        self.forwarder.begin()
        for servo in SERVOS:
            through = f"http://127.0.0.1:{self.forwarder.port}" if servo.outages else self.url
            self._folder.connect(servo, through)
        for child in self.edges.values():
            child.start()

    def tend(self, now: float) -> list[str]:
        """Start again what has ended by itself; returns what did.

        Raises
        ------
        InvalidInput
            Something ends again and again.
        """
        ended = []
        for child in self.children:
            child.read_output()
            if child.code is not None:
                ended.append(f"{child.name} ended by itself (code {child.code}) and was started again")
                child.restart(now)
        return ended

    def end(self) -> None:
        """End edges, then machines, then the twin."""
        self._end(self.edges.values())
        self._end(self.machines.values())
        if self.forwarder is not None:
            self.forwarder.end()
        self._end([self.twin])

    def _child(self, name: str, command: tuple[str, ...], ready: str = LISTENING) -> Child:
        log = self._folder.path / f"{name.replace(' ', '-')}.log"
        return Child(name, command, log, ready, self._folder.lock)

    def _machine(self, servo: str) -> Child:
        file = self._folder.path / servo / MACHINE
        return self._child(f"machine {servo}", ("servotwin.drives.simulated", str(file)), "ready ")

    def _edge(self, servo: str) -> Child:
        return self._child(f"edge {servo}", ("servotwin.edge_process", str(self._folder.path / servo / EDGE)), "")

    def _await(self, children: list[Child]) -> None:
        end = time.monotonic() + READY_S
        while any(child.address is None for child in children):
            for child in children:
                child.read_output()
                if child.address is None and child.code is not None:
                    raise child.failure(f"does not start (code {child.code})")
                if time.monotonic() > end:
                    raise child.failure(f"is not ready after {READY_S:.0f} s")
            if self._stopping():
                raise Stopped
            time.sleep(PIECE_S)

    def _end(self, children: Iterable[Child]) -> None:
        asked = list(children)
        for child in asked:
            child.terminate()
        end = time.monotonic() + END_S
        while any(child.pid is not None and child.code is None for child in asked):
            if time.monotonic() > end or self._stopping() > 1:
                for child in asked:
                    child.kill()
            time.sleep(PIECE_S)
        for child in asked:
            child.release()
