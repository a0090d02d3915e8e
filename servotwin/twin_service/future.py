"""Windows from the future: more sample time than can have passed since a boot of an edge was first heard of."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

from servotwin.messages import Refusal
from servotwin.twin_service.refused import Refused

LONGEST_BOOT = 20.0 * 365.25 * 86400.0
"""s: no edge runs longer without a restart."""
REMEMBERED = 50_000
"""Boots; of those forgotten the next message counts as the first."""


class _Heard(NamedTuple):
    """When something was heard of a boot (s, monotonic), and the sample time (s) that it told of."""

    at: float
    sample_time: float


class Boots:
    """What sample times each boot can have reached.

    The first message of a boot says what its sample time is; from then on it runs `speed` times as fast as time at
    most. A hello may move that on: it tells the edge's time when it was sent, a window only that of long ago, perhaps.

    Parameters
    ----------
    speed : float
        Sample time per time.
    slack : float
        s of sample time allowed beyond that.
    """

    def __init__(self, speed: float, slack: float) -> None:
        self._speed, self._slack = speed, slack
        self._heard: OrderedDict[tuple[str, str], _Heard] = OrderedDict()

    def hello(self, servo: str, boot: str, sample_time: float, now: float) -> None:
        """Note what an edge says its sample time is.

        Raises
        ------
        Refused
            FUTURE: nothing runs that long.
        """
        _possible(sample_time)
        known = self._heard.get((servo, boot))
        if known is None or sample_time > self._reached(known, now):
            self._note(servo, boot, _Heard(now, sample_time))

    def check(self, servo: str, boot: str, end: float, now: float) -> None:
        """Let a window pass whose last sample was taken at `end` (s of sample time), received at `now` (s).

        Raises
        ------
        Refused
            FUTURE.
        """
        _possible(end)
        known = self._heard.get((servo, boot))
        if known is None:
            self._note(servo, boot, _Heard(now, end))
            return
        reached = self._reached(known, now) + self._slack
        if end > reached:
            raise Refused(
                Refusal.FUTURE,
                f"the window ends at {end:.3f} s of sample time; its boot can have reached {reached:.3f} s by now",
            )

    def _reached(self, known: _Heard, now: float) -> float:
        return known.sample_time + self._speed * (now - known.at)

    def _note(self, servo: str, boot: str, heard: _Heard) -> None:
        self._heard[servo, boot] = heard
        if len(self._heard) > REMEMBERED:
            self._heard.popitem(last=False)


def _possible(sample_time: float) -> None:
    if sample_time > LONGEST_BOOT:
        raise Refused(Refusal.FUTURE, f"sample time {sample_time:.3g} s: no edge runs that long")
