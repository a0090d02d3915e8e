"""The fixed-step loop that a control engineer writes: zero-order hold of the voltage, the gap clamped once a step.

Plant and filter are exact between steps, but the controller and the contacts see only the steps: first order.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from benchmarks.contest import Contestant, Job
from benchmarks.workloads import LoopEquations, NoisyWorkload, SweepWorkload, WearWorkload, equations_of
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import compiled
from servotwin.plant.linear import zero_order_hold

NAME = "numba hold"


class HeldLoop(NamedTuple):
    """The loop over one step; the last column of `motor` and `chain` is that of the input."""

    motor: Array
    chain: Array
    position: Array
    step: float
    Kp: float
    integral_step: float
    N: float
    lag_step: float
    loop_step: float


class HoldInputs(NamedTuple):
    """Square wave (level, steps a half period), half gap c0 + c2 t^2 + c3 t^3, tolerance, noise (empty: none), counts
    of the sensor (1: of a resolution, 0: none)."""

    level: float
    half_period: int
    c0: float
    c2: float
    c3: float
    tolerance: float
    noise: Array
    counted: int
    resolution: float


def hold_of(model: LoopEquations, rate: float, loop_filter_hz: float | None = None) -> HeldLoop:
    """The loop discretised at a rate, Hz."""
    step = 1.0 / rate
    motor = np.column_stack(zero_order_hold(model.motor_A, model.motor_B, step))
    chain = np.column_stack(zero_order_hold(model.chain_A, model.chain_B, step))
    loop_step = 1.0 if loop_filter_hz is None else -math.expm1(-2.0 * math.pi * loop_filter_hz * step)
    lag_step = -math.expm1(-step / model.Tf)
    return HeldLoop(motor, chain, model.position, step, model.Kp, model.Ki * step, model.N, lag_step, loop_step)


@compiled
def motor_row(M: Array, i: int, current: float, speed: float, angle: float, voltage: float) -> float:
    """Row i of the motor's next state."""
    return M[i, 0] * current + M[i, 1] * speed + M[i, 2] * angle + M[i, 3] * voltage


@compiled
def chain_row(M: Array, i: int, a: float, b: float, c: float, d: float, screw: float) -> float:
    """Row i of the chain's next state."""
    return M[i, 0] * a + M[i, 1] * b + M[i, 2] * c + M[i, 3] * d + M[i, 4] * screw


@compiled
def run(h: HeldLoop, inputs: HoldInputs, every: int, out: Array) -> None:
    """Positions, one every `every` steps, from rest."""
    current = speed = angle = screw = 0.0
    a = b = c = d = 0.0
    integral = lagged = measured = 0.0
    noisy = inputs.noise.size > 0
    out[0] = 0.0
    for j in range((out.size - 1) * every):
        position = h.position[0] * a + h.position[1] * b + h.position[2] * c + h.position[3] * d
        sensed = position + inputs.noise[j] if noisy else position
        # A loop, for as a choice it would cost a run without counts the division too.
        for _ in range(inputs.counted):
            sensed = np.round(sensed / inputs.resolution) * inputs.resolution
        measured += h.loop_step * (sensed - measured)
        level = inputs.level if (j // inputs.half_period) % 2 == 0 else -inputs.level
        error, voltage = level - measured, 0.0
        if abs(error) > inputs.tolerance:
            voltage = h.Kp * error + integral + h.N * (error - lagged)
            integral += h.integral_step * error
        else:
            error = 0.0
        lagged += h.lag_step * (error - lagged)
        i0 = motor_row(h.motor, 0, current, speed, angle, voltage)
        i1 = motor_row(h.motor, 1, current, speed, angle, voltage)
        angle = motor_row(h.motor, 2, current, speed, angle, voltage)
        current, speed = i0, i1
        t = (j + 1) * h.step
        half = inputs.c0 + t * t * (inputs.c2 + inputs.c3 * t)
        moved = min(max(screw, angle - half), angle + half)
        mean, screw = 0.5 * (screw + moved), moved
        a1 = chain_row(h.chain, 0, a, b, c, d, mean)
        b1 = chain_row(h.chain, 1, a, b, c, d, mean)
        c1 = chain_row(h.chain, 2, a, b, c, d, mean)
        d1 = chain_row(h.chain, 3, a, b, c, d, mean)
        a, b, c, d = a1, b1, c1, d1
        if (j + 1) % every == 0:
            out[(j + 1) // every] = h.position[0] * a + h.position[1] * b + h.position[2] * c + h.position[3] * d


@compiled
def run_members(h: HeldLoop, level: float, half_gaps: Array, tolerances: Array, every: int, out: Array) -> None:
    """One run for each row of `out`, constant inputs."""
    nothing = np.empty(0)
    for k in range(len(out)):
        inputs = HoldInputs(level, out.shape[1] * every, half_gaps[k], 0.0, 0.0, tolerances[k], nothing, 0, 0.0)
        run(h, inputs, every, out[k])


def wearing(workload: WearWorkload, rate: float) -> Contestant:
    """W1 at a rate (Hz) that is a multiple of the output's."""

    def prepare() -> Job:
        hold, inputs = hold_of(equations_of(workload.servo), rate), _wear_inputs(workload, rate, np.empty(0))
        return lambda: _recorded(hold, inputs, round(rate / workload.sample_rate), workload.samples)

    return Contestant(_name(rate), prepare)


def noisy(workload: NoisyWorkload) -> Contestant:
    """The sampled run: here the hold is what was asked for, and only the contacts are off."""
    wear, rate = workload.wear, workload.wear.sample_rate

    def prepare() -> Job:
        hold = hold_of(equations_of(wear.servo), rate, workload.loop_filter_hz)

        def job() -> Array:
            noise = np.empty(0)
            if workload.noise is not None:
                noise = workload.noise.samples(wear.samples, rate, np.random.default_rng(workload.seed))
            return _recorded(hold, _wear_inputs(wear, rate, noise, workload.resolution), 1, wear.samples)

        return job

    return Contestant(_name(rate), prepare)


def sweeping(workload: SweepWorkload, rate: float, threads: int) -> Contestant:
    """W2 at a rate (Hz), the members dealt out to threads."""

    def prepare() -> Job:
        gaps, tolerances = workload.members
        hold, every = hold_of(equations_of(workload.servo), rate), round(rate / workload.sample_rate)
        parts = [np.arange(first, gaps.size, threads) for first in range(threads)]

        def part(members: Array) -> Array:
            out = np.empty((members.size, workload.samples))
            run_members(hold, workload.step, 0.5 * gaps[members], tolerances[members], every, out)
            return out

        def job() -> Array:
            out = np.empty((gaps.size, workload.samples))
            with ThreadPoolExecutor(threads) as pool:
                for members, rows in zip(parts, pool.map(part, parts), strict=True):
                    out[members] = rows
            return out

        return job

    return Contestant(f"{_name(rate)}, {threads} thread{'s' * (threads > 1)}", prepare)


def _recorded(hold: HeldLoop, inputs: HoldInputs, every: int, samples: int) -> Array:
    out = np.empty(samples)
    run(hold, inputs, every, out)
    return out


def _wear_inputs(workload: WearWorkload, rate: float, noise: Array, resolution: float = 0.0) -> HoldInputs:
    half_period, counted = round(0.5 * workload.period * rate), 1 if resolution > 0.0 else 0
    gap, tolerance = workload.half_gap, workload.tolerance
    return HoldInputs(workload.amplitude, half_period, *gap, tolerance, noise, counted, resolution)


def _name(rate: float) -> str:
    return f"{NAME} {rate / 1e3:g} kHz"
