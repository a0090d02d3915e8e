"""Order of an edge's windows: the oldest first, unless that would keep the newest one waiting too long.

A setting follows from the newest window only, and the twin learns from windows in their order. After an outage of a
whole fleet the windows of all edges together take long: the twin then tells each edge the pause that it asks for before
each window that a newer one has overtaken. The newest window never waits for that.
"""

from dataclasses import dataclass
from typing import TypeVar

FRESH_S = 10.0
"""s for which windows may hold up the newest one while the twin takes them. Those that take longer at the pause that
the twin asks for go after it from the start: of each of a fleet's edges a single one would hold up all newest ones."""
_IN_A_ROW = 4
"""Newest windows in a row after which an older one goes whatever the pause, so that a backlog shrinks however slow the
twin is. With one after each newest a fleet of a busy twin kept its newest windows waiting until all of it was in."""
_Window = TypeVar("_Window")


@dataclass(slots=True)
class WindowOrder:
    """Choice of one edge's next window, by the pause that the twin asked for last.

    Attributes
    ----------
    pause_s : float
        Pause that the twin asks for before each older window, s.
    """

    pause_s: float = 0.0
    _older_from: float | None = None
    _held_up_since: float | None = None
    _in_a_row: int = 0

    def next(self, now: float, first: _Window, newest: _Window | None, older: int) -> _Window | None:
        """Choose the window to be sent now.

        Parameters
        ----------
        now : float
            s.
        first : window
            The oldest one that is due.
        newest : window, optional
            The newest one, where it is due and the twin has had none that is newer.
        older : int
            Number of windows that wait beside the newest one.

        Returns
        -------
        window or None
            None: those that wait have to wait for the end of the pause.
        """
        if first == newest or newest is None:
            self._held_up_since = None
        if first == newest:
            return first
        if self.pause_left(now) > 0.0:
            return newest
        if newest is None:
            return first
        if self._held_up_since is None:
            self._held_up_since = now
        held_up = older * self.pause_s > FRESH_S or now - self._held_up_since >= FRESH_S
        if self._in_a_row >= _IN_A_ROW or not held_up:
            return first
        self._held_up_since = now
        return newest

    def pause_left(self, now: float) -> float:
        """Time for which windows that were overtaken wait, s."""
        if self._older_from is None or self._in_a_row >= _IN_A_ROW:
            return 0.0
        return max(0.0, self._older_from - now)

    def taken(self, now: float, fresh: bool, older: int, pause_s: float) -> None:
        """Note that the twin has taken a window and asks for a pause.

        Parameters
        ----------
        now : float
            s.
        fresh : bool
            It was the newest.
        older : int
            Number of windows that are left and that it has overtaken, or that follow it.
        pause_s : float
        """
        self.pause_s = pause_s
        if not older:
            self._older_from, self._in_a_row = None, 0
        elif not fresh:
            self._older_from, self._in_a_row = now + pause_s, 0
        else:
            # A pause goes on while newest windows come: begun anew by each of them it would never end.
            self._older_from = now + pause_s if self._older_from is None else self._older_from
            self._in_a_row += 1

    def out_of_reach(self) -> None:
        """Note that the twin is out of reach; what it asks for holds once it has answered again."""
        self._older_from = self._held_up_since = None
        self._in_a_row = 0
