"""heyoka: adaptive Taylor integration with terminal events, compiled by LLVM; batches of runs share SIMD lanes.

One integrator serves all modes: which contact holds and whether the dead zone is open are parameters, changed by the
callbacks of five events. A step that ends at an event is shortened; the integrator is built once and used warm.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from importlib.util import find_spec
from itertools import pairwise
from operator import add
from typing import Any

import numpy as np

from benchmarks.contest import Contestant, Job
from benchmarks.workloads import LoopEquations, SweepWorkload, WearWorkload, equations_of
from servotwin.hybrid.automaton import Array

NAME = "heyoka"
MISSING = "" if find_spec("heyoka") else "not installed (pip install servotwin[bench])"
TOLERANCE = 1e-15
BATCH = 8  # runs in one integrator: the fastest of 1, 2, 4, 8 and 16
CLOSED, SIDE, SCREW, ON, REFERENCE, DEAD, C0, C2, C3 = range(9)
CURRENT, SPEED, ANGLE, INTEGRAL, LAGGED, CHAIN = range(6)
STATES = 9
# rad: the screw is released this far inside the gap, or the contact just left would be detected again and again.
MARGIN = 1e-12
# s in which an event is not detected again. What heyoka derives from the guard's slope grows beyond all bounds when the
# motor comes to rest against the gap, and later releases are missed.
COOLDOWN = 1e-9
# At rest with a gap that opens from zero, "the motor turns back" holds at once and means nothing.
START = 1e-6
SMALLEST_HALF_GAP = 1e-11  # rad, instead of none


@dataclass(frozen=True, eq=False)
class Integrator:
    """A compiled integrator of `lanes` runs; one run has no lane axis."""

    compiled: Any
    lanes: int
    position: Array

    def begin(self) -> Any:
        """Rest at time 0; returns the parameters, to be filled."""
        ta = self.compiled
        ta.set_time(0.0) if self.lanes > 1 else setattr(ta, "time", 0.0)
        ta.state[:] = 0.0
        ta.pars[:] = 0.0
        ta.reset_cooldowns()
        return ta.pars

    def outputs(self, times: Array) -> Array:
        """Positions at times (n,): (n,) or (n, lanes), from the present one on."""
        if self.lanes == 1:
            return np.asarray(self.compiled.propagate_grid(times)[-1][:, CHAIN:] @ self.position)
        answer = self.compiled.propagate_grid(np.repeat(times[:, None], self.lanes, axis=1))
        grid = answer if isinstance(answer, np.ndarray) else answer[-1]
        return np.asarray(np.tensordot(grid[:, CHAIN:], self.position, axes=(1, 0)))


def build(model: LoopEquations, lanes: int = 1, tolerance: float = TOLERANCE) -> Integrator:
    """Compile an integrator for so many runs at once."""
    import heyoka

    equations, guards = _system(heyoka, model)
    event = heyoka.t_event if lanes == 1 else heyoka.t_event_batch
    directions = heyoka.event_direction
    sides = (directions.any, directions.any, directions.negative, directions.positive, directions.negative)
    events = [
        event(guard, callback=callback, direction=side, cooldown=COOLDOWN)
        for guard, side, callback in zip(guards, sides, _callbacks(), strict=True)
    ]
    shape: tuple[int, ...] = () if lanes == 1 else (lanes,)
    make = heyoka.taylor_adaptive if lanes == 1 else heyoka.taylor_adaptive_batch
    zeros = {"state": np.zeros((STATES, *shape)), "pars": np.zeros((C3 + 1, *shape))}
    return Integrator(make(equations, tol=tolerance, t_events=events, **zeros), lanes, model.position)


def _system(heyoka: Any, model: LoopEquations) -> tuple[list[Any], list[Any]]:
    """Equations of motion, and the guards of `_callbacks`: a guard of the other contact mode is a constant."""
    current, speed, angle, integral, lagged = heyoka.make_vars("current", "speed", "angle", "integral", "lagged")
    chain = heyoka.make_vars(*(f"chain{i}" for i in range(model.position.size)))
    par, t = heyoka.par, heyoka.time
    closed, opened = par[CLOSED], 1.0 - par[CLOSED]
    half = par[C0] + t * t * (par[C2] + par[C3] * t)
    rate = t * (2.0 * par[C2] + 3.0 * par[C3] * t)
    error = par[REFERENCE] - _dot(model.position, chain)
    voltage = par[ON] * ((model.Kp + model.N) * error + model.Ki * integral - model.N * lagged)
    screw = closed * (angle - par[SIDE] * half) + opened * par[SCREW]
    motor = (current, speed, angle)
    drives = [float(b) * voltage for b in model.motor_B]
    equations = [
        *((x, _dot(row, motor) + drive) for x, row, drive in zip(motor, model.motor_A, drives, strict=True)),
        (integral, par[ON] * error),
        (lagged, (par[ON] * error - lagged) / model.Tf),
        *((x, _dot(a, chain) + float(b) * screw) for x, a, b in zip(chain, model.chain_A, model.chain_B, strict=True)),
    ]
    guards = [
        error - par[DEAD],
        error + par[DEAD],
        closed * (par[SIDE] * speed - rate) - opened,
        opened * (angle - par[SCREW] - half) - closed,
        opened * (angle - par[SCREW] + half) + closed,
    ]
    return equations, guards


def _dot(row: Array, terms: Any) -> Any:
    return reduce(add, (float(a) * x for a, x in zip(row, terms, strict=True) if a != 0.0), 0.0 * terms[0])


def _callbacks() -> tuple[Callable[..., bool], ...]:
    """Make the callbacks of the events; only an integrator of several runs passes a lane."""

    def beyond(side: int) -> Callable[..., bool]:
        def switch(ta: Any, sign: int, *lane: int) -> bool:
            pars = ta.pars[(slice(None), *lane)]
            if pars[DEAD] > 0.0:
                pars[ON] = float(sign * side > 0)
            return True

        return switch

    def release(ta: Any, _sign: int, *lane: int) -> bool:
        pars, t = ta.pars[(slice(None), *lane)], float(ta.time[lane]) if lane else ta.time
        if t > START:
            half = pars[C0] + t * t * (pars[C2] + pars[C3] * t)
            pars[SCREW] = ta.state[(ANGLE, *lane)] - pars[SIDE] * (half - MARGIN)
            pars[CLOSED] = 0.0
        return True

    def contact(side: int) -> Callable[..., bool]:
        def close(ta: Any, _sign: int, *lane: int) -> bool:
            pars = ta.pars[(slice(None), *lane)]
            pars[CLOSED], pars[SIDE] = 1.0, side
            return True

        return close

    return beyond(1), beyond(-1), release, contact(1), contact(-1)


def wearing(workload: WearWorkload) -> Contestant:
    """W1."""

    def prepare() -> Job:
        integrator = build(equations_of(workload.servo))
        times = np.arange(workload.samples) / workload.sample_rate
        ends = [round(turn * 0.5 * workload.period * workload.sample_rate) for turn in range(workload.turns + 1)]

        def job() -> Array:
            out = np.empty(workload.samples)
            pars = integrator.begin()
            pars[[CLOSED, SIDE, DEAD]] = 1.0, 1.0, workload.tolerance
            pars[[C0, C2, C3]] = workload.half_gap
            position = 0.0
            for turn, (first, last) in enumerate(pairwise(ends)):
                pars[REFERENCE] = workload.level(turn)
                pars[ON] = float(abs(pars[REFERENCE] - position) > workload.tolerance)
                out[first : last + 1] = integrator.outputs(times[first : last + 1])
                position = out[last]
            return out

        return job

    return Contestant(f"{NAME} {TOLERANCE:g}", prepare, MISSING)


def sweeping(workload: SweepWorkload, lanes: int, threads: int) -> Contestant:
    """W2 with so many runs in an integrator and so many integrators at work."""
    gaps, tolerances = workload.members
    groups = [np.arange(first, min(first + lanes, gaps.size)) for first in range(0, gaps.size, lanes)]
    times = np.arange(workload.samples) / workload.sample_rate

    def prepare() -> Job:
        integrators = [build(equations_of(workload.servo), lanes) for _ in range(threads)]

        def part(worker: int, out: Array) -> None:
            for group in groups[worker::threads]:
                lane = np.resize(group, lanes) if lanes > 1 else group[0]
                pars = integrators[worker].begin()
                pars[REFERENCE], pars[ON], pars[DEAD] = workload.step, 1.0, tolerances[lane]
                pars[C0] = np.maximum(0.5 * gaps[lane], SMALLEST_HALF_GAP)
                out[group] = integrators[worker].outputs(times).reshape(times.size, -1).T[: group.size]

        def job() -> Array:
            out = np.empty((gaps.size, times.size))
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(part, range(threads), [out] * threads))
            return out

        return job

    how = f"by {lanes}" if lanes > 1 else "one by one"
    return Contestant(f"{NAME} {how}, {threads} thread{'s' * (threads > 1)}", prepare, MISSING)
