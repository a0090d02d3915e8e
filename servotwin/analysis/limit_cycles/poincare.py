"""The Poincaré map of an automaton and its exact derivative.

A point of the map is a state *just before* a section event, in the mode that the event ends. The map fires the event,
follows the flow through every further event and stops just before the next section event. The kernel finds the
sequence of events and their times; state and derivative are then propagated along it by matrix exponentials and, at
events, saltation matrices. Within one sequence nothing else is nonlinear than the times of the events.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.exponential import expm1
from servotwin.hybrid.trajectory import Trajectory, ZenoError

Flags = NDArray[np.bool_]

# A guard that rises slower than this part of what its terms could add up to grazes: its event has no derivative.
GRAZING = 1e-12


class GuardId(NamedTuple):
    """A guard of a mode, by their indices."""

    mode: int
    guard: int


class FlowSegment(NamedTuple):
    """Flow in one mode for `duration` seconds; then `guard_id`, and at the same instant whatever it sets off.

    `reset` and `target` are those of all these events together.
    """

    mode: int
    duration: float
    guard_id: GuardId
    reset: Array
    target: int


class Shot(NamedTuple):
    """One passage of the map: the state just before the last event, its derivative (n, n) with respect to the state at
    the start, and the way there."""

    state: Array
    derivative: Array
    segments: tuple[FlowSegment, ...]


class LostOrbit(RuntimeError):
    """Error: the flow does not return to the section, meets another event first, or grazes a guard."""


@dataclass(frozen=True, eq=False)
class Section:
    """Begin and end of a passage of the map.

    Attributes
    ----------
    automaton : Automaton
    start, end : GuardId
        The event at the start, and the one that ends a passage when it fires for the `hits`-th time after the start.
    hits : int
    sample_step, horizon : float
        s: grid of the run, and the time after which the search is given up.
    refine : int
        Divides the kernel's search step.
    """

    automaton: Automaton
    start: GuardId
    end: GuardId
    hits: int
    sample_step: float
    horizon: float
    refine: int = 1

    def shoot(self, state: Array) -> Shot:
        """Run from just before the start event to just before the end event."""
        segments = self._segments(state, self.start.mode, self.hits, skip=1)
        if segments[0].guard_id != self.start:
            raise LostOrbit(f"{self._name(segments[0].guard_id)} comes before {self._name(self.start)}")
        return propagate(self.automaton, state, segments)

    def approach(self, state: Array, mode: int) -> Array:
        """The state just before the first start event from any state in any mode."""
        to_start = replace(self, end=self.start, hits=1)
        return propagate(self.automaton, state, to_start._segments(state, mode, 1, skip=0)).state

    def _segments(self, state: Array, mode: int, hits: int, skip: int) -> tuple[FlowSegment, ...]:
        run = Trajectory(self.automaton, state, mode, self.sample_step, self.refine)
        while run.time < self.horizon:
            try:
                run.advance(run.samples - 1 + 64)
            except ZenoError as error:
                raise LostOrbit(str(error)) from None
            times, guards = guard_events(run)
            ends = [i for i, guard_id in enumerate(guards) if i >= skip and guard_id == self.end]
            if len(ends) >= hits:
                last = ends[hits - 1]
                return _grouped(self.automaton, times[: last + 1], guards[: last + 1])
        raise LostOrbit(f"{self._name(self.end)} does not come within {self.horizon:.6g} s")

    def _name(self, guard_id: GuardId) -> str:
        mode = self.automaton.modes[guard_id.mode]
        return f"{mode.guards[guard_id.guard].label!r} of mode {mode.name!r}"


def guard_events(run: Trajectory) -> tuple[list[float], list[GuardId]]:
    """Times (s) and guards of a run's events so far."""
    r, size = run.record, int(run.record.size[1])
    times = (r.event_step[:size] + r.event_fraction[:size]) * run.step
    pairs = zip(r.event_mode[:size].tolist(), r.event_guard[:size].tolist(), strict=True)
    return times.tolist(), [GuardId(mode, guard) for mode, guard in pairs]


def _grouped(automaton: Automaton, times: list[float], guards: list[GuardId]) -> tuple[FlowSegment, ...]:
    """Events as segments; those at the instant of another, which it set off, are one with it. The last event is not
    applied, so it stands alone."""
    segments: list[FlowSegment] = []
    before = 0.0
    for i, (time, guard_id) in enumerate(zip(times, guards, strict=True)):
        guard = automaton.modes[guard_id.mode].guards[guard_id.guard]
        reset = np.eye(len(automaton.names)) if guard.reset is None else np.asarray(guard.reset, dtype=float)
        if segments and time == before and i < len(times) - 1:
            last = segments[-1]
            segments[-1] = last._replace(reset=reset @ last.reset, target=guard.target)
        else:
            segments.append(FlowSegment(guard_id.mode, time - before, guard_id, reset, guard.target))
        before = time
    return tuple(segments)


def propagate(automaton: Automaton, state: Array, segments: tuple[FlowSegment, ...]) -> Shot:
    """State and derivative along segments, up to just before the event that ends the last one.

    At an event with guard row g, reset R and flows f-, f+ before and after it a deviation d becomes
    ``R d + (f+ - R f-) (g d) / (g f-)``; at the last one, where the map stops on the section,
    ``d - f- (g d) / (g f-)``.
    """
    x, derivative = np.array(state, dtype=float), np.eye(len(state))
    for i, segment in enumerate(segments):
        flow = automaton.flows[segment.mode]
        change = expm1(flow, segment.duration).astype(float)
        x = x + change @ x
        derivative = derivative + change @ derivative
        before = flow @ x
        sooner = _sooner(automaton, segment.guard_id, x, before) @ derivative
        if i == len(segments) - 1:
            derivative = derivative - np.outer(before, sooner)
        else:
            x = segment.reset @ x
            after = automaton.flows[segment.target] @ x
            derivative = segment.reset @ derivative + np.outer(after - segment.reset @ before, sooner)
    return Shot(x, derivative, segments)


def _sooner(automaton: Automaton, guard_id: GuardId, x: Array, flow: Array) -> Array:
    """(n,) g / (g f-): by how much sooner the event comes per deviation of the state."""
    row = np.asarray(automaton.modes[guard_id.mode].guards[guard_id.guard].row, dtype=float)
    rate = float(row @ flow)
    if not rate > GRAZING * float(np.abs(row) @ (np.abs(automaton.flows[guard_id.mode]) @ np.abs(x))):
        raise LostOrbit(f"the event {automaton.modes[guard_id.mode].guards[guard_id.guard].label!r} grazes its guard")
    return row / rate


class FixedPoint(NamedTuple):
    """A state that the map repeats, the last shot from it, and how well: the largest part of its scale by which any
    state fails to close."""

    state: Array
    shot: Shot
    residual: float


def newton(shoot: Callable[[Array], Shot], start: Array, free: Flags, scale: Array, steps: int = 25) -> FixedPoint:
    """A fixed point by Newton's method, damped where a full step loses the orbit or the residual.

    Parameters
    ----------
    shoot : function
        The map: from ``(n,)`` to a `Shot`.
    start : (n,) array
    free : (n,) boolean array
        States that move. The others are constants of the flow: each would be a neutral direction.
    scale : (n,) array
        Size of each state.
    steps : int

    Raises
    ------
    LostOrbit
        The iteration neither converges nor stays on orbits that return.
    """
    state = np.array(start, dtype=float)
    shot = shoot(state)
    residual = _residual(shot, state, free, scale)
    for _ in range(steps):
        # Least squares in scaled states: a continuum of orbits has one neutral direction more, along which to stay.
        matrix = (np.eye(int(free.sum())) - shot.derivative[np.ix_(free, free)]) * scale[free] / scale[free, None]
        step = scale[free] * np.linalg.lstsq(matrix, (shot.state - state)[free] / scale[free], rcond=1e-12)[0]
        better = _damped(shoot, state, step, free, scale, residual)
        if better is None:
            break
        state, shot, residual = better
    if residual > 1e-6:
        raise LostOrbit(f"Newton's method stops at a residual of {residual:.2g}")
    return FixedPoint(state, shot, residual)


def _damped(
    shoot: Callable[[Array], Shot], state: Array, step: Array, free: Flags, scale: Array, residual: float
) -> FixedPoint | None:
    """The longest of the steps 1, 1/2, 1/4, ... that lowers the residual; None when none does."""
    for halving in range(7):
        trial = state.copy()
        trial[free] += step / 2**halving
        try:
            shot = shoot(trial)
        except LostOrbit:
            continue
        lower = _residual(shot, trial, free, scale)
        if lower < residual:
            return FixedPoint(trial, shot, lower)
    return None


def _residual(shot: Shot, state: Array, free: Flags, scale: Array) -> float:
    return float(np.max(np.abs(shot.state - state)[free] / scale[free], initial=0.0))
