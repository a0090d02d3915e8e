"""What looks like another gap: a load that friction in the gap carries, and walls much softer than the stated shaft."""

import math

import numpy as np
import pytest

from servotwin.control.cascade import Cascade
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.joint.estimator import estimate_jointly
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import Samples
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

LEAD, COUNT, RATE = 1e-3, 1e-6, 1000.0
# A shaft of 25 Hz: against a flank the load's acceleration stretches it by up to 13 counts.
AXIS = Axis(
    TorqueDrive(8.0 * LEAD**2, friction=10.0 * LEAD**2),
    Transmission(LEAD, 10.0 * (2.0 * math.pi * 25.0) ** 2, 200.0, in_gap="free"),
    Load((10.0,), (0.0,), (20.0,)),
    Cascade(12.0, LEAD, 900.0 * LEAD**2, on="motor", speed_filter=2e-3, sample_rate=RATE),
    Sensors(feedback="motor", position_resolution=COUNT, encoder_resolution=COUNT / LEAD),
)


def strokes() -> np.ndarray:
    """Way (N,) to and fro by 1 mm, m."""
    time = np.arange(0.0, 1.5, 1.0 / RATE)
    way = np.zeros(time.size)
    for i, begin in enumerate(np.arange(0.1, 1.4, 0.35)):
        u = np.clip((time - begin) / 0.25, 0.0, 1.0)
        way += (-1.0) ** i * 1e-3 * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return way


def window(motor: np.ndarray, load: np.ndarray) -> Window:
    return Window(np.round(load / COUNT) * COUNT, np.round(motor / COUNT) * COUNT / LEAD, sample_rate=RATE)


@pytest.mark.parametrize("late", [1.0, 3.0])
def test_a_load_that_moves_with_the_motor_without_any_stretch_is_not_one_without_a_gap(late: float) -> None:
    way, samples = strokes(), np.arange(1500)
    carried = window(way, np.interp(samples - late, samples, way))
    for found in (estimate_gap(carried, AXIS), estimate_jointly(carried, AXIS).gaps[0]):
        assert found.status is GapStatus.UNIDENTIFIABLE
        assert "friction in the gap may carry it" in "; ".join(found.reasons)


def test_a_load_that_a_flank_carries_shows_that_there_is_no_gap() -> None:
    way = strokes()
    reference = Samples(tuple(np.arange(way.size) / RATE), tuple(way))
    run = simulate(AXIS, (way.size - 1) / RATE, reference=reference, sample_rate=RATE)
    found = estimate_gap(window(LEAD * run.theta_m, run.position), AXIS)
    assert found.status is GapStatus.OK
    assert LEAD * found.interval[1] < 5.0 * COUNT


def estimate_behind(softer: float, friction: float, gap: float, size: float) -> GapEstimate:
    """Of a machine with a shaft so many times softer than stated, its load's friction (N) and gap (m), in strokes of a
    size over 1 mm."""
    stated = AXIS.replace(load=Load((10.0,), (0.0,), (20.0,), friction=friction))
    stiffness = AXIS.transmission.k_d / softer
    damping = AXIS.transmission.c_d if softer == 1.0 else 0.2 * math.sqrt(10.0 * stiffness)
    machine = stated.replace(
        transmission=Transmission(LEAD, stiffness, damping, in_gap="free"),
        controller=Cascade(6.0, LEAD, 900.0 * LEAD**2, on="motor", speed_filter=2e-3, sample_rate=RATE),
    )
    way = size * strokes()
    reference = Samples(tuple(k / RATE for k in range(way.size)), tuple(way))
    run = simulate(machine, (way.size - 1) / RATE, reference=reference, gap=gap / LEAD, sample_rate=RATE)
    return estimate_gap(window(LEAD * run.theta_m, run.position), stated)


@pytest.mark.parametrize(("friction", "gap"), [(0.05, 20e-6), (0.1, 20e-6), (0.1, 40e-6)])
def test_friction_that_winds_up_a_soft_wall_bounds_no_gap(friction: float, gap: float) -> None:
    found = estimate_behind(30.0, friction, gap, 0.1)
    assert found.status is GapStatus.UNIDENTIFIABLE
    assert "a shaft much softer than the stated one" in "; ".join(found.reasons)


def test_a_gap_between_soft_walls_is_not_that_of_the_stated_shaft() -> None:
    """It was 114 within 22 um."""
    found = estimate_behind(20.0, 0.0, 80e-6, 0.3)
    assert found.status is GapStatus.MODEL_MISMATCH
    assert "times softer than the stated one explains the window better" in "; ".join(found.reasons)


def test_a_shaft_as_stated_shows_its_gap() -> None:
    found = estimate_behind(1.0, 0.0, 80e-6, 0.3)
    assert found.status is GapStatus.OK
    assert LEAD * found.gap == pytest.approx(80e-6, abs=3.0 * COUNT)


def test_a_shaft_as_stated_bounds_its_gap() -> None:
    found = estimate_behind(1.0, 0.05, 150e-6, 0.1)
    assert found.status is GapStatus.LOWER_BOUND
    assert LEAD * found.gap < 150e-6
