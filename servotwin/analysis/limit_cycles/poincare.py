"""The Poincaré map of an automaton and its exact derivative.

A point of the map is a state *just before* a section event, in the mode that the event ends. The map fires the event,
follows the flow through every further event and stops just before the next section event. The kernel finds the
sequence of events and their times; state and derivative are then carried along it by matrix exponentials and, at
events, saltation matrices. Within one sequence nothing else is nonlinear than the times of the events.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.exponential import expm1
from servotwin.hybrid.trajectory import Trajectory, ZenoError

Flags = NDArray[np.bool_]

# A guard that rises slower than this part of what its terms could add up to grazes: its event has no derivative.
GRAZING = 1e-12


class Firing(NamedTuple):
    """A guard of a mode, by their indices."""

    mode: int
    guard: int


class Stretch(NamedTuple):
    """Flow in one mode for `duration` seconds; then `firing`, and at the same instant whatever it sets off.

    `reset` and `target` are those of all these events together.
    """

    mode: int
    duration: float
    firing: Firing
    reset: Array
    target: int


class Shot(NamedTuple):
    """One passage of the map: the state just before the last event, its derivative (n, n) with respect to the state at
    the start, and the way there."""

    state: Array
    derivative: Array
    stretches: tuple[Stretch, ...]


class LostOrbit(RuntimeError):
    """The section is not met again, met otherwise than it was left, or an event grazes its guard."""


@dataclass(frozen=True, eq=False)
class Section:
    """Where a passage begins and ends.

    Attributes
    ----------
    automaton : Automaton
    start, end : Firing
        The event at the start, and the one that ends a passage when it fires for the `hits`-th time after the start.
    hits : int
    sample_step, horizon : float
        s: grid of the run, and the time after which the search is given up.
    refine : int
        Divides the kernel's search step.
    """

    automaton: Automaton
    start: Firing
    end: Firing
    hits: int
    sample_step: float
    horizon: float
    refine: int = 1

    def shoot(self, state: Array) -> Shot:
        """From just before the start event to just before the end event."""
        stretches = self._stretches(state, self.start.mode, self.hits, skip=1)
        if stretches[0].firing != self.start:
            raise LostOrbit(f"{self._name(stretches[0].firing)} comes before {self._name(self.start)}")
        return carried(self.automaton, state, stretches)

    def approach(self, state: Array, mode: int) -> Array:
        """The state just before the first start event from any state in any mode."""
        opposite = Section(self.automaton, self.start, self.start, 1, self.sample_step, self.horizon, self.refine)
        return carried(self.automaton, state, opposite._stretches(state, mode, 1, skip=0)).state

    def _stretches(self, state: Array, mode: int, hits: int, skip: int) -> tuple[Stretch, ...]:
        run = Trajectory(self.automaton, state, mode, self.sample_step, self.refine)
        while run.time < self.horizon:
            try:
                run.advance(run.samples - 1 + 64)
            except ZenoError as error:
                raise LostOrbit(str(error)) from None
            times, firings = fired(run)
            found = [i for i, firing in enumerate(firings) if i >= skip and firing == self.end]
            if len(found) >= hits:
                last = found[hits - 1]
                return _grouped(self.automaton, times[: last + 1], firings[: last + 1])
        raise LostOrbit(f"{self._name(self.end)} does not come within {self.horizon:.6g} s")

    def _name(self, firing: Firing) -> str:
        mode = self.automaton.modes[firing.mode]
        return f"{mode.guards[firing.guard].label!r} of mode {mode.name!r}"


def fired(run: Trajectory) -> tuple[list[float], list[Firing]]:
    """Times (s) and guards of a run's events so far."""
    r, size = run.record, int(run.record.size[1])
    times = (r.event_step[:size] + r.event_fraction[:size]) * run.step
    pairs = zip(r.event_mode[:size].tolist(), r.event_guard[:size].tolist(), strict=True)
    return times.tolist(), [Firing(mode, guard) for mode, guard in pairs]


def _grouped(automaton: Automaton, times: list[float], firings: list[Firing]) -> tuple[Stretch, ...]:
    """Events as stretches; those at the instant of another, which it set off, are one with it. The last event is not
    applied, so it stands alone."""
    stretches: list[Stretch] = []
    before = 0.0
    for i, (time, firing) in enumerate(zip(times, firings, strict=True)):
        guard = automaton.modes[firing.mode].guards[firing.guard]
        reset = np.eye(len(automaton.names)) if guard.reset is None else np.asarray(guard.reset, dtype=float)
        if stretches and time == before and i < len(times) - 1:
            last = stretches[-1]
            stretches[-1] = last._replace(reset=reset @ last.reset, target=guard.target)
        else:
            stretches.append(Stretch(firing.mode, time - before, firing, reset, guard.target))
        before = time
    return tuple(stretches)


def carried(automaton: Automaton, state: Array, stretches: tuple[Stretch, ...]) -> Shot:
    """State and derivative along stretches, up to just before the event that ends the last one.

    At an event with guard row g, reset R and flows f-, f+ before and after it a deviation d becomes
    ``R d + (f+ - R f-) (g d) / (g f-)``; at the last one, where the map stops on the section,
    ``d - f- (g d) / (g f-)``.
    """
    x, derivative = np.array(state, dtype=float), np.eye(len(state))
    for i, stretch in enumerate(stretches):
        flow = automaton.flows[stretch.mode]
        change = expm1(flow, stretch.duration).astype(float)
        x = x + change @ x
        derivative = derivative + change @ derivative
        before = flow @ x
        sooner = _sooner(automaton, stretch.firing, x, before) @ derivative
        if i == len(stretches) - 1:
            derivative = derivative - np.outer(before, sooner)
        else:
            x = stretch.reset @ x
            after = automaton.flows[stretch.target] @ x
            derivative = stretch.reset @ derivative + np.outer(after - stretch.reset @ before, sooner)
    return Shot(x, derivative, stretches)


def _sooner(automaton: Automaton, firing: Firing, x: Array, flow: Array) -> Array:
    """(n,) g / (g f-): by how much sooner the event comes per deviation of the state."""
    row = np.asarray(automaton.modes[firing.mode].guards[firing.guard].row, dtype=float)
    rate = float(row @ flow)
    if not rate > GRAZING * float(np.abs(row) @ (np.abs(automaton.flows[firing.mode]) @ np.abs(x))):
        raise LostOrbit(f"the event {automaton.modes[firing.mode].guards[firing.guard].label!r} grazes its guard")
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
        found = _residual(shot, trial, free, scale)
        if found < residual:
            return FixedPoint(trial, shot, found)
    return None


def _residual(shot: Shot, state: Array, free: Flags, scale: Array) -> float:
    return float(np.max(np.abs(shot.state - state)[free] / scale[free], initial=0.0))
