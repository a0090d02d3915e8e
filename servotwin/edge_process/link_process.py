"""The link process: packs, judges, keeps, sends and listens, so that the control process waits for none of it.

`python -m servotwin.edge_process.link_process edge.toml FD`; it ends when the other end of the socket FD is closed.
"""

from __future__ import annotations

import os
import random
import select
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from threading import Event, Thread
from typing import Any

from servotwin.edge.outlet import WITHHELD
from servotwin.edge_process import frames
from servotwin.edge_process.config import EdgeConfig, token_of
from servotwin.edge_process.config_file import load
from servotwin.edge_process.keeping import Keeper
from servotwin.edge_process.log import Troubles, say
from servotwin.edge_process.status import write_status
from servotwin.edge_process.ticks import summary
from servotwin.edge_process.twin_link import courier_of, listener_of, transport_of
from servotwin.errors import InvalidInput
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import Acknowledge, InvalidMessage, encode
from servotwin.runtime.frames import FrameSocket

NICE = 10
TEND_S = 1.0
SHORTEST_S = 0.1
"""Between two polls that bring nothing: a twin that does not wait, since it ends, is not asked as often as it goes."""


class LinkProcess:
    """One child of a control process.

    Parameters
    ----------
    config : EdgeConfig
    end : socket
        To the control process.
    """

    def __init__(self, config: EdgeConfig, end: socket.socket) -> None:
        self._config, self._end, self._pipe = config, end, FrameSocket(end)
        keeping = config.keeping
        self.outbox = SqliteOutbox(config.path(keeping.outbox), config.agent.servo, keeping.windows, keeping.bytes)
        self.outbox.settle()
        self._keeper = Keeper(config, self.outbox)
        self._transport = transport_of(config)
        self._courier = courier_of(config, self.outbox, self._transport, random.random)
        self._listener = listener_of(config, self.outbox, self._transport, random.random)
        self._news, self._stopping = Event(), Event()
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._outgoing: list[bytes] = []
        self._broken: list[BaseException] = []
        self._ticks: frames.TicksFrame | None = None
        self._told = (-1, Counter[str]())
        self._faults: Counter[str] = Counter()
        self._troubles, self._given_up = Troubles(), dict[str, int]()
        self._token, self._renewed = _token(config), False

    def run(self) -> None:
        """Until the control process is gone."""
        threads = [Thread(target=self._guarded, args=(work,)) for work in self._works()]
        for thread in threads:
            thread.start()
        try:
            self._serve()
        finally:
            self._end_all(threads)
        if self._broken:
            raise self._broken[0]

    def _works(self) -> list[Callable[[], None]]:
        return [] if self._transport is None else [self._send, self._listen]

    def _guarded(self, work: Callable[[], None]) -> None:
        """A thread that fails ends the process: the control process starts another."""
        try:
            work()
        except BaseException as error:
            self._broken.append(error)
            self._emit(b"")

    def _serve(self) -> None:
        tended = 0.0
        while not (self._pipe.broken or self._broken or self._renewed):
            self._stand()
            while self._outgoing:
                self._pipe.post(self._outgoing.pop(0))
            self._pipe.send()
            left = max(0.0, tended + TEND_S - time.monotonic())
            wanting = [self._end] if self._pipe.backlog else []
            readable, _, _ = select.select([self._end, self._woken], wanting, [], left)
            if self._woken in readable:
                self._woken.recv(4096)
            if self._end in readable:
                self._receive()
            if time.monotonic() >= tended + TEND_S:
                tended = time.monotonic()
                self._tend()

    def _receive(self) -> None:
        for data in self._pipe.receive():
            try:
                self._take(frames.to_link(data))
            except InvalidMessage:
                self._faults["frame not understood"] += 1

    def _take(self, frame: frames.ToLink) -> None:
        if isinstance(frame, frames.TicksFrame):
            self._ticks = frame
            return
        for serial in self._keeper.take(frame):
            self._pipe.post(frames.encode(frames.DoneFrame(serial)))
        self._news.set()

    def _tend(self) -> None:
        for serial in self._keeper.tend():
            self._pipe.post(frames.encode(frames.DoneFrame(serial)))
        self._look()
        self._renew()
        try:
            write_status(self._config.path(self._config.keeping.status), self._status())
        except OSError:
            self._faults["status not written"] += 1

    def _renew(self) -> None:
        """A token that was replaced since: the link process that comes after this one reads it."""
        if self._courier is None or self._listener is None or not (self._courier.trouble or self._listener.trouble):
            return
        with suppress(InvalidInput):  # it is being replaced just now
            self._renewed = _token(self._config) != self._token
        if self._renewed:
            say("token replaced")

    def _look(self) -> None:
        """Let whoever reads the log know what has gone wrong since, and what is well again."""
        if self._stopping.is_set():
            return
        look = self._troubles.look
        look("disk", "" if self.outbox.safe else self.outbox.trouble)
        if self._courier is not None and self._listener is not None:
            look("to the twin", self._courier.trouble)
            look("from the twin", self._listener.trouble)
        dropped = {why: number for why, number in self.outbox.dropped.items() if why != WITHHELD}
        if dropped != self._given_up:
            self._given_up = dropped
            say("windows dropped", **dropped)

    def _stand(self) -> None:
        """Tell the control process what waits, when that has changed: before it hears of an acknowledgement."""
        now = len(self.outbox.pending()), Counter(self.outbox.dropped)
        if now != self._told:
            self._told = now
            self._pipe.post(frames.encode(frames.StandingFrame(now[0], dict(now[1]))))

    def _send(self) -> None:
        assert self._courier is not None
        while not self._stopping.is_set():
            self._news.clear()
            sent = self._courier.step(time.monotonic())
            if sent.window is not None:
                acknowledge = Acknowledge(self._config.agent.servo, *sent.window)
                self._emit(frames.encode(frames.HeardFrame(0, encode(acknowledge))))
            if sent.back:
                self._emit(frames.encode(frames.BackFrame()))
            if sent.wait_s > 0.0:
                self._news.wait(min(sent.wait_s, 3600.0))

    def _listen(self) -> None:
        assert self._listener is not None
        while not self._stopping.is_set():
            told = self._listener.step()
            for serial, body in told.messages:
                self._emit(frames.encode(frames.HeardFrame(serial, body)))
            self._stopping.wait(told.wait_s if told.messages else max(told.wait_s, SHORTEST_S))

    def _emit(self, frame: bytes) -> None:
        """From another thread: let the main one send it."""
        if frame:
            self._outgoing.append(frame)
        with suppress(BlockingIOError):  # as many as fit are enough to wake it
            self._wake.send(b"w")

    def _end_all(self, threads: list[Thread]) -> None:
        self._stopping.set()
        self._news.set()
        if self._transport is not None:
            self._transport.close()
        for thread in threads:
            thread.join()
        self._tend()
        self.outbox.close()
        for end in (self._wake, self._woken):
            end.close()
        self._pipe.close()

    def _status(self) -> dict[str, Any]:
        ticks, box = self._ticks, self.outbox
        known: dict[str, Any] = {"servo": self._config.agent.servo, "role": self._config.role}
        if ticks is not None:
            longest = float(ticks.values.get("longest_tick_s") or 0.0)
            known |= {"boot": ticks.boot, "samples": ticks.samples, **ticks.values}
            known["tick"] = summary(ticks.ticks, longest)
        known["windows"] = {
            "waiting": len(box.pending()),
            "letters_waiting": len(box.letters()),
            "dropped": {**(ticks.dropped if ticks is not None else {}), **box.dropped},
        }
        known["disk"] = {
            "safe": box.safe,
            "trouble": box.trouble,
            "faults": dict(box.faults + self._faults + self._keeper.faults),
        }
        if self._courier is not None and self._listener is not None:
            known["up"] = {"trouble": self._courier.trouble, **self._courier.counts}
            known["down"] = {"trouble": self._listener.trouble, **self._listener.counts}
        return {**known, "link_process": os.getpid(), "written": time.time()}


def _token(config: EdgeConfig) -> str:
    """The servo's; empty where there is no twin."""
    return "" if config.twin is None else token_of(config.twin, config.folder)


def main(arguments: list[str]) -> int:
    """Run as a child."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICE)
    path, descriptor = arguments
    end = socket.socket(fileno=int(descriptor))
    try:
        LinkProcess(load(path), end).run()
    except Exception as error:
        say("link process failed", error=f"{type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
