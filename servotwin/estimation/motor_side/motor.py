"""Motion of a motor and its load under the motor's command, followed by an observer of the motor's angle; compiled."""

from __future__ import annotations

from servotwin.estimation.output_error.shaft import drive_to, guard, through_sample
from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array


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
def step_motor(
    step: Array,
    by_command: Array,
    by_torque: Array,
    command: float,
    torque: float,
    friction: float,
    motor: Array,
    ahead: Array,
) -> None:
    """States (d,) of the motor one interval later under a constant command and torque, into `ahead`."""
    size = motor.size
    for j in range(size):
        ahead[j] = by_command[j] * command + by_torque[j] * torque
        for k in range(size):
            ahead[j] += step[j, k] * motor[k]
    ahead[size - 2] -= min(max(ahead[size - 2], -friction), friction)


@bare
def run_motor(
    measured: Array,
    command: Array,
    fine: int,
    interval: float,
    half: float,
    flows: Array,
    steps: Array,
    push: Array,
    friction: float,
    work: Array,
    state: Array,
    row: Array,
    ground: tuple[float, float],
    step: Array,
    by_command: Array,
    by_torque: Array,
    motor_friction: float,
    gains: Array,
    motor: Array,
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
    fine : int
        Parts of a sample that the load needs, each `interval` (s) long.
    interval, half, flows, steps, push, friction, work, state
        Those of `run_shaft`, of the load.
    row : (2 n + 3,) array
        Momentum of the load, and what its damper to the ground takes of it per position.
    ground : (float, float)
        Stiffness to the ground (N/m, rotary: N m/rad), and constant force (N, rotary: N m) on the load.
    step : (d, d) array
    by_command, by_torque : (d,) arrays
        Exact step of the motor's states over one sample, speed and angle at the load the last two, and columns of the
        command and of the shaft's force.
    motor_friction : float
        Speed at the load that the motor's Coulomb friction takes off in one sample at most.
    gains : (2, 2 n + 2) array
        Shares of the measured angle less the predicted one that are added to the motor's angle and speed, and to the
        n positions and speeds of the load: in the gap and in contact.
    motor : (d,) array
        At the first sample; changed.
    predicted, driven : (N,) arrays
        Out: motor's angle, and the driven end.
    """
    n, kept, size = (state.size - 3) // 2, state.size - 3, motor.size
    ahead, lead = work[-1], motor[size - 1] - state[kept]
    side = 0 if abs(lead) <= half else (1 if lead > 0.0 else -1)
    for i in range(measured.size):
        predicted[i], driven[i] = motor[size - 1], state[kept]
        error, mode = measured[i] - motor[size - 1], 1 if side != 0 else 0
        motor[size - 1] += gains[mode, 0] * error
        motor[size - 2] += gains[mode, 1] * error
        for j in range(2 * n):
            state[j] += gains[mode, 2 + j] * error
        if i + 1 == measured.size:
            break
        begin = motor[size - 1]
        drive_to(state, side, begin, motor[size - 2], half, kept)
        force = flank_force(side, begin, state, push, half)
        # With the force as it begins: where that leads the motor, the load goes with it, and the mean force moves it.
        step_motor(step, by_command, by_torque, command[i], -force, motor_friction, motor, ahead)
        rate = (ahead[size - 1] - begin) / (fine * interval)
        impulse = 0.0
        for k in range(fine):
            now, then = begin + k * interval * rate, begin + (k + 1) * interval * rate
            drive_to(state, side, now, rate, half, kept)
            # The impulse of the shaft is what the load's momentum gained: exact, whatever happened within the sample.
            impulse -= momentum(row, state) - 0.5 * interval * ground[0] * state[0]
            side = through_sample(side, now, then, interval, half, flows, steps, push, work[:-1], state)
            impulse += momentum(row, state) + interval * (0.5 * ground[0] * state[0] - ground[1])
            speed = state[2 * n - 1]
            state[2 * n - 1] = speed - min(max(speed, -friction), friction)
        force = impulse / (fine * interval)
        step_motor(step, by_command, by_torque, command[i], -force, motor_friction, motor, ahead)
        for j in range(size):
            motor[j] = ahead[j]
