"""From a point near an orbit to the orbit, closed and verified."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servotwin.analysis.limit_cycles.orbit import Orbit, extremes, leading, phases
from servotwin.analysis.limit_cycles.poincare import FixedPoint, LostOrbit, Section, Shot, newton
from servotwin.analysis.limit_cycles.scaled import ScaledLoop
from servotwin.analysis.limit_cycles.symmetry import Mirror
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import Trajectory

# Largest residual of a returned orbit, in parts of each state's range: hundreds of roundings.
CLOSED = 1e-9
# An "orbit" smaller than this part of p gap is the equilibrium.
_SMALLEST = 1e-6
_GRID = 64


class Found(NamedTuple):
    """An orbit and how far from it, in parts of each state's size, the search began."""

    orbit: Orbit
    distance: float


def closed_orbit(loop: ScaledLoop, section: Section, start: Array, scale: Array, half: bool) -> Found:
    """The orbit through the section near a point of it.

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
        There is none near, or what was found does not close in the event simulation.
    """
    reflection = loop.mirror if half else None
    if reflection is not None:
        point = _half(loop, section, reflection, start, scale)
        section = replace(section, hits=_hits(section, reflection, point.shot))
    else:
        point = newton(section.shoot, start, loop.free, scale)
    distance = float(np.max(np.abs(start - point.state)[loop.free] / scale[loop.free]))
    full = section.shoot(point.state)
    period = sum(stretch.duration for stretch in full.stretches)
    residual = _residual(loop, section, point.state, full, period)
    if residual > CLOSED:
        raise LostOrbit(f"what was found fails to close by {residual:.2g} of its range")
    orbit = _orbit(loop, section, point, full, period, residual, reflection is not None)
    if orbit.amplitude < _SMALLEST * loop.extent * loop.unit:
        raise LostOrbit("what was found is an equilibrium")
    return Found(orbit, distance)


def _half(loop: ScaledLoop, section: Section, reflection: Mirror, start: Array, scale: Array) -> FixedPoint:
    """The fixed point of: fly to the mirrored section event, reflect."""
    to_mirror = replace(section, end=reflection.firings[section.start])

    def shoot(state: Array) -> Shot:
        shot = to_mirror.shoot(state)
        return Shot(reflection.signs * shot.state, reflection.signs[:, None] * shot.derivative, shot.stretches)

    return newton(shoot, start, loop.free, scale)


def _hits(section: Section, reflection: Mirror, half: Shot) -> int:
    """How often the section's event fires in a half period after its start, and in the mirrored half after that."""
    firings = [stretch.firing for stretch in half.stretches[1:]]
    return firings.count(section.start) + firings.count(reflection.firings[section.start])


def _residual(loop: ScaledLoop, section: Section, start: Array, full: Shot, period: float) -> float:
    """How well the event simulation closes, from one moment far from any event to the same one a period later."""
    events = np.cumsum([stretch.duration for stretch in full.stretches])
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
    lowest, highest = extremes(automaton, point.state, full.stretches, rows["position"])
    motor = extremes(automaton, point.state, full.stretches, rows["theta_m"])
    shifted = float(rows["position"][0] @ loop.displacement)
    return Orbit(
        frequency=1.0 / period,
        lowest=loop.unit * lowest + shifted,
        highest=loop.unit * highest + shifted,
        motor_amplitude=0.5 * loop.unit * (motor[1] - motor[0]),
        symmetric=symmetric,
        multipliers=leading(full.derivative, loop.free),
        half_multipliers=leading(point.shot.derivative, loop.free) if symmetric else None,
        events=phases(loop.loop, full.stretches, period),
        residual=residual,
        loop=loop.loop,
        start=loop.actual(point.state),
        start_mode=section.start.mode,
    )
