"""Effects that the parameters do not have: one encoder does not tell them apart, and the intervals contain them.

Motor and load are integrated here with small steps, under a cascade on the motor; only its encoder is logged.
"""

import math

import numpy as np
import pytest
from drive_recordings import recording_of, simulated, strokes

from servotwin.estimation.inverse_dynamics.identify import identify_drive

RATE, PARTS = 500.0, 20  # steps in a sample
MOTOR, LOAD, VISCOUS, COULOMB = 8.0, 12.0, 30.0, 12.0
STIFFNESS, DAMPING = 1e6, 300.0


def recorded(
    sliding=math.inf, creep=0.0, quadratic=0.0, stribeck=0.0, saturation=0.0, gusts=0.0, worm=0.0, acceleration=1.0
):
    """Recording of a motor and a load on a belt.

    The belt slides above a force `sliding` (N) and creeps by `creep` (m/s per N and m/s); friction also has a part with
    the square of the speed (N s^2/m^2), and near standstill one of Coulomb's; the motor's force lacks a part of
    `saturation` (1/N^2) times the square of the command; `gusts` (N, standard deviation) push the load at random;
    friction also has `worm` times the force that moves the load.
    """
    reference, step = strokes(acceleration=acceleration, cycles=2), 1.0 / (RATE * PARTS)
    motor = speed = load = fast = slipped = last = slow = 0.0
    table = np.empty((2, reference.size))
    pushes = np.convolve(np.random.default_rng(3).standard_normal(reference.size), np.hanning(101), "same")
    pushes *= gusts / np.std(pushes)
    for i, wanted in enumerate(reference):
        slow += 0.5 * ((motor - last) * RATE - slow)
        last = motor
        command = 2400.0 * (25.0 * (wanted - motor) - slow)
        table[:, i] = motor, command
        given = command * (1.0 - saturation * command**2)
        for _ in range(PARTS):
            force = STIFFNESS * (motor - slipped - load) + DAMPING * (speed - fast)
            beyond = max(abs(force) - sliding, 0.0) * math.copysign(1.0, force)
            slipped += step * (creep * force * abs(speed) + beyond / DAMPING)
            speed += step * (given - force) / MOTOR
            fast += step * (force + pushes[i] - VISCOUS * fast - quadratic * fast * abs(fast)) / LOAD
            most = step * (COULOMB * (1.0 + stribeck * math.exp(-abs(fast) / 0.01)) + worm * abs(force)) / LOAD
            fast -= min(max(fast, -most), most)
            motor, load = motor + step * speed, load + step * fast
    return recording_of(np.round(table[0] / 1e-7) * 1e-7, table[1], reference)


def distances(drive, truth):
    """Of inertia, viscous and Coulomb friction from the truth, in half-widths."""
    refined = drive.refinement
    fit = drive.symmetric if refined is None or not refined.converged else refined.symmetric
    return [abs(fit[name] - value) / fit.half_width(name) for name, value in truth.items()]


TRUTH = {"inertia": MOTOR + LOAD, "viscous": VISCOUS, "coulomb": COULOMB}


@pytest.mark.parametrize(
    "effect",
    [
        {"sliding": 20.0},
        {"creep": 4e-3},
        {"quadratic": 150.0},
        {"stribeck": 1.0},
        {"saturation": 1e-4},
        {"worm": 0.2, "acceleration": 2.0},
    ],
)
def test_intervals_hold_under_an_effect_that_no_parameter_has(effect):
    drive = identify_drive([recorded(**effect)])
    assert max(distances(drive, TRUTH)) < 1.0


@pytest.mark.parametrize(
    "effect",
    [{}, {"quadratic": 150.0}, {"stribeck": 1.0}, {"worm": 0.2}, {"worm": 0.2, "acceleration": 2.0}],
)
def test_the_friction_at_the_speeds_of_the_log_is_known_better_than_its_parts(effect):
    drive = identify_drive([recorded(**effect)])
    fit = drive.refinement.symmetric
    for found in drive.friction:
        coulomb = COULOMB * (1.0 + effect.get("stribeck", 0.0) * math.exp(-found.speed / 0.01))
        friction = coulomb + VISCOUS * found.speed + effect.get("quadratic", 0.0) * found.speed**2
        # A worm's friction is in proportion to a force that contains it.
        assert abs(found.force - friction / (1.0 - effect.get("worm", 0.0))) < found.half_width
        parts = math.hypot(fit.half_width("viscous") * found.speed, fit.half_width("coulomb"))
        assert found.half_width < 0.75 * parts


def test_a_belt_that_slides_is_said_to_leave_a_part_of_the_command():
    drive = identify_drive([recorded(sliding=20.0)])
    assert drive.beside.startswith("inertia and friction leave ")
    assert "the intervals contain what that does" in drive.beside
    assert drive.slip == ""


def test_a_force_that_nothing_explains_is_said_to_be_left():
    """And each parameter may be off by what a force so large does along it alone."""
    drive = identify_drive([recorded(gusts=3.0)])
    fit = drive.refinement.symmetric
    assert drive.refinement.converged
    assert "nothing that was tried explains it" in drive.beside
    assert fit.half_width("coulomb") > fit.relative_error * COULOMB
    assert drive.friction[0].half_width > fit.relative_error * COULOMB


def test_a_healthy_machine_keeps_its_narrow_intervals():
    """And nothing is said: a rigid one, and one on a stiff belt."""
    rigid, belt = identify_drive([simulated()], p=1e-3), identify_drive([recorded()])
    assert rigid.beside == belt.beside == ""
    assert max(distances(belt, TRUTH)) < 1.0
    for drive, within in ((rigid, 0.002), (belt, 0.1)):
        fit = drive.refinement.symmetric
        assert fit.half_width("inertia") < within * fit["inertia"]
        assert fit.half_width("coulomb") < within * fit["coulomb"]
