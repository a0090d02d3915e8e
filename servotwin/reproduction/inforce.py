"""What was in force at the edge, and since when: the start, updates and fallbacks of a co-simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from servotwin.control.gains import gains_of
from servotwin.cosim import Loop
from servotwin.messages import Gains


class Origin(StrEnum):
    """Where a setting comes from."""

    START = "start"
    UPDATE = "update"
    FALLBACK = "fallback"


@dataclass(frozen=True, slots=True)
class Change:
    """A setting from `time` (s) on: dead-zone half-width (m) and gains."""

    time: float
    origin: Origin
    tolerance: float
    gains: Gains


def changes(loop: Loop) -> tuple[Change, ...]:
    """Every setting that was in force, in order; gains that an update leaves alone are those before it."""
    start = loop.scenario.start
    found = [Change(0.0, Origin.START, start.setting.tolerance, gains_of(loop.scenario.start_law))]
    for time, origin, tolerance, gains in sorted(_later(loop), key=lambda change: change[0]):
        found.append(Change(time, origin, tolerance, gains or found[-1].gains))
    return tuple(found)


def _later(loop: Loop) -> Iterator[tuple[float, Origin, float, Gains | None]]:
    rate = loop.scenario.recording.sample_rate
    sent = {update.version: update for update in loop.updates}
    for receipt in loop.applied:
        update = sent[receipt.version]
        yield receipt.sample / rate, Origin.UPDATE, update.setting.tolerance, update.setting.gains
    for fallback in loop.fallbacks:
        yield fallback.sample / rate, Origin.FALLBACK, fallback.setting.tolerance, fallback.setting.gains
