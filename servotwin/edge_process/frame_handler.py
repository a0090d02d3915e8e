"""Handler of the control process's frames in the link process: it filters, packs and stores what they carry.

A frame is confirmed when its content is on the disk, or when nothing of it has to be stored.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import msgspec

from servotwin.edge.outlet import WindowWriter
from servotwin.edge.store import FileParameterStore
from servotwin.edge_process import frames
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.frames import LetterFrame, ProcessedFrame, SaveFrame, StatusFrame, ToLink, WindowFrame
from servotwin.link.outbox import Key
from servotwin.link.sqlite_outbox import MOST_UNWRITTEN, SqliteOutbox
from servotwin.messages import LearntResponse, decode

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
        flushed = self._outbox.flushed
        pending = set() if flushed else set(self._outbox.pending())
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
