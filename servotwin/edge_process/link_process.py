"""The link process: it filters, packs, stores, sends and receives, so that the control process never waits.

`python -m servotwin.edge_process.link_process edge.toml FD RUN [SAMPLES]`; it ends when the other end of the socket FD
is closed. SAMPLES is the descriptor of the memory with the samples, for the live view.

`frame_handler` takes the control process's frames.
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
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

from servotwin.edge.outlet import FILTERED
from servotwin.edge_process import frames
from servotwin.edge_process.config import EdgeConfig, certificates_of, token_of
from servotwin.edge_process.config_file import load
from servotwin.edge_process.frame_handler import CURSOR, FrameHandler
from servotwin.edge_process.live_view import LiveView
from servotwin.edge_process.metrics import write_metrics
from servotwin.edge_process.monitoring import (
    TroubleLog,
    former_trouble,
    log,
    log_outbox,
    overwrite_status,
    read_status,
    summarise,
    write_status,
)
from servotwin.edge_process.open_outbox import open_outbox
from servotwin.edge_process.shared_samples import SampleReader
from servotwin.edge_process.transports import exclusive_transport, live_link
from servotwin.edge_process.twin_limits import limits_told, version_trouble, window_trouble
from servotwin.errors import InvalidInput
from servotwin.link.claim import ExclusiveTransport
from servotwin.link.session import Receiver, Sender, Session
from servotwin.messages import Acknowledge, ClaimStatus, InvalidMessage, Resend, decode, encode
from servotwin.runtime.frames import FrameSocket
from servotwin.runtime.locks import locked

_NICE = 10
_PREDECESSOR_S, _LOCK_S = 30.0, 0.05  # how long a link process waits for the end of the one before, and how often
STATUS_PERIOD_S = 1.0
_OLDER_FOLDER = (
    "this folder knows nothing of that run, which came before this one: it is an older one that was put back, or a copy"
)
_SHORTEST_POLL_S = 0.1
"""Time between two empty polls: a twin that is about to end answers a poll at once."""


class LinkProcess:
    """Link process of a control process.

    Parameters
    ----------
    config : EdgeConfig
    end : socket
        To the control process.
    run : str
        Name of the control process's run, which claims the servo.
    samples : SampleReader, optional
        Samples for the live view.
    """

    def __init__(self, config: EdgeConfig, end: socket.socket, run: str, samples: SampleReader | None = None) -> None:
        self._config, self._end, self._pipe = config, end, FrameSocket(end)
        last = read_status(config.path(config.files.status)) or {}
        if last.get("servo", config.agent.servo) != config.agent.servo:
            last = {}  # what another servo's outbox held is not lost
        self._run, self.outbox = run, open_outbox(config, last, run)
        self.outbox.flush()
        self._handler = FrameHandler(config, self.outbox)
        self._token, self._certificates, self._replaced = token_of(config), certificates_of(config), False
        self._transport = exclusive_transport(config, self.outbox, run)
        self._session = Session(self.outbox, config.agent.retry, random.random)
        self._sender = self._receiver = None
        up, down = former_trouble(last, run, "up"), former_trouble(last, run, "down")
        if self._transport is not None:
            servo, retry, cursor = config.agent.servo, config.agent.retry, self.outbox.number(CURSOR)
            self._session.trouble = up
            self._sender = Sender(self._session, self._transport)
            self._receiver = Receiver(self._transport, servo, self._token, cursor, retry, random.random, trouble=down)
        self._outbox_changed, self._twin_reached, self._stopping = Event(), Event(), Event()
        self._live = _live_view(config, run, samples, self._transport, self._stopping)
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._outgoing: list[bytes] = []
        self._broken: list[BaseException] = []
        self._control: frames.StatusFrame | None = None
        self._pending, self._faults = (-1, Counter[str]()), Counter[str]()
        # Counts of earlier processes are in their logs; what a corrupt file has just cost is in none.
        self._troubles = TroubleLog({"to the twin": up, "from the twin": down})
        self._dropped = {} if self.outbox.salvages or self.outbox.missing else self._dropped_unintended()
        self._conflict, self._behind, self._status_trouble = False, "", ""

    def run(self) -> None:
        """Run until the control process is gone."""
        loops = [] if self._transport is None else [self._send, self._receive]
        loops += [] if self._live is None else [self._live.run]
        threads = [Thread(target=self._guarded, args=(loop,)) for loop in loops]
        for thread in threads:
            thread.start()
        try:
            self._serve()
        finally:
            self._end_all(threads)
        if self._broken:
            raise self._broken[0]

    def _guarded(self, loop: Callable[[], None]) -> None:
        """Run a thread's loop; an error in it ends the process, and the control process starts another."""
        try:
            loop()
        except BaseException as error:
            self._broken.append(error)
            self._emit(b"")

    def _serve(self) -> None:
        checked = 0.0
        while not (self._pipe.broken or self._broken or self._replaced):
            self._send_pending()
            while self._outgoing:
                self._pipe.post(self._outgoing.pop(0))
            self._pipe.send()
            left = max(0.0, checked + STATUS_PERIOD_S - time.monotonic())
            writers = [self._end] if self._pipe.backlog else []
            readable, _, _ = select.select([self._end, self._woken], writers, [], left)
            if self._woken in readable:
                self._woken.recv(4096)
            if self._end in readable:
                self._receive_frames()
            if time.monotonic() >= checked + STATUS_PERIOD_S:
                checked = time.monotonic()
                self._check()

    def _receive_frames(self) -> None:
        for data in self._pipe.receive():
            try:
                self._handle(frames.to_link(data))
            except InvalidMessage:
                self._faults["frame not understood"] += 1

    def _handle(self, frame: frames.ToLink) -> None:
        if isinstance(frame, frames.StatusFrame):
            self._control = frame
            return
        for serial in self._handler.handle(frame):
            self._pipe.post(frames.encode(frames.AckFrame(serial)))
        self._outbox_changed.set()

    def _check(self) -> None:
        for serial in self._handler.retry():
            self._pipe.post(frames.encode(frames.AckFrame(serial)))
        self._log_troubles()
        self._report_conflict()
        self._check_replaced()
        self._write_status()

    def _write_status(self) -> None:
        """Write the status; on a full disk into the old file's place, so that it does not go on saying "safe"."""
        path, metrics = self._config.path(self._config.files.status), self._config.files.metrics
        try:
            write_status(path, self._status())
            self._status_trouble = ""
        except OSError as error:
            self._faults["status not written"] += 1
            self._status_trouble = str(error)
            with suppress(OSError):
                overwrite_status(path, self._status())
        if metrics is None:
            return
        trouble = ""
        try:
            write_metrics(self._config.path(metrics), self._status())
        except OSError as error:
            self._faults["metrics not written"] += 1
            trouble = str(error)
        self._troubles.update("metrics", trouble)

    def _check_replaced(self) -> None:
        """End where the token, or the certificates, were replaced: the next link process reads the new ones."""
        if self._replaced or self._receiver is None or not (self._session.trouble or self._receiver.trouble):
            return
        with suppress(InvalidInput):  # one is being replaced just now
            token, certificates = token_of(self._config), certificates_of(self._config)
            self._replaced = (token, certificates) != (self._token, self._certificates)
            if self._replaced:
                log("token replaced" if token != self._token else "certificates replaced")

    def _log_troubles(self) -> None:
        """Log new troubles, and those that are over."""
        if self._stopping.is_set():
            return
        self._troubles.update("disk", self._disk_trouble)
        log_outbox(self.outbox)
        if self._receiver is not None:
            self._troubles.update("to the twin", self._session.trouble)
            self._troubles.update("from the twin", self._receiver.trouble)
            self._troubles.update("windows", window_trouble(self._config.agent, self._twin))
            self._troubles.update("version", version_trouble(self._session, self._receiver))
        if (dropped := self._dropped_unintended()) != self._dropped:
            self._dropped = dropped
            log("windows dropped", **dropped)

    def _dropped_unintended(self) -> dict[str, int]:
        return {why: number for why, number in self.outbox.dropped.items() if why != FILTERED}

    def _report_conflict(self) -> None:
        """Tell the control process, once, that another edge of the servo has taken over; log that one had before."""
        if self._transport is not None and self._transport.superseded and not self._conflict:
            self._conflict = True
            self._pipe.post(frames.encode(frames.SupersededFrame()))
        if self._transport is not None and self._transport.behind != self._behind:
            self._behind = self._transport.behind
            self._faults["folder behind"] += 1
            log("folder behind", run=self._behind, why=_OLDER_FOLDER)

    def _send_pending(self) -> None:
        """Send the number of pending windows to the control process where it has changed."""
        # Before the acknowledgement: with the old number the agent would think that the twin still has to answer.
        now = self.outbox.waiting, Counter(self.outbox.dropped)
        if now != self._pending:
            self._pending = now
            self._pipe.post(frames.encode(frames.PendingFrame(now[0], dict(now[1]))))

    def _send(self) -> None:
        assert self._sender is not None
        while not self._stopping.is_set():
            # Before the step: a message that comes meanwhile ends the wait after it.
            self._outbox_changed.clear()
            sent = self._sender.step(time.monotonic())
            if sent.window is not None:
                acknowledge = Acknowledge(self._config.agent.servo, *sent.window)
                self._emit(frames.encode(frames.MessageFrame(0, encode(acknowledge))))
            if sent.reconnected:
                self._emit(frames.encode(frames.ReconnectedFrame()))
                self._twin_reached.set()
                self._sender.transport.listen_anew()
            if sent.wait_s > 0.0:
                # An event cannot be waited for infinitely long in seconds.
                self._outbox_changed.wait(min(sent.wait_s, 3600.0))

    def _receive(self) -> None:
        assert self._receiver is not None
        while not self._stopping.is_set():
            received = self._receiver.step()
            if received.reconnected:
                self._session.twin_is_back(time.monotonic())
                self._outbox_changed.set()
            for serial, body in received.messages:
                self._resend(body)
                self._emit(frames.encode(frames.MessageFrame(serial, body)))
            self._twin_reached.wait(received.wait_s if received.messages else max(received.wait_s, _SHORTEST_POLL_S))
            self._twin_reached.clear()

    def _resend(self, body: bytes) -> None:
        """Send acknowledged windows again where the twin asks for them; the agent introduces itself again."""
        message = decode(body)
        if isinstance(message, Resend) and message.servo == self._config.agent.servo:
            number = self.outbox.resend(message.asks_for)
            if number:  # it may ask for windows that the filter kept back, again and again
                log("windows asked for again", number=number, why=message.reason)
                self._outbox_changed.set()

    def _emit(self, frame: bytes) -> None:
        """Have the main thread send a frame; called from another."""
        if frame:
            self._outgoing.append(frame)
        with suppress(BlockingIOError):  # a full socket wakes the main thread too
            self._wake.send(b"w")

    def _end_all(self, threads: list[Thread]) -> None:
        self._stopping.set()
        self._outbox_changed.set()
        self._twin_reached.set()
        if self._transport is not None:
            # First the blocking calls, so that the threads end; then the file, which they use.
            self._transport.close()
        if self._live is not None:
            self._live.close()
        for thread in threads:
            thread.join()
        self._check()
        self.outbox.close()
        for end in (self._wake, self._woken):
            end.close()
        self._pipe.close()

    @property
    def _disk_trouble(self) -> str:
        """Reason for which something is not on the disk; empty: all is."""
        return self._status_trouble if self.outbox.flushed else self.outbox.trouble or "not written yet"

    @property
    def _twin(self) -> ClaimStatus | None:
        """Answer of the twin to the claim; None: there is no twin, or it has not answered."""
        return None if self._transport is None else self._transport.twin

    def _status(self) -> dict[str, Any]:
        control, box = self._control, self.outbox
        status: dict[str, Any] = {"servo": self._config.agent.servo, "role": self._config.role, "run": self._run}
        if control is not None:
            longest = float(control.values.get("longest_tick_s") or 0.0)
            status |= {"boot": control.boot, "samples": control.samples, **control.values}
            status["tick"] = summarise(control.ticks, longest)
        status["windows"] = {
            "waiting": box.waiting,
            "stored": box.stored,
            "letters_waiting": len(box.letters()),
            "dropped": {**(control.dropped if control is not None else {}), **box.dropped},
        }
        status["disk"] = {
            "safe": not self._disk_trouble,
            "trouble": self._disk_trouble,
            "faults": dict(box.faults + self._faults + self._handler.faults),
        }
        if self._receiver is not None:
            # As logged: while the process ends, its own end is no trouble.
            status["up"] = {"trouble": self._troubles.logged("to the twin"), **self._session.counts}
            status["conflict"] = self._conflict
            status["limits"] = limits_told(self._twin)
            if self._live is not None:
                status["live"] = dict(self._live.counts)
            status["down"] = {"trouble": self._troubles.logged("from the twin"), **self._receiver.counts}
        return {**status, "link_process": os.getpid(), "written": time.time()}


def _live_view(
    config: EdgeConfig, run: str, samples: SampleReader | None, transport: ExclusiveTransport | None, stopping: Event
) -> LiveView | None:
    """Make the live view where the edge's file allows it."""
    if samples is None or transport is None:
        return None
    link = live_link(config, run)
    if link is None:
        return None
    agent = config.agent
    return LiveView(link, samples, agent.servo, agent.sample_rate, lambda: transport.claim, stopping)


def run_alone(config: EdgeConfig, end: socket.socket, run: str, samples: SampleReader | None = None) -> None:
    """Run a link process once the one before it has ended.

    Where the control process was killed alone, its link process still stores what it has received: a window that comes
    into the file after the next one has read it would wait there until the edge is started again. One that hangs, on a
    dead disk for one, is waited for only so long.
    """
    with ExitStack() as lock:
        try:
            _enter(lock, config.path(f"{config.files.outbox}-link-lock"))
        except OSError as error:
            log("not locked", error=str(error))
        LinkProcess(config, end, run, samples).run()


def _enter(lock: ExitStack, path: Path) -> None:
    """Wait for the lock and hold it; BlockingIOError after `_PREDECESSOR_S`."""
    until, logged = time.monotonic() + _PREDECESSOR_S, False
    while True:
        try:
            lock.enter_context(locked(path))
            return
        except BlockingIOError:
            if time.monotonic() >= until:
                raise BlockingIOError(f"the link process before has not ended within {_PREDECESSOR_S:g} s") from None
            if not logged:
                log("not locked", error="the link process before still runs; waiting for its end")
                logged = True
        time.sleep(_LOCK_S)


def main(arguments: list[str]) -> int:
    """Run as the child of a control process; return the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICE)
    path, descriptor, run, *shared = arguments
    end = socket.socket(fileno=int(descriptor))
    try:
        run_alone(load(path), end, run, SampleReader(int(shared[0])) if shared else None)
    except Exception as error:
        log("link process failed", error=f"{type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
