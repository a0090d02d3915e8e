"""Processes of `servotwin up`: started in order, restarted when they end, stopped in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection

from servotwin.runtime.child_process import Child
from servotwin.up.folder import Folder
from servotwin.up.outages import Forwarder, Outages
from servotwin.up.plan import EDGE, MACHINE, TWIN

_LISTENING = "servotwin twin: listening on "
_READY_S, _STOP_S, _POLL_S = 600.0, 20.0, 0.05
"""s to get ready (the very first start compiles, which takes minutes), to end, and between checks."""

Signals = Callable[[], int]
"""Number of signals so far; after the second one processes are killed."""


class StartInterrupted(Exception):
    """A signal came before everything ran."""


class Site:
    """Twin, machines, edges, and the link with outages.

    Parameters
    ----------
    folder : Folder
    outages : Outages
    signals : Signals
    announce : callable
        Called with the URL of the twin as soon as it answers, while the other processes still start.
    """

    def __init__(
        self, folder: Folder, outages: Outages, signals: Signals, announce: Callable[[str], None] = lambda _url: None
    ) -> None:
        self._folder, self._outages, self._signals, self._announce = folder, outages, signals, announce
        self.twin = self._child("twin", ("servotwin", "twin", "--config", str(folder.path / TWIN), "--port", "0"))
        self.machines = {servo.name: self._machine(servo.name) for servo in self._folder.servos}
        self.edges = {servo.name: self._edge(servo.name) for servo in self._folder.servos}
        self.forwarder: Forwarder | None = None

    @property
    def url(self) -> str:
        """URL of the twin."""
        return self.twin.address or ""

    @property
    def children(self) -> list[Child]:
        """All processes."""
        return [self.twin, *self.machines.values(), *self.edges.values()]

    @property
    def groups(self) -> set[int]:
        """Ids of their process groups."""
        return {child.pid for child in self.children if child.pid is not None}

    def start(self) -> None:
        """Start twin and machines, then the edges.

        Raises
        ------
        InvalidInput
            A process does not start.
        StartInterrupted
        """
        first = [self.twin, *self.machines.values()]
        for child in first:
            child.start()
        self._wait_until_ready(first)
        port = self.url.rpartition(":")[2]
        # A restarted twin has to listen on the same port: edges and forwarder have its address.
        self.twin.command = (*self.twin.command[:-1], port)
        self.forwarder = Forwarder(int(port), self._outages)
        self.forwarder.start()
        for servo in self._folder.servos:
            url = f"http://127.0.0.1:{self.forwarder.port}" if servo.outages else self.url
            self._folder.connect(servo, url)
        for child in self.edges.values():
            child.start()

    def restart_ended(self, now: float) -> list[str]:
        """Restart processes that ended by themselves; returns a message for each.

        Raises
        ------
        InvalidInput
            A process keeps ending.
        """
        ended = []
        for child in self.children:
            child.read_output()
            if child.code is not None:
                ended.append(f"{child.name} ended unexpectedly (code {child.code}) and was restarted")
                child.restart(now)
        return ended

    def stop(self) -> None:
        """Stop edges, then machines, then the twin."""
        self._stop(self.edges.values())
        self._stop(self.machines.values())
        if self.forwarder is not None:
            self.forwarder.stop()
        self._stop([self.twin])

    def _child(self, name: str, command: tuple[str, ...], ready: str = _LISTENING) -> Child:
        log = self._folder.path / f"{name.replace(' ', '-')}.log"
        return Child(name, command, log, ready, self._folder.lock)

    def _machine(self, servo: str) -> Child:
        file = self._folder.path / servo / MACHINE
        return self._child(f"machine {servo}", ("servotwin.drives.simulated", str(file)), "ready ")

    def _edge(self, servo: str) -> Child:
        return self._child(f"edge {servo}", ("servotwin.edge_process", str(self._folder.path / servo / EDGE)), "")

    def _wait_until_ready(self, children: list[Child]) -> None:
        end, announced = time.monotonic() + _READY_S, False
        while any(child.address is None for child in children):
            for child in children:
                child.read_output()
                if child.address is None and child.code is not None:
                    raise child.failure(f"does not start (code {child.code})")
                if time.monotonic() > end:
                    raise child.failure(f"is not ready after {_READY_S:.0f} s")
            if self.url and not announced:
                announced = True
                self._announce(self.url)
            if self._signals():
                raise StartInterrupted
            time.sleep(_POLL_S)

    def _stop(self, children: Collection[Child]) -> None:
        for child in children:
            child.terminate()
        end = time.monotonic() + _STOP_S
        while any(child.pid is not None and child.code is None for child in children):
            if time.monotonic() > end or self._signals() > 1:
                for child in children:
                    child.kill()
            time.sleep(_POLL_S)
        for child in children:
            child.release()
