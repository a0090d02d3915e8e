"""Signals that end a command, as an exception, so that it leaves nothing half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EndedBySignal(KeyboardInterrupt):
    """A signal is to end the command.

    Attributes
    ----------
    code : int
        Exit code by the custom of shells.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.code = 128 + number


class EndSignals:
    """Raises `EndedBySignal` at the first signal; later ones must not disturb the undoing of the work."""

    def __init__(self) -> None:
        self._over = False

    def ignore(self) -> None:
        """Let no signal end the work any more: it is as good as done."""
        self._over = True

    def handle(self, number: int, _frame: FrameType | None) -> None:
        """Handle a signal."""
        if not self._over:
            self._over = True
            raise EndedBySignal(number)


@contextmanager
def end_signals() -> Iterator[EndSignals]:
    """Raise `EndedBySignal` where an interrupt, SIGTERM or SIGHUP (a closed terminal) comes within the block.

    What is ignored stays so, as under nohup. Outside of the main thread nothing changes.
    """
    signals = EndSignals()
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return
    heard = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    former = {number: signal.signal(number, signals.handle) for number in heard}
    try:
        yield signals
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
