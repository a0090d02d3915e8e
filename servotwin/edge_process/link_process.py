"""The link process: it filters, packs, stores, sends and receives, so that the control process never waits.

`python -m servotwin.edge_process.link_process edge.toml FD RUN`; it ends when the other end of the socket FD is closed.

A frame of the control process is confirmed when its content is on the disk, or when nothing of it has to be stored.
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
from typing import Any, NamedTuple

import msgspec

from servotwin.edge.outlet import FILTERED, WindowWriter
from servotwin.edge.store import FileParameterStore
from servotwin.edge_process import frames
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import load
from servotwin.edge_process.frames import LetterFrame, ProcessedFrame, SaveFrame, StatusFrame, ToLink, WindowFrame
from servotwin.edge_process.monitoring import TroubleLog, log, summarise, write_status
from servotwin.edge_process.transports import exclusive_transport, link_token
from servotwin.errors import InvalidInput
from servotwin.link.outbox import Key
from servotwin.link.session import Receiver, Sender, Session
from servotwin.link.sqlite_outbox import MOST_UNWRITTEN, SqliteOutbox
from servotwin.messages import Acknowledge, InvalidMessage, LearntResponse, decode, encode
from servotwin.runtime.frames import FrameSocket

CURSOR = "cursor"
"""Name under which the outbox keeps the serial of the twin's last message that was processed."""

_LAST_CUT = "last cut"


class _Unconfirmed(NamedTuple):
    """A frame whose content is not on the disk yet: the key of its window (None: a letter), and its bytes."""

    window: Key | None
    size: int


class FrameHandler:
    """Handles frames of the control process; returns the serials that are confirmed.

    Parameters
    ----------
    config : EdgeConfig
    outbox : SqliteOutbox
    """

    def __init__(self, config: EdgeConfig, outbox: SqliteOutbox) -> None:
        self._config, self._outbox = config, outbox
        self._store = FileParameterStore(config.path(config.files.parameters))
        self._unsaved: SaveFrame | None = None
        self._writer: WindowWriter | None = None
        self._boot = ""
        self._unconfirmed: dict[int, _Unconfirmed] = {}
        self.faults: Counter[str] = Counter()

    def handle(self, frame: ToLink) -> list[int]:
        """Handle one frame; return the serials confirmed by it."""
        if isinstance(frame, WindowFrame):
            with self._outbox.transaction():
                self._write(frame)
            size = sum(map(len, frame.signals.values()))
            self._unconfirmed[frame.serial] = _Unconfirmed((frame.boot, frame.sequence), size)
            return self._confirmed()
        if isinstance(frame, LetterFrame):
            self._outbox.put_letter(frame.body)
            self._unconfirmed[frame.serial] = _Unconfirmed(None, len(frame.body))
            return self._confirmed()
        if isinstance(frame, frames.ResponseFrame):
            with self._outbox.transaction():
                self._adopt(frame)
            self._unconfirmed[frame.serial] = _Unconfirmed(None, len(frame.body))
            return self._confirmed()
        if isinstance(frame, SaveFrame):
            # Newer parameters replace unwritten ones, whose frame is confirmed because nobody needs it any more.
            before, self._unsaved = self._unsaved, frame
            return ([] if before is None else [before.serial]) + self._save()
        if isinstance(frame, ProcessedFrame):
            self._outbox.set_number(CURSOR, max(frame.serial, self._outbox.number(CURSOR)))
        assert not isinstance(frame, StatusFrame)
        return []

    def retry(self) -> list[int]:
        """Write again what could not be written; return the serials confirmed by it."""
        self._outbox.flush()
        return self._confirmed() + self._save()

    def _confirmed(self) -> list[int]:
        """Serials of frames that are on the disk, were dropped, or are beyond the limit of unwritten bytes."""
        flushed, pending = self._outbox.flushed, set(self._outbox.pending())
        over = sum(each.size for each in self._unconfirmed.values()) - MOST_UNWRITTEN
        confirmed = []
        for serial, each in self._unconfirmed.items():
            if flushed or over > 0 or (each.window is not None and each.window not in pending):
                confirmed.append(serial)
                over -= each.size
        for serial in confirmed:
            del self._unconfirmed[serial]
        return confirmed

    def _write(self, frame: WindowFrame) -> None:
        """Write a window once: a repeated one is recognised by its sequence in its boot."""
        last = self._outbox.value(_LAST_CUT)
        boot, sequence = ("", -1) if last is None else msgspec.msgpack.decode(last, type=tuple[str, int])
        if boot == frame.boot and frame.sequence <= sequence:
            return
        # In the transaction of the window itself: after a crash both are on the disk, or neither.
        self._outbox.set_value(_LAST_CUT, msgspec.msgpack.encode((frame.boot, frame.sequence)))
        self._writer_of(frame.boot).write(frame.cut)

    def _adopt(self, frame: frames.ResponseFrame) -> None:
        """Have the window filter use a response; a repeated one is not newer, and changes nothing."""
        response = decode(frame.body)
        assert isinstance(response, LearntResponse)
        self._writer_of(frame.boot).adopt(response)

    def _writer_of(self, boot: str) -> WindowWriter:
        if self._writer is None or boot != self._boot:
            self._boot = boot
            self._writer = WindowWriter(self._config.settings(boot), self._outbox, self.faults)
        return self._writer

    def _save(self) -> list[int]:
        if self._unsaved is None:
            return []
        try:
            self._store.save(self._unsaved.parameters.parameters())
        except OSError:
            self.faults["parameters not written"] += 1
            return []
        serial, self._unsaved = self._unsaved.serial, None
        return [serial]


_NICE = 10
STATUS_PERIOD_S = 1.0
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
    """

    def __init__(self, config: EdgeConfig, end: socket.socket, run: str) -> None:
        self._config, self._end, self._pipe = config, end, FrameSocket(end)
        files = config.files
        self.outbox = SqliteOutbox(config.path(files.outbox), config.agent.servo, files.windows, files.bytes)
        self.outbox.flush()
        self._handler = FrameHandler(config, self.outbox)
        self._token, self._token_replaced = link_token(config), False
        self._transport = exclusive_transport(config, self.outbox, run)
        self._session = Session(self.outbox, config.agent.retry, random.random)
        self._sender = self._receiver = None
        if self._transport is not None:
            cursor, retry = self.outbox.number(CURSOR), config.agent.retry
            self._sender = Sender(self._session, self._transport)
            self._receiver = Receiver(self._transport, config.agent.servo, self._token, cursor, retry, random.random)
        self._outbox_changed, self._stopping = Event(), Event()
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._outgoing: list[bytes] = []
        self._broken: list[BaseException] = []
        self._control: frames.StatusFrame | None = None
        self._pending = (-1, Counter[str]())
        self._faults: Counter[str] = Counter()
        self._troubles, self._dropped = TroubleLog(), dict[str, int]()
        self._conflict = False

    def run(self) -> None:
        """Run until the control process is gone."""
        loops = [] if self._transport is None else [self._send, self._receive]
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
        while not (self._pipe.broken or self._broken or self._token_replaced):
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
        self._check_token()
        try:
            write_status(self._config.path(self._config.files.status), self._status())
        except OSError:
            self._faults["status not written"] += 1

    def _check_token(self) -> None:
        """End where the token was replaced: the next link process reads the new one."""
        if self._receiver is None or not (self._session.trouble or self._receiver.trouble):
            return
        with suppress(InvalidInput):  # it is being replaced just now
            self._token_replaced = link_token(self._config) != self._token
        if self._token_replaced:
            log("token replaced")

    def _log_troubles(self) -> None:
        """Log new troubles, and those that are over."""
        if self._stopping.is_set():
            return
        self._troubles.update("disk", "" if self.outbox.flushed else self.outbox.trouble)
        if self._receiver is not None:
            self._troubles.update("to the twin", self._session.trouble)
            self._troubles.update("from the twin", self._receiver.trouble)
        dropped = {why: number for why, number in self.outbox.dropped.items() if why != FILTERED}
        if dropped != self._dropped:
            self._dropped = dropped
            log("windows dropped", **dropped)

    def _report_conflict(self) -> None:
        """Tell the control process, once, that another edge of the servo has taken over."""
        if self._transport is not None and self._transport.superseded and not self._conflict:
            self._conflict = True
            self._pipe.post(frames.encode(frames.SupersededFrame()))

    def _send_pending(self) -> None:
        """Send the number of pending windows to the control process where it has changed."""
        # Before the acknowledgement: with the old number the agent would think that the twin still has to answer.
        now = len(self.outbox.pending()), Counter(self.outbox.dropped)
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
            if sent.wait_s > 0.0:
                # An event cannot be waited for infinitely long in seconds.
                self._outbox_changed.wait(min(sent.wait_s, 3600.0))

    def _receive(self) -> None:
        assert self._receiver is not None
        while not self._stopping.is_set():
            received = self._receiver.step()
            for serial, body in received.messages:
                self._emit(frames.encode(frames.MessageFrame(serial, body)))
            self._stopping.wait(received.wait_s if received.messages else max(received.wait_s, _SHORTEST_POLL_S))

    def _emit(self, frame: bytes) -> None:
        """Have the main thread send a frame; called from another."""
        if frame:
            self._outgoing.append(frame)
        with suppress(BlockingIOError):  # a full socket wakes the main thread too
            self._wake.send(b"w")

    def _end_all(self, threads: list[Thread]) -> None:
        self._stopping.set()
        self._outbox_changed.set()
        if self._transport is not None:
            # First the blocking calls, so that the threads end; then the file, which they use.
            self._transport.close()
        for thread in threads:
            thread.join()
        self._check()
        self.outbox.close()
        for end in (self._wake, self._woken):
            end.close()
        self._pipe.close()

    def _status(self) -> dict[str, Any]:
        control, box = self._control, self.outbox
        status: dict[str, Any] = {"servo": self._config.agent.servo, "role": self._config.role}
        if control is not None:
            longest = float(control.values.get("longest_tick_s") or 0.0)
            status |= {"boot": control.boot, "samples": control.samples, **control.values}
            status["tick"] = summarise(control.ticks, longest)
        status["windows"] = {
            "waiting": len(box.pending()),
            "letters_waiting": len(box.letters()),
            "dropped": {**(control.dropped if control is not None else {}), **box.dropped},
        }
        status["disk"] = {
            "safe": box.flushed,
            "trouble": box.trouble,
            "faults": dict(box.faults + self._faults + self._handler.faults),
        }
        if self._receiver is not None:
            status["up"] = {"trouble": self._session.trouble, **self._session.counts}
            status["conflict"] = self._conflict
            status["down"] = {"trouble": self._receiver.trouble, **self._receiver.counts}
        return {**status, "link_process": os.getpid(), "written": time.time()}


def main(arguments: list[str]) -> int:
    """Run as the child of a control process; return the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICE)
    path, descriptor, run = arguments
    end = socket.socket(fileno=int(descriptor))
    try:
        LinkProcess(load(path), end, run).run()
    except Exception as error:
        log("link process failed", error=f"{type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
