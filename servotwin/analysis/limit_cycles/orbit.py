"""A periodic orbit of the loop, exact: its period, extremes, events and Floquet multipliers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from servotwin.analysis.limit_cycles.poincare import Firing, Flags, Stretch
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.exponential import expm1
from servotwin.hybrid.trajectory import Trajectory
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.linear import Complex

# Looks per radian of the fastest lasting motion, for the extremes of a signal.
_LOOKS = 4


class OrbitEvent(NamedTuple):
    """An event at a `phase` in [0, 1) of the period."""

    phase: float
    kind: str
    side: int


@dataclass(frozen=True, eq=False)
class Orbit:
    """A limit cycle.

    Attributes
    ----------
    frequency : float
        Hz.
    amplitude : float
        m, half the peak-to-peak of the position; `lowest` and `highest` are its exact extremes.
    motor_amplitude : float
        rad, half the peak-to-peak of the motor's angle.
    symmetric : bool
        Whether the second half period mirrors the first.
    multipliers : (K,) complex array
        Floquet multipliers of the period, largest first, without the one of the phase (1) and those of the states that
        no flow changes.
    half_multipliers : (K,) complex array or None
        Those of the half-period map with mirror of a symmetric orbit; their squares are `multipliers`.
    events : tuple of OrbitEvent
        From the section event on.
    residual : float
        Largest part of its range by which any state fails to close after one period of the event simulation with its
        search step halved (not of the map that was solved).
    """

    frequency: float
    lowest: float
    highest: float
    motor_amplitude: float
    symmetric: bool
    multipliers: Complex
    half_multipliers: Complex | None
    events: tuple[OrbitEvent, ...]
    residual: float
    loop: ServoAutomaton = field(repr=False)
    start: Array = field(repr=False)
    start_mode: int = field(repr=False)

    @property
    def period(self) -> float:
        """s."""
        return 1.0 / self.frequency

    @property
    def amplitude(self) -> float:
        """m, half the peak-to-peak of the position."""
        return 0.5 * (self.highest - self.lowest)

    @property
    def centre(self) -> float:
        """m, midway between the extremes of the position."""
        return 0.5 * (self.highest + self.lowest)

    @property
    def stable(self) -> bool:
        """Whether every multiplier lies inside the unit circle."""
        return bool(np.max(np.abs(self.multipliers), initial=0.0) < 1.0)

    def signal(self, name: str, samples: int) -> tuple[Array, Array]:
        """(samples,) times (s) and values of a signal over one period, its end excluded: position, theta_m, theta_d,
        voltage, error, q1 ... qn."""
        if name not in self.loop.rows:
            raise InvalidInput(f"an orbit has no signal {name!r}; allowed are {', '.join(self.loop.rows)}")
        times = np.asarray(np.arange(samples) * (self.period / samples), dtype=float)
        run = Trajectory(self.loop.automaton, self.start, self.start_mode, self.period / 256)
        run.advance(257)
        return times, run.at(times, self.loop.rows[name])


def extremes(automaton: Automaton, state: Array, stretches: tuple[Stretch, ...], rows: Array) -> tuple[float, float]:
    """Exact least and largest value of the output ``rows[mode] @ x`` along stretches that begin at `state`."""
    values: list[float] = []
    x = state
    for stretch in stretches:
        flow, row = automaton.flows[stretch.mode], rows[stretch.mode]
        parts = max(2, int(np.ceil(_LOOKS * automaton.fastest_lasting * stretch.duration)))
        look = stretch.duration / parts
        jump = expm1(flow, look).astype(float)
        for _ in range(parts):
            after = x + jump @ x
            values += [float(row @ x), float(row @ after)]
            slope = row @ flow
            if (slope @ x) * (slope @ after) < 0.0:
                values.append(_turn(row, flow, x, look))
            x = after
        x = stretch.reset @ x
    return min(values), max(values)


def _turn(row: Array, flow: Array, x: Array, look: float) -> float:
    """The value where the slope vanishes within a look."""

    def at(time: float) -> Array:
        return np.asarray(x + expm1(flow, time).astype(float) @ x)

    time = brentq(lambda t: float(row @ flow @ at(t)), 0.0, look, xtol=1e-12 * look)
    return float(row @ at(time))


def phases(loop: ServoAutomaton, stretches: tuple[Stretch, ...], period: float) -> tuple[OrbitEvent, ...]:
    """The events at the ends of stretches by phase, that of the section first and not again at the end."""
    elapsed, events = 0.0, []
    for stretch in stretches[:-1]:
        elapsed += stretch.duration
        guard = _guard(loop.automaton, stretch.firing)
        events.append(OrbitEvent(elapsed / period % 1.0, guard[0], guard[1]))
    return tuple(events)


def _guard(automaton: Automaton, firing: Firing) -> tuple[str, int]:
    guard = automaton.modes[firing.mode].guards[firing.guard]
    return guard.label, guard.side


def leading(derivative: Array, free: Flags, phase: int = 1) -> Complex:
    """Multipliers of a Poincaré map's derivative, largest first, without `phase` of its zeros: the map forgets where on
    the orbit it began, which is not a multiplier of the orbit."""
    values = np.linalg.eigvals(derivative[np.ix_(free, free)]).astype(complex)
    ordered = values[np.argsort(-np.abs(values), kind="stable")]
    return np.asarray(ordered[: len(ordered) - phase])
