"""A linear law written once more, in numpy, on the axes of `axis_oracle`: sampled between ticks, or continuous."""

from __future__ import annotations

from dataclasses import dataclass

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
    limit, step = law.limit or np.inf, (law.rate_limit or np.inf) / law.sample_rate
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
