"""What the link process does with what the control process hands it: judge, pack, keep; what is done is done once."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import msgspec

from servotwin.edge.cut import Cut
from servotwin.edge.outlet import NOT_FINITE, WITHHELD
from servotwin.edge.packing import is_finite, pack
from servotwin.edge.store import FileParameterStore
from servotwin.edge.window_filter import WindowFilter
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.frames import CutFrame, HandledFrame, LetterFrame, SaveFrame, TicksFrame, ToLink
from servotwin.edge_process.twin_link import CURSOR
from servotwin.errors import InvalidInput
from servotwin.link.outbox import Key
from servotwin.link.sqlite_outbox import MOST_OWED, SqliteOutbox
from servotwin.messages import InvalidMessage

_LAST, _FILTER_STATE = "last cut", "novelty"
UNJUDGED = "window not judged"


class Owed(NamedTuple):
    """What the disk does not have yet: a window's key (None: a letter's), and bytes as they came."""

    window: Key | None
    size: int


class Keeper:
    """Takes frames; says which serials are safe.

    Parameters
    ----------
    config : EdgeConfig
    outbox : SqliteOutbox
    """

    def __init__(self, config: EdgeConfig, outbox: SqliteOutbox) -> None:
        self._config, self._outbox = config, outbox
        self._store = FileParameterStore(config.path(config.keeping.parameters))
        self._unsaved: SaveFrame | None = None
        self._filter: WindowFilter | None = None
        self._boot = ""
        self._owed: dict[int, Owed] = {}
        self.faults: Counter[str] = Counter()

    def take(self, frame: ToLink) -> list[int]:
        """Do what a frame asks for."""
        if isinstance(frame, CutFrame):
            with self._outbox.together():
                self._cut(frame)
            self._owed[frame.serial] = Owed((frame.boot, frame.sequence), sum(map(len, frame.signals.values())))
            return self._written()
        if isinstance(frame, LetterFrame):
            self._outbox.post(frame.body)
            self._owed[frame.serial] = Owed(None, len(frame.body))
            return self._written()
        if isinstance(frame, SaveFrame):
            before, self._unsaved = self._unsaved, frame
            return ([] if before is None else [before.serial]) + self._save()
        if isinstance(frame, HandledFrame):
            self._outbox.remember(CURSOR, max(frame.serial, self._outbox.recall(CURSOR)))
        assert not isinstance(frame, TicksFrame)
        return []

    def tend(self) -> list[int]:
        """Try again what could not be done."""
        self._outbox.settle()
        return self._written() + self._save()

    def _written(self) -> list[int]:
        """What the control process need not keep any more: it is on the disk, or gone, or too much to wait with."""
        safe, waiting = self._outbox.safe, set(self._outbox.pending())
        over, done = sum(owed.size for owed in self._owed.values()) - MOST_OWED, []
        for serial, owed in self._owed.items():
            if safe or over > 0 or (owed.window is not None and owed.window not in waiting):
                done.append(serial)
                over -= owed.size
        for serial in done:
            del self._owed[serial]
        return done

    def _cut(self, frame: CutFrame) -> None:
        """Once: a frame that comes again, since nobody said that it was taken, is known by its place in its boot."""
        here = msgspec.msgpack.encode((frame.boot, frame.sequence))
        last = self._outbox.noted(_LAST)
        boot, sequence = ("", -1) if last is None else msgspec.msgpack.decode(last, type=tuple[str, int])
        if boot == frame.boot and frame.sequence <= sequence:
            return
        self._outbox.note(_LAST, here)
        wanted = self._wanted(frame.cut, self._filter_of(frame.boot))
        if wanted is None:
            self._outbox.lost(WITHHELD)
            return
        try:
            window = pack(wanted, self._config.settings(frame.boot))
        except InvalidMessage:
            self._outbox.lost(NOT_FINITE)
        else:
            self._outbox.put(window)

    def _wanted(self, cut: Cut, judge: WindowFilter | None) -> Cut | None:
        """The window, if it is worth sending; one that cannot be judged is."""
        if judge is None or not is_finite(cut):
            return cut
        try:
            found = judge(cut)
        except Exception:
            self.faults[UNJUDGED] += 1
            return cut
        self._outbox.note(_FILTER_STATE, judge.dumps())
        return found

    def _filter_of(self, boot: str) -> WindowFilter | None:
        """The window filter of a boot, which begins with the state that the last one saved."""
        settings = self._config.agent.window_filter
        if settings is not None and (self._filter is None or boot != self._boot):
            self._boot = boot
            try:
                self._filter = settings.start(self._outbox.noted(_FILTER_STATE))
            except InvalidInput:
                self._filter = settings.start()
        return self._filter

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
