"""Twins that mean harm, or that fail: what an edge must endure."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from msgspec import structs

from servotwin.messages import Acknowledge, Band, Fallback, Gains, Message, Receipt, Update, Window

HONEST = 2  # updates before a twin falls silent
FACTOR = 3.0  # of a lie, either way


class Kind(StrEnum):
    """What is wrong with a twin."""

    NONE = "no twin"
    SILENT = "falls silent"
    LIES_HIGH = "gap times three"
    LIES_LOW = "gap by three"
    REPLAYS = "replays old updates"
    WANTON = "anything in bounds"


@dataclass
class HostileTwin:
    """Acknowledges windows and answers them with updates that are wrong in one way.

    Attributes
    ----------
    name : str
        The servo's.
    kind : Kind
    own : Gains
        The servo's own.
    pitch : float
        m/rad.
    gap : float
        rad, the true one.
    draw : random.Random
    """

    name: str
    kind: Kind
    own: Gains
    pitch: float
    gap: float
    draw: random.Random
    version: int = 0
    in_force: int = 0
    said: list[Update] = field(default_factory=list)

    def receive(self, message: Message, _now: float) -> list[Message]:
        """What it says to a message."""
        if isinstance(message, Receipt | Fallback):
            self.in_force = max(self.in_force, message.parameter_version)
            return []
        if not isinstance(message, Window):
            return []
        if self.kind is Kind.NONE or (self.kind is Kind.SILENT and len(self.said) >= HONEST):
            return []
        acknowledge = Acknowledge(message.servo, message.boot, message.sequence)
        return [acknowledge, *self._repeated(), self._update(message)]

    def next_wake(self) -> float | None:
        """It never speaks first."""
        return None

    def wake(self, _now: float) -> list[Message]:
        """Nothing."""
        return []

    def _repeated(self) -> Iterable[Update]:
        """An old update as it was, and one with the next number, on what is in force."""
        if self.kind is not Kind.REPLAYS or not self.said:
            return ()
        again, renumbered = self.draw.choice(self.said), self.draw.choice(self.said)
        return again, structs.replace(renumbered, version=self._next(), base_version=self.in_force)

    def _next(self) -> int:
        self.version = max(self.version, self.in_force) + 1
        return self.version

    def _update(self, window: Window) -> Update:
        gains, tolerance = self._wanton() if self.kind is Kind.WANTON else self._setting(self._claimed())
        update = Update(
            servo=self.name,
            version=self._next(),
            base_version=self.in_force,
            window=(window.boot, window.sequence),
            data_time=window.start,
            gap=self._claimed(),
            std=0.0,
            interval=(self._claimed(), self._claimed()),
            status="OK",
            tolerance=tolerance,
            not_after=window.start + 60.0,
            controller=gains,
            band=Band(1.0, 1.0, 10.0, 1e6),
        )
        self.said.append(update)
        return update

    def _claimed(self) -> float:
        return self.gap * {Kind.LIES_HIGH: FACTOR, Kind.LIES_LOW: 1.0 / FACTOR}.get(self.kind, 1.0)

    def _setting(self, gap: float) -> tuple[Gains, float]:
        """Gains that fall and a dead zone that grows with the gap: too quick for a gap told too small, too slow and too
        wide for one told too large."""
        scale = 1.5 / (1.0 + 1.5 * gap / math.radians(60.0))
        gains = Gains(self.own.Kp * scale, 0.0, self.own.Kd * scale, self.own.Tf, 0.5, 1.5)
        return gains, 0.25 * self.pitch * gap

    def _wanton(self) -> tuple[Gains, float]:
        """Each value by itself anywhere in its range, and a little beyond."""
        draw, own = self.draw, self.own
        kp, kd, tf = (g * math.exp(draw.uniform(-1.0, 1.0)) for g in (own.Kp, own.Kd, own.Tf))
        ki, feedforward = own.Ki * draw.uniform(0.0, 0.06), draw.uniform(-0.12, 0.12)
        leave = draw.uniform(0.0, 2.0)
        return Gains(kp, ki, kd, tf, draw.uniform(0.0, leave), leave, feedforward), draw.uniform(0.0, 1e-4)
