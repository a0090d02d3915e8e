"""Faulty and malicious twins for the edge's endurance test."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial

from msgspec import structs

from servotwin.control.gains import gains_of
from servotwin.control.laws import filtered_pid
from servotwin.cosim.scenario import Scenario
from servotwin.edge.guard import Limits
from servotwin.estimation.disturbance import disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.window import Window
from servotwin.messages import Acknowledge, Band, Fallback, Gains, Message, Receipt, Setting, Update, WindowMessage
from servotwin.redesign.registry import policy_of
from servotwin.twin.model import TwinModel
from servotwin.twin.twin import Twin

HONEST = 2  # windows that are answered before a twin falls silent
FACTOR = 3.0  # of a lie, either way
SPREAD = math.radians(0.05)  # of an estimate, as it states
BEYOND = 0.01  # of a range's larger end
UNBOUNDED = Band(1.0, 1.0, 10.0, 1e6)


class TwinFault(StrEnum):
    """Fault of a twin."""

    NONE = "no twin"
    SILENT = "falls silent"
    LIES_HIGH = "gap times three"
    LIES_LOW = "gap by three"
    REPLAYS = "replays old updates"
    WANTON = "anything in bounds"


_LIES = {TwinFault.LIES_HIGH: FACTOR, TwinFault.LIES_LOW: 1.0 / FACTOR}


def deceived_twin(scenario: Scenario, gap: float) -> Twin:
    """Make the scenario's own twin with an estimator that always returns `gap` (rad)."""

    def estimate(window: Window, _expected: Expectation) -> GapEstimate:
        interval = max(0.0, gap - 2.0 * SPREAD), gap + 2.0 * SPREAD
        return GapEstimate(gap, SPREAD, SPREAD, interval, GapStatus.OK, window.mid_time, method="constant")

    start = Setting.of(scenario.start_tolerance, gains_of(scenario.start_law))
    policy, observer = policy_of(scenario.model, scenario.twin), partial(disturbance, servo=scenario.model)
    model = TwinModel(estimate, policy, scenario.twin, observer, start)
    return Twin(scenario.name, model)


@dataclass
class HostileTwin:
    """A twin with one fault.

    Attributes
    ----------
    kind : TwinFault
    twin : Twin
        The twin without the fault.
    limits : Limits
        The edge's, of updates.
    own : Gains
        The servo's own.
    draw : random.Random
    """

    kind: TwinFault
    twin: Twin
    limits: Limits
    own: Gains
    draw: random.Random
    version: int = 0
    in_force: int = 0
    windows: int = 0
    sent: list[Update] = field(default_factory=list)

    @classmethod
    def of(cls, kind: TwinFault, scenario: Scenario, gap: float, draw: random.Random) -> HostileTwin:
        """For a scenario whose machine has this gap (rad)."""
        twin = deceived_twin(scenario, gap * _LIES.get(kind, 1.0))
        return cls(kind, twin, scenario.agent_settings().limits, gains(scenario), draw)

    def receive(self, message: Message, now: float) -> list[Message]:
        """Answer a message according to the fault."""
        self.windows += isinstance(message, WindowMessage)
        if self.kind is TwinFault.NONE or (self.kind is TwinFault.SILENT and self.windows > HONEST):
            return []
        if isinstance(message, Receipt | Fallback):
            self.in_force = max(self.in_force, message.parameter_version)
        if self.kind is TwinFault.WANTON:
            return self._wanton(message) if isinstance(message, WindowMessage) else []
        answer = self.twin.receive(message, now)
        repeated = self._repeated() if isinstance(message, WindowMessage) else ()
        self.sent += [each for each in answer if isinstance(each, Update)]
        return [*repeated, *answer]

    def next_wake(self) -> float | None:
        """No wake-up: this twin only answers."""
        return None

    def wake(self, _now: float) -> list[Message]:
        """Send nothing."""
        return []

    def _repeated(self) -> Iterable[Update]:
        """An old update as it was, and one with the next number, on what is in force."""
        if self.kind is not TwinFault.REPLAYS or not self.sent:
            return ()
        again, renumbered = self.draw.choice(self.sent), self.draw.choice(self.sent)
        return again, structs.replace(renumbered, version=self._next(), base_version=self.in_force)

    def _next(self) -> int:
        self.version = max(self.version, self.in_force) + 1
        return self.version

    def _anywhere(self, lowest: float, highest: float) -> float:
        beyond = BEYOND * max(abs(lowest), abs(highest))
        return self.draw.uniform(lowest - beyond, highest + beyond)

    def _wanton(self, window: WindowMessage) -> list[Message]:
        """Draw each value anywhere in its range and a little beyond; state no gap to check it against."""
        draw, own, limits = self.draw, self.own, self.limits
        kp, kd, tf = (self._anywhere(*limits.range_of(name, own)) for name in Gains.scaled)
        ki = self._anywhere(0.0, own.Ki * limits.integral_factor)
        feedforward = self._anywhere(-limits.feedforward, limits.feedforward)
        leave = abs(self._anywhere(0.0, own.leave * limits.gain_factor if limits.leave is None else limits.leave))
        setting = Gains(kp, ki, kd, tf, draw.uniform(0.0, leave), leave, feedforward)
        version, identity = self._next(), (window.boot, window.sequence)
        end, tolerance = window.start + 60.0, draw.choice([0.0, abs(self._anywhere(0.0, limits.maximum))])
        update = Update(
            servo=window.servo,
            version=version,
            base_version=self.in_force,
            window=identity,
            data_time=window.start,
            gap=None,
            std=None,
            interval=(None, None),
            status="OK",
            setting=Setting(tolerance, setting, UNBOUNDED),
            not_after=end,
        )
        self.sent.append(update)
        return [Acknowledge(window.servo, window.boot, window.sequence), update]


def gains(scenario: Scenario) -> Gains:
    """The servo's own gains."""
    own = filtered_pid(scenario.law)
    return Gains(own.Kp, own.Ki, own.Kd, own.Tf)
