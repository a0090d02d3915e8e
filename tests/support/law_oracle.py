"""A linear law written once more, in numpy, on the axes of `axis_oracle`: sampled between ticks, or continuous."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from axis_oracle import Array, AxisOracle

from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.plant.axis import Axis

IDLE = Controller(0.0, 0.0, 0.0, 1.0)


@dataclass
class HeldOracle(AxisOracle):
    """An axis under a command that is held."""

    held: float = 0.0

    def command(self, _x: Array) -> tuple[float, float]:
        return self.held, 0.0

    def measured(self, x: Array) -> tuple[float, float]:
        """Angle of the motor, and position of the load."""
        n, p = self.axis.n, self.axis.p
        return float(x[2]), float(p * x[3] if self.axis.rigid and n == 1 else x[3 + n])


@dataclass
class NumpyLaw:
    """One tick at a time, with discrete matrices (A, B, C, D, windup) outside and inside the dead zone."""

    outside: tuple[Array, Array, Array, Array, Array]
    inside: tuple[Array, Array, Array, Array, Array]
    enter: float
    leave: float
    error: tuple[float, float]
    limit: float = np.inf
    step: float = np.inf
    active: bool = True
    last: float = 0.0

    def __post_init__(self) -> None:
        self.x = np.zeros(len(self.outside[2]))

    def __call__(self, reference: float, y_motor: float, y_load: float) -> float:
        y = np.array([reference, y_motor, y_load])
        size = abs(reference - self.error[0] * y_motor - self.error[1] * y_load)
        self.active = size > (self.enter if self.active else self.leave)
        A, B, C, D, windup = self.outside if self.active else self.inside
        wanted = float(C @ self.x + D @ y)
        u = float(np.clip(np.clip(wanted, -self.limit, self.limit), self.last - self.step, self.last + self.step))
        self.x, self.last = A @ self.x + B @ y + windup * (u - wanted), u
        return u


def numpy_law(law: LinearLaw, tolerance: float | None, pieces: tuple[tuple[Array, ...], tuple[Array, ...]]) -> NumpyLaw:
    """The law with its own numbers, and matrices that the test made."""
    factor = -1.0 if tolerance is None else tolerance
    assert law.sample_rate is not None
    limit, step = law.voltage_limit or np.inf, (law.rate_limit or np.inf) / law.sample_rate
    zone = (factor * law.enter, factor * law.leave) if tolerance is not None else (-1.0, -1.0)
    return NumpyLaw(*pieces, *zone, (law.ratio, 0.0) if law.on == "motor" else (0.0, 1.0), limit, step)  # type: ignore[arg-type]


def sampled_positions(axis: Axis, law: NumpyLaw, gap: float, references: Array, rate: float) -> tuple[Array, Array]:
    """(N,) load's positions and commands at the ticks, each tick from the state itself: ideal sensors."""
    oracle = HeldOracle(axis.replace(controller=IDLE), gap)
    x, found = oracle.start(), []
    for k, reference in enumerate(references.tolist()):
        y_motor, y_load = oracle.measured(x)
        oracle.held = law(reference, y_motor, y_load)
        found.append((y_load, oracle.held))
        x, _ = oracle.run(x, k / rate, (k + 1) / rate, np.zeros(0))
    positions, commands = np.array(found).T
    return positions, commands


@dataclass
class ContinuousOracle(AxisOracle):
    """An axis with a continuous linear law, whose states stand behind the axis's own; scipy finds its zones too."""

    law: LinearLaw | None = None
    tolerance: float | None = None
    active: bool = True
    limited: int = 0
    seen: set[str] = field(default_factory=set)

    def start(self) -> Array:
        assert self.law is not None
        return np.zeros(6 + 2 * self.axis.n + self.law.n)

    def split(self, x: Array) -> tuple[Array, Array, Array]:
        """States of the axis, of the law, and (reference, y_motor, y_load)."""
        assert self.law is not None
        n = self.axis.n
        own, states = x[: 6 + 2 * n], x[6 + 2 * n :]
        load = self.axis.p * own[3] if self.axis.rigid and n == 1 else own[3 + n]
        return own, states, np.array([self.reference, own[2], load])

    def wanted(self, x: Array) -> float:
        """Command before the limit."""
        assert self.law is not None
        _, states, y = self.split(x)
        if self.opened:
            return float(np.dot(self.law.C, states) + np.dot(self.law.D_inside, y)) if self.law.D_inside else 0.0
        return float(np.dot(self.law.C, states) + np.dot(self.law.D, y))

    @property
    def opened(self) -> bool:
        """True inside a dead zone that does not stop the integral only."""
        assert self.law is not None
        return not self.law.integral_only and not self.active

    def error(self, x: Array) -> float:
        """Error that the dead zone looks at."""
        assert self.law is not None
        _, _, y = self.split(x)
        return float(y[0] - (self.law.ratio * y[1] if self.law.on == "motor" else y[2]))

    def command(self, x: Array) -> tuple[float, float]:
        assert self.law is not None
        return (
            self.limited * self.law.voltage_limit if self.limited and self.law.voltage_limit else self.wanted(x)
        ), 0.0

    def rates(self, t: float, x: Array) -> Array:
        assert self.law is not None
        _, states, y = self.split(x)
        n = self.law.n
        B = self.law.B if not self.opened else self.law.B_inside or np.zeros((n, 3))
        driven = np.array(self.law.A).reshape(n, n) @ states + np.array(B).reshape(n, 3) @ y
        driven = driven + np.array(self.law.windup) * (self.command(x)[0] - self.wanted(x))
        if not self.active and not (self.opened and self.law.D_inside):
            driven[[name in self.law.holds for name in self.law.names]] = 0.0
        return np.concatenate([self._axis_rates(t, x), driven])

    def _axis_rates(self, t: float, x: Array) -> Array:
        own, u = x[: 6 + 2 * self.axis.n], self.command(x)[0]
        axis = self.axis.replace(controller=IDLE)
        held = HeldOracle(axis, self.gap, side=self.side, sliding=self.sliding, held=u)
        return held.rates(t, own)

    def events(self) -> list[object]:
        """Ends of the contact mode, of the dead zone and of the limit."""
        assert self.law is not None
        law, found = self.law, super().events()

        def zone(_t: float, x: Array) -> float:
            assert self.tolerance is not None
            if self.active:
                return abs(self.error(x)) - law.enter * self.tolerance
            return law.leave * self.tolerance - abs(self.error(x))

        def limit(_t: float, x: Array) -> float:
            assert law.voltage_limit is not None
            return (
                self.limited * self.wanted(x) - law.voltage_limit
                if self.limited
                else law.voltage_limit - abs(self.wanted(x))
            )

        wanted = ([zone] if self.tolerance is not None else []) + ([limit] if law.voltage_limit is not None else [])
        for each in wanted:
            each.terminal, each.direction = True, -1.0  # type: ignore[attr-defined]
        self.kinds = [*(["contact"] * len(found)), *(each.__name__ for each in wanted)]
        return [*found, *wanted]

    def settle(self, x: Array) -> None:
        """Zones that fit the state, where the reference has jumped."""
        assert self.law is not None
        if self.tolerance is not None:
            bound = self.law.enter if self.active else self.law.leave
            self.active = abs(self.error(x)) > bound * self.tolerance
        self.limit_again(x)

    def limit_again(self, x: Array) -> None:
        """Saturation that fits the state."""
        assert self.law is not None
        if self.law.voltage_limit is not None:
            wanted = self.wanted(x)
            self.limited = int(np.sign(wanted)) if abs(wanted) > self.law.voltage_limit else 0

    def run(self, x: Array, begin: float, end: float, times: Array) -> tuple[Array, Array]:
        self.settle(x)
        return super().run(x, begin, end, times)

    def changed(self, x: Array, now: float, which: int) -> Array:
        kind = self.kinds[which]
        self.seen.add(kind)
        if kind == "contact":
            return super().changed(x, now, which)
        if kind == "zone":
            self.active = not self.active
        limited = self.limited
        self.limit_again(x)
        if kind == "limit" and self.limited == limited:  # at the limit to rounding
            self.limited = 0 if limited else int(np.sign(self.wanted(x)))
        return x


def continuous_positions(oracle: ContinuousOracle, amplitude: float, half_period: float, times: Array) -> Array:
    """(N,) position of the load under a square wave that begins with +amplitude."""
    x, begin, sign, found = oracle.start(), 0.0, 1.0, []
    while begin < times[-1]:
        oracle.reference = sign * amplitude
        x, states = oracle.run(x, begin, begin + half_period, times)
        found.append(states)
        begin, sign = begin + half_period, -sign
    return np.array([oracle.split(state)[2][2] for state in np.concatenate(found)])
