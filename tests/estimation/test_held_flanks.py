"""The gap of a screw that the gap holds, from windows of one flank each, as a damped cascade makes of steps."""

import math
from functools import cache

import pytest

from servotwin.control.cascade import Cascade
from servotwin.estimation import output_error
from servotwin.estimation.estimate import GapEstimate, GapStatus, LastContact
from servotwin.estimation.output_error import OutputErrorSettings
from servotwin.estimation.output_error.flank import OneFlank
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

PITCH, GAP = 0.04 / (2.0 * math.pi), 2e-2  # m/rad, rad
COUNT, COUNTED = 9.6e-5, 6e-7  # rad, m
RATE, HALF_PERIOD, STEPS, AMPLITUDE = 1000.0, 1.2, 4, 3e-3
RATIO = 1.0002  # of the machine over the model
REFUSED = {GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND}


def stage(transmission: Transmission, friction: float = 0.0, grounded: float = 0.0) -> Axis:
    """A stage of 150 kg whose cascade ends no step beyond its target."""
    load = Load((150.0,), (grounded,), (300.0,), friction=friction)
    law = Cascade(12.0, PITCH, velocity_gain=0.38, integral_time=0.033, integral_only=True)
    return Axis(TorqueDrive(J=8e-4, lag=5e-4, friction=2e-3), transmission, load, law, Sensors(COUNT, COUNTED))


AXES = {
    "elastic": stage(Transmission(PITCH, 2e7)),
    "elastic, friction": stage(Transmission(PITCH, 2e7), friction=20.0),
    "hung on a spring": stage(Transmission(PITCH, 2e7), friction=20.0, grounded=4e4),
}


@cache
def windows(name: str) -> tuple[Window, ...]:
    """Windows about steps to and fro but the first, in counts, of a machine that differs from its model."""
    machine = AXES[name].scaled({"k": 1.04, "c": 0.8, "load_friction": 1.1, "p": RATIO})
    reference = SquareWave(AMPLITUDE, 2.0 * HALF_PERIOD)
    run = simulate(machine, STEPS * HALF_PERIOD, reference=reference, gap=GAP, sample_rate=RATE)
    return tuple(Window.from_run(run, step * HALF_PERIOD - 0.05, 0.8) for step in range(1, STEPS))


def estimates(name: str, made: tuple[Window, ...]) -> list[GapEstimate]:
    """Estimates one after the other, each with the contact before."""
    results: list[GapEstimate] = []
    contact: LastContact | None = None
    for window in made:
        results.append(output_error.estimate(window, AXES[name], None, OutputErrorSettings(), before=contact))
        contact = results[-1].contact or contact
    return results


@cache
def steady(name: str) -> list[GapEstimate]:
    return estimates(name, windows(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_steps_to_and_fro_show_the_gap_that_no_step_shows(name: str) -> None:
    first, second, made = steady(name)
    assert first.status in REFUSED
    assert second.status in REFUSED
    assert [each.contact.side for each in (first, second) if each.contact] == [-1.0, 1.0]
    assert made.ok
    assert made.interval[0] <= GAP <= made.interval[1]
    assert made.gap == pytest.approx(GAP, rel=0.02)
    assert made.std_total < 0.08 * GAP


def flank_of(name: str, window: Window) -> OneFlank:
    settings = OutputErrorSettings()
    flank = OneFlank.of(output_error.fit(window, AXES[name], None, settings), settings)
    assert flank is not None
    return flank


@pytest.mark.slow
def test_the_flank_is_where_the_machine_has_it() -> None:
    """With the offset 0: half a gap behind the motor, at either end of its way, where the ratio counts most."""
    for window, side in zip(windows("elastic")[:2], (-1.0, 1.0), strict=True):
        flank = flank_of("elastic", window)
        assert flank.side == side
        for at in flank.drive[[0, -1]]:
            place = flank.at(float(at))
            exact = RATIO * PITCH * (place.at / PITCH - 0.5 * side * GAP)
            assert abs(place.place - exact) <= 2.0 * place.std


@pytest.mark.slow
@pytest.mark.parametrize("share", [-0.7, 0.6])
def test_an_encoder_that_slips_makes_no_false_gap(share: float) -> None:
    """Before the last of three windows: the contact before is that of the two that the slip left alone."""
    *_, last = windows("elastic")
    assert last.theta_m is not None
    slipped = last.replace(theta_m=last.theta_m + share * GAP)
    before = steady("elastic")[1].contact
    assert not output_error.estimate(slipped, AXES["elastic"], None, None, before=before).ok


@pytest.mark.slow
def test_a_rigid_screw_tells_no_flank_because_its_ratio_and_its_delay_act_alike() -> None:
    axis = stage(Transmission(PITCH))
    run = simulate(axis, 2.0, reference=SquareWave(AMPLITUDE, 2.0 * HALF_PERIOD), gap=GAP, sample_rate=RATE)
    made = output_error.estimate(Window.from_run(run, HALF_PERIOD - 0.05, 0.8), axis, None, None)
    assert made.status in REFUSED
    assert made.contact is None


@pytest.mark.slow
def test_a_bound_is_no_wider_than_the_gap_though_the_motor_crosses_it_between_two_samples() -> None:
    """Its speed changes by more than the gap from one sample to the next, and a cubic misses its place at the contact.
    A bound of nine tenths without regard to that was 10 % above the gap."""
    pitch, gap, rate, step = 0.046456, 0.0274, 2360.0, 0.424
    axis = Axis(
        TorqueDrive(J=1.92e-3, friction=0.118),
        Transmission(pitch, 2e6),
        Load((3.46,), (0.0,), (2.6,)),
        Cascade(59.0, pitch, velocity_gain=1.86, speed_filter=5e-4, on="motor", sample_rate=rate),
        Sensors(3.9e-4, 2e-5),
    )
    run = simulate(axis, 2.0 * step, reference=SquareWave(0.218, 2.0 * step), gap=gap, sample_rate=rate)
    made = output_error.estimate(Window.from_run(run, 0.95 * step, 0.5 * step), axis, None, None)
    assert made.status is GapStatus.LOWER_BOUND
    assert 0.4 * gap < made.gap <= gap
