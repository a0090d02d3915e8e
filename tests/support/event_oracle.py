"""An event-driven integrator that shares nothing with servotwin's: scipy's expm on a grid of nodes, brentq in between.

Slow and plain: the flow over each node is one exponential, every guard is looked at at every node with its slope, and a
guard that turns between two nodes is followed to its top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, matrix_balance
from scipy.optimize import brentq

Array = NDArray[np.float64]
NODES = 64
POWERS = np.arange(40.0)


@dataclass
class OracleGuard:
    """Leave to `target` when ``row @ x > 0``, with ``x = reset @ x``; at a node, values up to `floor` are rounding."""

    row: Array
    target: int
    label: str
    reset: Array | None = None
    floor: float = 0.0


@dataclass
class OracleMode:
    flow: Array
    guards: Sequence[OracleGuard] = ()
    stack: Array = field(init=False)
    step: float = field(init=False, default=0.0)

    def prepare(self, step: float) -> None:
        """Tables for a grid of `step`, once."""
        if step == self.step:
            return
        self.step = step
        self.balanced, (self.scale, _) = matrix_balance(self.flow, permute=False, separate=True)
        self.stack = np.array([self.exponential(step * k) for k in range(NODES + 1)])
        self.floors = np.array([guard.floor for guard in self.guards])
        assert step * np.abs(np.linalg.eigvals(self.balanced)).max() < 5.0, "too long a step for the series"
        self.rows = np.array([guard.row for guard in self.guards]).reshape(-1, len(self.flow))

    def exponential(self, time: float) -> Array:
        return np.asarray(self.scale[:, None] * expm(self.balanced * time) / self.scale)

    def after(self, x: Array, time: float) -> Array:
        return self.exponential(time) @ x

    def derivatives(self, x: Array) -> Array:
        """(40, n) terms of the state's Taylor series over one step of the grid: a tenth of an exponential's cost."""
        terms = [x]
        for k in range(1, len(POWERS)):
            terms.append(self.flow @ terms[-1] * (self.step / k))
        return np.array(terms)


@dataclass
class OracleRun:
    """Events (time, label) and the start of every stretch of one flow (time, mode, state)."""

    modes: Sequence[OracleMode]
    end: float
    events: list[tuple[float, str]] = field(default_factory=list)
    starts: list[tuple[float, int, Array]] = field(default_factory=list)

    def at(self, times: Array, row: Array) -> Array:
        """A linear output at some times, right-continuous."""
        begin = np.array([start[0] for start in self.starts])
        result = []
        for time in times:
            start, mode, x = self.starts[max(int(np.searchsorted(begin, time, side="right")) - 1, 0)]
            result.append(row @ self.modes[mode].after(x, time - start))
        return np.array(result)


def follow(modes: Sequence[OracleMode], x: Array, mode: int, end: float, step: float) -> OracleRun:
    """Run to `end` with a grid of `step`; start in a mode that admits flow."""
    for m in modes:
        m.prepare(step)
    run, time, x = OracleRun(modes, end), 0.0, np.array(x, dtype=float)
    run.starts.append((time, mode, x))
    while time < end:
        found = _first_event(modes[mode], x, step)
        passed, which = found
        if which is None:
            if time + passed >= end:
                break
            x, time = modes[mode].stack[NODES] @ x, time + passed
        else:
            if time + passed > end:
                break
            guard = modes[mode].guards[which]
            x, time = modes[mode].after(x, passed), time + passed
            x = x if guard.reset is None else guard.reset @ x
            mode = guard.target
            run.events.append((time, guard.label))
        run.starts.append((time, mode, x))
    return run


def _first_event(mode: OracleMode, x: Array, step: float) -> tuple[float, int | None]:
    states = mode.stack @ x
    values, slopes = states @ mode.rows.T, states @ (mode.rows @ mode.flow).T
    above = values[1:] > mode.floors
    turning = (slopes[:-1] > 0.0) & (slopes[1:] < 0.0) & ~above & (values[:-1] < -mode.floors)
    for k in np.flatnonzero((above | turning).any(axis=1)):
        best = min(
            (_root(mode, states[k], row, g, bool(above[k, g]), step), g)
            for g, row in enumerate(mode.rows)
            if above[k, g] or turning[k, g]
        )
        if best[0] < np.inf:
            return k * step + best[0], best[1]
    return NODES * step, None


def _root(mode: OracleMode, x: Array, row: Array, guard: int, above: bool, step: float) -> float:
    """Time in [0, step] at which a guard becomes positive; inf when it only turns below zero."""

    series = row @ mode.derivatives(x).T

    def value(time: float) -> float:
        return float(series @ (time / step) ** POWERS)

    def slope(time: float) -> float:
        return float((POWERS[1:] * series[1:]) @ (time / step) ** POWERS[:-1] / step)

    stop = step
    if not above:
        if value(0.0) >= 0.0 or slope(0.0) <= 0.0 or slope(step) >= 0.0:  # the guard just left, zero to rounding
            return np.inf
        stop = brentq(slope, 0.0, step, xtol=1e-16, rtol=1e-14)
        if value(stop) <= 0.0:
            return np.inf
    if value(0.0) >= 0.0:
        return 0.0
    return float(brentq(value, 0.0, stop, xtol=1e-18, rtol=1e-15))
