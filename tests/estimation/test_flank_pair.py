"""The gap of a free shaft whose load friction alone slows down: two windows of one flank each, on opposite sides."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from servotwin.control.cascade import Cascade
from servotwin.estimation import output_error
from servotwin.estimation.estimate import GapBetween, GapEstimate, GapStatus, LastContact
from servotwin.estimation.output_error import OutputErrorSettings
from servotwin.estimation.output_error.flank import OneFlank
from servotwin.estimation.two_contacts import SUDDEN, confirmed_gap, followed, unconfirmed
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

PITCH, GAP = 0.04 / (2.0 * math.pi), 4.7e-3  # m/rad, rad: 30 um at the load
COUNT, COUNTED = 9.6e-5, 1e-6  # rad, m
# A rack drive under a well damped cascade: no step ends beyond its target.
RACK = Axis(
    TorqueDrive(J=8e-4, lag=5e-4, friction=2e-3),
    Transmission(PITCH, 2e7, 4e3, "free"),
    Load((150.0,), (0.0,), (300.0,), friction=60.0),
    Cascade(5.0, PITCH, velocity_gain=0.38, integral_time=0.033, integral_only=True),
    Sensors(COUNT, COUNTED),
)
RATE, HALF_PERIOD, STEPS = 2000.0, 2.0, 5
REFUSED = {GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND}


@cache
def windows(grown: float = 0.0, amplitude: float = 5e-3) -> tuple[Window, ...]:
    """Windows about steps to and fro but the first, in counts; `grown`: growth of the gap until the end, rad."""
    duration = STEPS * HALF_PERIOD
    machine = RACK.scaled({"k": 1.04, "c": 0.8, "k_B": 1.1, "p": 1.003, "load_friction": 1.1})
    reference, gap = SquareWave(amplitude, 2.0 * HALF_PERIOD), SCurve(GAP, GAP + grown, duration) if grown else GAP
    run = simulate(machine, duration, reference=reference, gap=gap, sample_rate=RATE, tolerance=1e-4)
    made = (Window.from_run(run, step * HALF_PERIOD - 0.02, 0.3) for step in range(1, STEPS))
    return tuple(
        each.replace(
            position=np.round(each.position / COUNTED) * COUNTED, theta_m=np.round(each.theta_m / COUNT) * COUNT
        )
        for each in made
    )


def estimates(made: tuple[Window, ...], gap_rate: float = 0.0, before: Sequence[GapEstimate] = ()) -> list[GapEstimate]:
    """Estimates one after the other, each with the contact before; `gap_rate`: assumed growth, rad/s; `before`: those
    of the first windows, made already."""
    results = list(before)
    contact: LastContact | None = next((each.contact for each in reversed(results) if each.contact), None)
    for window in made[len(results) :]:
        settings = OutputErrorSettings(gap_rate=gap_rate)
        results.append(output_error.estimate(window, RACK, None, settings, before=contact))
        contact = results[-1].contact or contact
    return results


@cache
def steady() -> list[GapEstimate]:
    return estimates(windows())


def slipped(made: tuple[Window, ...], first: int, slip: float) -> tuple[Window, ...]:
    """With a motor's encoder that slips by `slip` (rad) before the window `first`."""
    return (*made[:first], *(each.replace(theta_m=each.theta_m + slip) for each in made[first:]))


def one_flank(window: Window) -> OneFlank:
    settings = OutputErrorSettings()
    flank = OneFlank.of(output_error.fit(window, RACK, None, settings), settings)
    assert flank is not None
    return flank


@pytest.mark.slow
def test_two_windows_show_the_gap_of_a_load_that_friction_stops_and_a_third_confirms_it() -> None:
    first, second, *later = steady()
    assert first.status in REFUSED
    assert second.status in REFUSED
    assert [each.contact.side for each in steady() if each.contact] == [-1.0, 1.0, -1.0, 1.0]
    assert first.contact is not None
    assert first.contact.between is None
    assert second.contact is not None
    assert second.contact.between is not None
    assert second.contact.between.gap == pytest.approx(GAP, abs=2.0 * COUNTED / PITCH)
    assert "another window must confirm it" in second.reasons[-1]
    for place, made in enumerate(later):
        assert made.ok
        assert made.gap == pytest.approx(GAP, abs=2.0 * COUNTED / PITCH)
        assert made.interval[0] <= GAP <= made.interval[1]
        assert made.time == pytest.approx((place + 3.0) * HALF_PERIOD + 0.13, abs=0.001)


@pytest.mark.slow
def test_the_flank_is_where_the_machine_has_it() -> None:
    """With the offset 0: half a gap behind the motor."""
    machine = 1.003 * PITCH
    for window, side in zip(windows()[:2], (-1.0, 1.0), strict=True):
        flank = one_flank(window)
        place = flank.at(float(flank.drive[-1]))
        exact = machine * (place.at / PITCH - 0.5 * side * GAP)
        assert flank.side == side
        assert abs(place.place - exact) <= 2.0 * place.std
        assert place.std < 2e-6


@pytest.mark.slow
def test_encoders_that_count_from_elsewhere_show_the_same_gap() -> None:
    moved = tuple(
        each.replace(theta_m=each.theta_m + 5000 * COUNT, position=each.position - 700 * COUNTED) for each in windows()
    )
    for made, usual in zip(estimates(moved[:3]), steady(), strict=False):
        assert made.status is usual.status
        assert made.gap == pytest.approx(usual.gap, rel=1e-2, nan_ok=True)


@pytest.mark.slow
@pytest.mark.parametrize("share", [-0.7, 0.6, 2.0])
def test_an_encoder_that_slips_makes_no_false_gap(share: float) -> None:
    for first in (1, 2):
        results = estimates(slipped(windows(), first, share * GAP)[:3], before=steady()[:first])
        assert all(each.interval[0] <= GAP <= each.interval[1] for each in results if each.ok)
        assert not (first == 2 and results[2].ok)


@pytest.mark.slow
def test_a_gap_that_grows_as_it_may_is_confirmed() -> None:
    grown = 0.3 * GAP
    *_, made = estimates(windows(grown)[:3], gap_rate=2.0 * grown / (STEPS * HALF_PERIOD))
    exact = SCurve(GAP, GAP + grown, STEPS * HALF_PERIOD)
    truth = float(exact.pieces(STEPS * HALF_PERIOD).value(made.time))
    assert made.ok
    assert made.interval[0] <= truth <= made.interval[1]
    assert estimates(windows(grown)[:3])[2].std > 0.0


@pytest.mark.slow
def test_a_second_window_of_the_same_side_keeps_what_was_shown_before() -> None:
    contact = steady()[1].contact
    assert contact is not None
    made = output_error.estimate(windows()[3], RACK, None, None, before=contact)
    assert made.status in REFUSED
    assert made.contact is not None
    assert made.contact.side == contact.side
    assert made.contact.between == contact.between


def test_a_gap_is_confirmed_within_its_spread_and_growth() -> None:
    earlier, now = GapBetween(1.0, 0.1, 0.0), GapBetween(1.3, 0.1, 2.0)
    assert followed(now, earlier).rate == pytest.approx(0.15)
    assert not unconfirmed(now, earlier, 0.0)
    assert unconfirmed(replace(now, gap=1.6), earlier, 0.1)
    assert not unconfirmed(replace(now, gap=1.6), earlier, 0.3)
    assert unconfirmed(replace(now, gap=0.5), earlier, 1.0)
    # All of a sudden growth is within the interval.
    gap, std = confirmed_gap(now, earlier, now.time, 0.0)
    assert gap == now.gap
    assert 1.96 * std > 0.3


def test_steady_growth_goes_on_until_the_window() -> None:
    """Exactly where both gaps are; not at all where none is expected."""
    earlier, now = GapBetween(1.0, 1e-6, 0.0, 0.15), GapBetween(1.3, 1e-6, 2.0, 0.15)
    gap, std = confirmed_gap(now, earlier, 3.0, 0.1)
    assert gap == pytest.approx(1.45, abs=1e-9)
    assert std <= 3e-6
    assert confirmed_gap(now, earlier, 3.0, 0.0)[0] == now.gap


def test_the_spread_of_a_gap_carried_to_the_window_is_that_of_many_draws() -> None:
    """Noise of both gaps hides half of a growth of 0.3 rad/s, root mean square."""
    rng, rate = np.random.default_rng(1), 0.3
    errors = []
    for growth, early, late in rng.normal(0.0, (rate, 0.5, 0.3), (20_000, 3)):
        earlier, now = GapBetween(early, 0.5, 0.0), GapBetween(2.0 * growth + late, 0.3, 2.0)
        errors.append(confirmed_gap(now, earlier, 3.5, rate)[0] - 3.5 * growth)
    steady = GapBetween(0.0, 0.5, 0.0, 0.3), GapBetween(0.6, 0.3, 2.0, 0.3)
    std = confirmed_gap(steady[1], steady[0], 3.5, rate)[1]
    assert math.sqrt(std**2 - (SUDDEN * 0.5) ** 2) == pytest.approx(np.std(errors), rel=0.02)
