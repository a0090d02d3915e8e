"""Progress of the compilation in the first call, shown to the person at the terminal.

numba compiles a kernel at its first call and caches it on disk: half a minute that would otherwise pass in silence.
Progress goes to the standard error of the main process, and only if that is a terminal or a notebook: pipes, logs,
services and ``--json`` are unchanged.
"""

from __future__ import annotations

import multiprocessing
import sys
import threading
import time
from typing import Any

from numba.core.event import Event, Listener, register

_TEXT = "servotwin: compiling kernels (once on this machine, half a minute or more)"


class CompileProgress(Listener):
    """Listener to numba's compilations of servotwin's functions; a cached function causes none."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth, self._functions, self._seconds, self._begin = 0, 0, 0.0, 0.0

    def on_start(self, event: Event) -> None:
        """Show progress at the start of every function."""
        with self._lock:
            if self._depth == 0:
                if not event.data["dispatcher"].py_func.__module__.startswith("servotwin."):
                    return
                self._begin = time.monotonic()
            self._depth += 1
            self._functions += 1
            self._show()

    def on_end(self, event: Event) -> None:  # noqa: ARG002
        """Erase the line when nothing is being compiled any more."""
        with self._lock:
            if self._depth == 0:
                return
            self._depth -= 1
            if self._depth == 0:
                self._seconds += time.monotonic() - self._begin
                if _is_terminal():
                    print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _show(self) -> None:
        if _is_terminal():
            seconds = self._seconds + time.monotonic() - self._begin
            line = f"\r{_TEXT}: {self._functions}, {seconds:.0f} s\x1b[K"
            print(line, end="", file=sys.stderr, flush=True)
        elif self._functions == 1 and _is_watched():
            print(_TEXT, file=sys.stderr, flush=True)


def _is_watched() -> bool:
    """True when a person at a terminal or in a notebook reads the standard error of this process."""
    if multiprocessing.current_process().name != "MainProcess" or sys.stderr is None:
        return False
    return sys.stderr.isatty() or "ipykernel" in sys.modules


def _is_terminal() -> bool:
    """True when one line can be overwritten in place: a terminal that is not shared with a progress bar."""
    return _is_watched() and sys.stderr is sys.__stderr__ and "ipykernel" not in sys.modules


def show_compilation() -> None:
    """Show the progress of compilations from now on."""
    listen: Any = register  # untyped
    listen("numba:compile", CompileProgress())
