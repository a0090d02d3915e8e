"""A periodic orbit of the loop, exact: found by shooting, and verified by the event simulation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from servotwin.analysis.limit_cycles.poincare import (
    FixedPoint,
    Flags,
    FlowSegment,
    GuardId,
    LostOrbit,
    Section,
    Shot,
    newton,
)
from servotwin.analysis.limit_cycles.scaled import Mirror, ScaledLoop
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.exponential import expm1
from servotwin.hybrid.trajectory import Trajectory
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.linear import Complex

# Intervals per radian of the fastest lasting motion, for the extremes of a signal.
_PER_RADIAN = 4


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
        True when the second half period mirrors the first.
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
        """Period, s."""
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
        """True when every multiplier lies inside the unit circle."""
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


def extremes(automaton: Automaton, state: Array, segments: tuple[FlowSegment, ...], rows: Array) -> tuple[float, float]:
    """Exact least and largest value of the output ``rows[mode] @ x`` along segments that begin at `state`."""
    values: list[float] = []
    x = state
    for segment in segments:
        flow, row = automaton.flows[segment.mode], rows[segment.mode]
        parts = max(2, int(np.ceil(_PER_RADIAN * automaton.fastest_lasting * segment.duration)))
        interval = segment.duration / parts
        jump = expm1(flow, interval).astype(float)
        for _ in range(parts):
            after = x + jump @ x
            values += [float(row @ x), float(row @ after)]
            slope = row @ flow
            if (slope @ x) * (slope @ after) < 0.0:
                values.append(_turn(row, flow, x, interval))
            x = after
        x = segment.reset @ x
    return min(values), max(values)


def _turn(row: Array, flow: Array, x: Array, interval: float) -> float:
    """Value of the output where its slope vanishes within an interval (s)."""
    # Here, because scipy.optimize takes long to import and most commands need none of it.
    from scipy.optimize import brentq

    def at(time: float) -> Array:
        return np.asarray(x + expm1(flow, time).astype(float) @ x)

    time = brentq(lambda t: float(row @ flow @ at(t)), 0.0, interval, xtol=1e-12 * interval)
    return float(row @ at(time))


def phases(loop: ServoAutomaton, segments: tuple[FlowSegment, ...], period: float) -> tuple[OrbitEvent, ...]:
    """The events at the ends of segments by phase, that of the section first and not again at the end."""
    elapsed, events = 0.0, []
    for segment in segments[:-1]:
        elapsed += segment.duration
        guard = _guard(loop.automaton, segment.guard_id)
        events.append(OrbitEvent(elapsed / period % 1.0, guard[0], guard[1]))
    return tuple(events)


def _guard(automaton: Automaton, guard_id: GuardId) -> tuple[str, int]:
    guard = automaton.modes[guard_id.mode].guards[guard_id.guard]
    return guard.label, guard.side


def leading(derivative: Array, free: Flags, phase: int = 1) -> Complex:
    """Multipliers of a Poincaré map's derivative, largest first, without `phase` of its zeros: the map forgets where on
    the orbit it began, which is not a multiplier of the orbit."""
    values = np.linalg.eigvals(derivative[np.ix_(free, free)]).astype(complex)
    ordered = values[np.argsort(-np.abs(values), kind="stable")]
    return np.asarray(ordered[: len(ordered) - phase])


# Largest residual of a returned orbit, in parts of each state's range: hundreds of roundings.
CLOSED = 1e-9
# An "orbit" smaller than this part of p gap is the equilibrium.
_SMALLEST = 1e-6
_GRID = 64


class ClosedOrbit(NamedTuple):
    """An orbit and the distance from it, in parts of each state's size, at which the search began."""

    orbit: Orbit
    distance: float


def closed_orbit(loop: ScaledLoop, section: Section, start: Array, scale: Array, half: bool) -> ClosedOrbit:
    """Find the orbit through the section near a point of it.

    Parameters
    ----------
    loop : ScaledLoop
    section : Section
        Of the full period; where `half` succeeds its `hits` are counted anew.
    start : (n,) array
        Just before the section's event.
    scale : (n,) array
        Size of each state.
    half : bool
        Look for a symmetric orbit: close it after half a period by its mirror image.

    Raises
    ------
    LostOrbit
        There is none near, or it does not close in the event simulation.
    """
    reflection = loop.mirror if half else None
    if reflection is not None:
        point = _half(loop, section, reflection, start, scale)
        section = replace(section, hits=_hits(section, reflection, point.shot))
    else:
        point = newton(section.shoot, start, loop.free, scale)
    distance = float(np.max(np.abs(start - point.state)[loop.free] / scale[loop.free]))
    full = section.shoot(point.state)
    period = sum(segment.duration for segment in full.segments)
    residual = _residual(loop, section, point.state, full, period)
    if residual > CLOSED:
        raise LostOrbit(f"the orbit fails to close by {residual:.2g} of its range in the event simulation")
    orbit = _orbit(loop, section, point, full, period, residual, reflection is not None)
    if orbit.amplitude < _SMALLEST * loop.extent * loop.unit:
        raise LostOrbit("the orbit shrinks to an equilibrium")
    return ClosedOrbit(orbit, distance)


def _half(loop: ScaledLoop, section: Section, reflection: Mirror, start: Array, scale: Array) -> FixedPoint:
    """The fixed point of: fly to the mirrored section event, reflect."""
    to_mirror = replace(section, end=reflection.guards[section.start])

    def shoot(state: Array) -> Shot:
        shot = to_mirror.shoot(state)
        return Shot(reflection.signs * shot.state, reflection.signs[:, None] * shot.derivative, shot.segments)

    return newton(shoot, start, loop.free, scale)


def _hits(section: Section, reflection: Mirror, half: Shot) -> int:
    """Number of firings of the section's event in a half period after its start and in the mirrored half after that."""
    guards = [segment.guard_id for segment in half.segments[1:]]
    return guards.count(section.start) + guards.count(reflection.guards[section.start])


def _residual(loop: ScaledLoop, section: Section, start: Array, full: Shot, period: float) -> float:
    """Closing error of the event simulation, from a moment far from any event to the same one a period later."""
    events = np.cumsum([segment.duration for segment in full.segments])
    grid = np.arange(1, _GRID) * (period / _GRID)
    calm = 1 + int(np.argmax(np.min(np.abs(grid[:, None] - events), axis=1)))
    run = Trajectory(loop.loop.automaton, start, section.start.mode, period / _GRID, 2 * section.refine)
    run.advance(calm)
    before = run.state.copy()
    run.advance(calm + _GRID)
    size = int(run.record.size[0])
    spread = np.ptp(run.record.state[:size], axis=0)
    spread[spread == 0.0] = 1.0
    return float(np.max(np.abs(run.state - before)[loop.free] / spread[loop.free]))


def _orbit(
    loop: ScaledLoop, section: Section, point: FixedPoint, full: Shot, period: float, residual: float, symmetric: bool
) -> Orbit:
    automaton, rows = loop.loop.automaton, loop.loop.rows
    lowest, highest = extremes(automaton, point.state, full.segments, rows["position"])
    motor = extremes(automaton, point.state, full.segments, rows["theta_m"])
    shifted = float(rows["position"][0] @ loop.displacement)
    return Orbit(
        frequency=1.0 / period,
        lowest=loop.unit * lowest + shifted,
        highest=loop.unit * highest + shifted,
        motor_amplitude=0.5 * loop.unit * (motor[1] - motor[0]),
        symmetric=symmetric,
        multipliers=leading(full.derivative, loop.free),
        half_multipliers=leading(point.shot.derivative, loop.free) if symmetric else None,
        events=phases(loop.loop, full.segments, period),
        residual=residual,
        loop=loop.loop,
        start=loop.actual(point.state),
        start_mode=section.start.mode,
    )
