"""How fast machine time may pass: as fast as the processor's share allows."""

from __future__ import annotations

from typing import NamedTuple

SLOWEST, FASTEST = 5.0, 100.0
"""Machine time per time."""
LIMIT, WANTED = 0.60, 0.52
"""Shares of two cores: what must not be passed, and what is aimed at."""
CORES = 2
BEHIND = 10
"""Messages that wait for the twin: more is a queue that grows."""
_CALM, _KEPT = 0.08, 0.93


class Seen(NamedTuple):
    """What came of a speed.

    Attributes
    ----------
    share : float or None
        Of two cores; None: not known.
    reached : float
        Machine time per time that the slowest machine kept.
    waiting : int
        Messages that wait for the twin.
    """

    share: float | None
    reached: float
    waiting: int


def share_of(cores_used: float | None, cores: int | None) -> float | None:
    """The share of two cores, or of the one that there is."""
    return None if cores_used is None else cores_used / min(CORES, cores or 1)


def next_speed(speed: float, seen: Seen) -> float:
    """The speed to try next: at least `SLOWEST`, whether it can be held or not."""
    if seen.share is None:
        factor = 1.0
    elif seen.share > LIMIT:
        factor = max(0.5, WANTED / seen.share)
    elif seen.reached < _KEPT * speed:
        factor = max(0.5, seen.reached / speed)
    elif seen.waiting > BEHIND:
        factor = 0.8
    else:
        factor = min(1.3, WANTED / max(seen.share, 0.01))
        factor = 1.0 if abs(factor - 1.0) < _CALM else factor
    return round(min(max(speed * factor, SLOWEST), FASTEST), 1)
