"""Motion of a motor and its load under the motor's command, followed by an observer of the motor's angle; compiled."""

from __future__ import annotations

from typing import NamedTuple

from servotwin.estimation.output_error.shaft import drive_to, guard, slow_after, slow_before, through_sample
from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array


class MotorStep(NamedTuple):
    """Exact step of the motor over a part of a sample; its states (d,) end with speed and angle at the load.

    Attributes
    ----------
    step : (d, d) array
    by_command, by_force : (d,) arrays
        Columns of the command and of the shaft's force.
    friction : float
        Speed at the load that Coulomb friction takes off in a part at most.
    """

    step: Array
    by_command: Array
    by_force: Array
    friction: float


class LoadStep(NamedTuple):
    """Step of the load over a part of a sample, in smaller parts of its own, `interval` (s) long.

    Attributes
    ----------
    parts : int
    interval, half : float
    flows, steps, push : arrays
    fading, friction : float
        Those of `run_shaft`.
    momentum : (2 n + 3,) array
        Row of the load's momentum, and what its damper to the ground takes of it per position.
    ground : (float, float)
        Stiffness to the ground (N/m, rotary: N m/rad), and constant force (N, rotary: N m) on the load.
    """

    parts: int
    interval: float
    half: float
    flows: Array
    steps: Array
    push: Array
    fading: float
    friction: float
    momentum: Array
    ground: tuple[float, float]


@bare
def flank_force(side: int, drive: float, state: Array, push: Array, half: float) -> float:
    """Force of the motor's flank on the shaft, N (rotary: N m); 0 in the gap."""
    return side * guard(side, drive, state, push, half) if side != 0 else 0.0


@bare
def momentum(row: Array, state: Array) -> float:
    """A weighted sum of the load's states."""
    total = 0.0
    for j in range(row.size):
        total += row[j] * state[j]
    return total


@bare
def step_motor(by: MotorStep, command: float, force: float, motor: Array, ahead: Array) -> None:
    """States (d,) of the motor one part of a sample later under a constant command and force, into `ahead`."""
    size = motor.size
    for j in range(size):
        ahead[j] = by.by_command[j] * command + by.by_force[j] * force
        for k in range(size):
            ahead[j] += by.step[j, k] * motor[k]
    ahead[size - 2] -= min(max(ahead[size - 2], -by.friction), by.friction)


@bare
def step_load(by: LoadStep, side: int, begin: float, rate: float, work: Array, state: Array) -> tuple[int, float]:
    """Advance the load while the motor moves from `begin` at a rate (1/s); return the flank and the shaft's mean force.

    The impulse of the shaft is what the load's momentum gained: exact, whatever happened meanwhile.
    """
    n, kept, impulse = (state.size - 3) // 2, state.size - 3, 0.0
    for k in range(by.parts):
        now, then = begin + k * by.interval * rate, begin + (k + 1) * by.interval * rate
        drive_to(state, side, now, rate, by.half, kept)
        place, unused = state[n - 1], slow_before(state, by.friction)
        impulse -= momentum(by.momentum, state) - 0.5 * by.interval * by.ground[0] * state[0]
        side = through_sample(
            side, now, then, by.interval, by.half, by.flows, by.steps, by.push, by.fading, work, state
        )
        impulse += momentum(by.momentum, state) + by.interval * (0.5 * by.ground[0] * state[0] - by.ground[1])
        slow_after(state, place, unused, by.friction)
    return side, impulse / (by.parts * by.interval)


@bare
def step_both(by: MotorStep, load: LoadStep, side: int, command: float, work: Array, motor: Array, state: Array) -> int:
    """Advance motor and load by a part of a sample, and return the flank at its end.

    With the force as it begins: where that leads the motor, the load goes with it, and the mean force moves the motor.
    """
    ahead, kept, begin = work[-1, : motor.size], state.size - 3, motor[-1]
    drive_to(state, side, begin, motor[-2], load.half, kept)
    force = flank_force(side, begin, state, load.push, load.half)
    step_motor(by, command, -force, motor, ahead)
    rate = (ahead[-1] - begin) / (load.parts * load.interval)
    side, force = step_load(load, side, begin, rate, work[:-1], state)
    step_motor(by, command, -force, motor, ahead)
    for j in range(motor.size):
        motor[j] = ahead[j]
    return side


@bare
def run_motor(
    measured: Array,
    command: Array,
    parts: int,
    by: MotorStep,
    load: LoadStep,
    gains: Array,
    work: Array,
    motor: Array,
    state: Array,
    predicted: Array,
    driven: Array,
) -> None:
    """Predict the motor's angle one sample ahead, with the load on the other side of the gap.

    Parameters
    ----------
    measured : (N,) array
        Motor's angle at the load, m or rad.
    command : (N,) array
        Held from each sample to the next, in the actuator's unit.
    parts : int
        Of a sample, one after the other.
    by, load : MotorStep, LoadStep
    gains : (2, 2 n + 2) array
        Shares of the measured angle less the predicted one that are added to the motor's angle and speed, and to the
        n positions and speeds of the load: in the gap and in contact.
    work : (19, size) array
        Scratch; size is that of the larger one of the states.
    motor, state : arrays
        States of the motor (d,) and those of `run_shaft` (2 n + 3,) at the first sample; changed.
    predicted, driven : (N,) arrays
        Out: motor's angle, and the driven end.
    """
    n, kept = (state.size - 3) // 2, state.size - 3
    lead = motor[-1] - state[kept]
    side = 0 if abs(lead) <= load.half else (1 if lead > 0.0 else -1)
    for i in range(measured.size):
        predicted[i], driven[i] = motor[-1], state[kept]
        error, mode = measured[i] - motor[-1], 1 if side != 0 else 0
        motor[-1] += gains[mode, 0] * error
        motor[-2] += gains[mode, 1] * error
        for j in range(2 * n):
            state[j] += gains[mode, 2 + j] * error
        if i + 1 == measured.size:
            break
        for _ in range(parts):
            side = step_both(by, load, side, command[i], work, motor, state)
