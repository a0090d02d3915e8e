"""Belts that slip and guides with a tight spot: what a log shows of them, and what they do to the intervals.

Motor and load are integrated here with small steps, under a cascade on the motor.
"""

import math

import numpy as np
import pytest
from drive_recordings import recording_of, strokes

from servotwin.estimation.inverse_dynamics import conditioning
from servotwin.estimation.inverse_dynamics.conditioning import band_of, busiest, motion_of
from servotwin.estimation.inverse_dynamics.identify import identify_drive

RATE, PARTS = 500.0, 20  # steps in a sample
MOTOR, LOAD, VISCOUS, COULOMB = 8.0, 12.0, 30.0, 12.0
STIFFNESS, DAMPING = 1e5, 100.0


def recorded(creep=0.0, sliding=math.inf, spot=(0.0, 0.0, 0.0), warmth=0.0, noise=0.0, two=True):
    """Recording of a motor and a load on a belt.

    The belt creeps by `creep` (m/s per N), slides above a force `sliding` (N); friction is larger in a `spot` (begin,
    end, share); the load's encoder drifts by `warmth` (m), and both have white `noise` (m).
    """
    reference = strokes(cycles=2)
    random, step = np.random.default_rng(5), 1.0 / (RATE * PARTS)
    motor = speed = load = fast = slipped = last = slow = 0.0
    table = np.empty((3, reference.size))
    for i, wanted in enumerate(reference):
        slow += 0.5 * ((motor - last) * RATE - slow)
        last = motor
        command = 2400.0 * (25.0 * (wanted - motor) - slow)
        table[:, i] = motor, command, load
        for _ in range(PARTS):
            force = STIFFNESS * (motor - slipped - load) + DAMPING * (speed - fast)
            beyond = max(abs(force) - sliding, 0.0) * math.copysign(1.0, force)
            slipped += step * (creep * force + beyond / DAMPING)
            speed += step * (command - force) / MOTOR
            fast += step * (force - VISCOUS * fast) / LOAD
            there = 1.0 + (spot[2] if spot[0] < load < spot[1] else 0.0)
            most = step * COULOMB * there / LOAD
            fast -= min(max(fast, -most), most)
            motor, load = motor + step * speed, load + step * fast
    position, force, behind = table
    behind = behind + warmth * (1.0 - np.exp(-np.linspace(0.0, 2.0, behind.size)))
    position, behind = (
        np.round((each + noise * random.standard_normal(each.size)) / 1e-7) * 1e-7 for each in (position, behind)
    )
    more = {"load": behind, "load_resolution": 1e-7} if two else {}
    return recording_of(position, force, reference, **more)


def inside(drive):
    """Distances from the truth of inertia, viscous and Coulomb friction, in half-widths."""
    refined = drive.refinement
    fit = drive.symmetric if refined is None or not refined.converged else refined.symmetric
    truth = {"inertia": MOTOR + LOAD, "viscous": VISCOUS, "coulomb": COULOMB}
    return [abs(fit[name] - value) / fit.half_width(name) for name, value in truth.items()]


@pytest.mark.slow
@pytest.mark.parametrize("belt", [{"creep": 2e-4}, {"creep": 1e-3}, {"sliding": 17.0}])
def test_a_belt_that_slips_is_told_and_its_intervals_hold(belt):
    drive = identify_drive([recorded(**belt)])
    assert drive.slip.startswith("the load slips against the motor: by ")
    assert drive.shaft is None
    assert max(inside(drive)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("healthy", [{}, {"warmth": 1e-4}, {"noise": 1e-6}, {"spot": (0.02, 0.03, 1.0)}])
def test_a_belt_that_does_not_slip_is_not_said_to(healthy):
    drive = identify_drive([recorded(**healthy)])
    assert drive.slip == ""
    assert drive.shaft is not None


@pytest.mark.slow
@pytest.mark.parametrize(("begin", "end", "more"), [(0.02, 0.03, 0.6), (0.045, 0.055, 1.5)])
def test_a_tight_spot_is_told_with_its_place_and_size(begin, end, more):
    told = identify_drive([recorded(spot=(begin, end, more), two=False)]).tight
    assert told.startswith("a tight spot: between ")
    numbers = [float(word) for word in told.replace("%", "").split() if word.replace(".", "").isdigit()]
    assert numbers[0] == pytest.approx(begin, abs=0.006)
    assert numbers[1] == pytest.approx(end, abs=0.006)
    assert numbers[2] == pytest.approx(100.0 * more, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("even", [{}, {"noise": 1e-6}])
def test_even_friction_has_no_tight_spot(even):
    assert identify_drive([recorded(**even, two=False)]).tight == ""


def test_of_a_long_log_the_stretch_with_most_motion_is_looked_at(monkeypatch):
    position = np.concatenate([np.zeros(5000), strokes(cycles=1), np.zeros(3000)])
    recording = recording_of(position, np.zeros(position.size))
    band = band_of(recording)
    motion = motion_of(position, recording.rate, band)
    assert busiest(recording, motion) == (recording, motion)
    monkeypatch.setattr(conditioning, "LONGEST", position.size - 6000)
    stretch, moved = busiest(recording, motion)
    assert stretch.position.size == moved.speed.size == position.size - 6000
    assert np.ptp(stretch.position) == np.ptp(position)
    assert stretch.duration == pytest.approx(stretch.position.size / recording.rate)
