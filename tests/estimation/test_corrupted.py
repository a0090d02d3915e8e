"""Estimates from windows of machines and sensors that are not as assumed; the whole sweep is `bench windows`."""

import math
from itertools import islice

import numpy as np
import pytest
from exploration import extent

from benchmarks import windows as bench
from benchmarks.corrupted import KINDS, corrupted_windows
from servotwin.estimation import whitened
from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.reduced import reduced_response
from servotwin.estimation.core.response import response
from servotwin.estimation.core.variants import variants
from servotwin.estimation.core.whitening import burg
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.learning.machine import LearningSettings, nameplate
from servotwin.estimation.whitened.channels import faults
from servotwin.estimation.whitened.nearby import Neighbour, motions
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo

RATE = 5000.0


@pytest.mark.slow
@pytest.mark.random
@pytest.mark.parametrize("view", [bench.EXACT, bench.UNKNOWN])
def test_no_corrupted_window_gives_a_confident_wrong_gap(view):
    """A window of every kind, every other kind by turns; all, and more, in `make fuzz`. Clean ones are not refused."""
    half = extent(2, 1)
    kinds = {"clean", *list(KINDS)[(view == bench.UNKNOWN) % half :: half]}
    tallies = {kind: bench.counted((view, kind, extent(1, 5), 7)) for kind in sorted(kinds)}
    assert [example for tally in tallies.values() for example in tally.examples] == []
    clean = tallies["clean"]
    assert clean.two_contacts > 0
    assert clean.accepted == clean.two_contacts if view == bench.EXACT else clean.accepted > 0


@pytest.mark.parametrize(
    ("kind", "place", "least_deg"), [("position cyclic 5 um", 10, 2.0), ("position drifts", 17, 20.0)]
)
def test_a_bound_contains_what_sensors_that_are_not_as_assumed_do_to_the_way_to_one_contact(kind, place, least_deg):
    """The first windows of machines that are not known; the bounds were 1.0 and 1.1 deg above the gap."""
    *_, case = islice(corrupted_windows(kind, place + 1, 30130202), place + 1)
    machine = nameplate(LearningSettings(), 0.15, 0.5, 0.1)
    settings = whitened.WhitenedSettings(gap_rate=bench.RATE)
    made = whitened.fit(case.window, case.servo, None, settings, machine).concluded()
    assert made.status is GapStatus.LOWER_BOUND
    assert math.radians(least_deg) < made.gap < case.gap


def softened(servo, compliance, angles):
    """Changes of the position per compliance of the screw."""
    rate, model = RATE, reduced_response(response(servo, RATE), decimation(9))
    stiffness = float(servo.stiffnesses.max())
    (other,) = variants(servo, [np.zeros(4)], rate, [stiffness / compliance])
    shares = np.zeros(2 * (servo.n - 1))
    return motions(model, [Neighbour.of(model, other, compliance, 0)], angles, model.respond(angles)[0], shares)[0]


@pytest.mark.parametrize("masses", [2, 3])
def test_a_soft_screw_changes_the_position_in_proportion_to_its_compliance(masses):
    """Its ringing does not: it would have another pitch for every compliance."""
    servo = Servo.preset("paper").replace(n=masses)
    angles = np.cumsum(np.where(np.arange(5000) < 1500, 2e-3, 0.0))[None]  # an abrupt start and end, as in contacts
    little, more = softened(servo, 0.005, angles), softened(servo, 0.02, angles)
    assert np.linalg.norm(more - little) < 0.06 * np.linalg.norm(little)


def test_decimated_white_noise_is_told_from_coloured_noise():
    rng, reduce = np.random.default_rng(1), decimation(9)
    white = rng.standard_normal(400_000)
    found = burg(reduce.rows(white[None]), 20)
    assert found.unpredicted == pytest.approx(reduce.whiteness, rel=0.02)
    assert decimation(1).whiteness == 1.0


def moving_angle():
    return 2.0 * np.sin(np.linspace(0.0, 7.0, 5000))


def faults_of(angle):
    position = 1e-3 * np.sin(np.linspace(0.5, 7.5, angle.size))
    return faults(Window(position, angle, sample_rate=RATE))


def test_samples_that_were_held_in_full_motion_are_told():
    for first in (100, 1122, 1150, 3000):  # the second and the third lie around a crest
        held = moving_angle()
        held[first : first + 40] = held[first]
        (sentence,) = faults_of(held)
        assert "theta_m repeats one value in full motion" in sentence


def test_a_smooth_stop_and_the_counts_of_an_encoder_are_not_taken_for_held_samples():
    crest = int(np.argmax(moving_angle()[:2000]))  # where the motor has no speed
    start = moving_angle()[: 5000 - crest - 400] * np.linspace(0.0, 1.0, 5000 - crest - 400)
    smooth = np.concatenate([moving_angle()[:crest], np.full(400, 2.0), 2.0 + start])
    for angle in (smooth, *(count * np.round(moving_angle() / count) for count in (1e-4, 1e-2))):
        assert faults_of(angle) == ()


def test_a_motor_that_friction_held_until_its_voltage_stepped_was_not_held_by_its_encoder():
    """A motor that is quicker than a sample moves at once at full speed."""
    angle = np.concatenate([np.full(400, 0.3), 0.3 + np.cumsum(0.002 * np.exp(-np.arange(4600) / 800.0))])
    assert faults_of(angle) == ()


def test_a_spike_is_told_from_noise_and_counts():
    rng = np.random.default_rng(3)
    noisy = moving_angle() + 0.05 * rng.normal(size=5000)
    for angle in (moving_angle(), noisy, 0.05 * np.round(noisy / 0.05), rng.normal(size=5000)):
        assert faults_of(angle) == ()
        spiked = angle.copy()
        spiked[2300] += 20.0 * np.std(angle)
        (sentence,) = faults_of(spiked)
        assert "2300" in sentence
    spiked = moving_angle()
    spiked[2300] -= 0.1  # a small one, no jump of a wrapped encoder
    (sentence,) = faults_of(spiked)
    assert "theta_m leaves its neighbours by" in sentence
    assert "in sample 2300 alone" in sentence


@pytest.mark.parametrize("count", [0.0, 1e-6])
def test_a_position_that_slips_is_told_from_one_that_follows_a_motor_in_one_sample(count):
    """The slip is a hundredth of the motion, and far beyond what the motion does in a sample."""
    angle = moving_angle()
    position = 1e-3 * np.concatenate([np.zeros(20), angle[:-20]])
    rounded = position if count == 0.0 else count * np.round(position / count)
    assert faults(Window(rounded, angle, sample_rate=5000.0)) == ()
    slip = np.where(np.arange(5000) > 2300, 0.01 * np.ptp(position), 0.0)
    (sentence,) = faults(Window(rounded + slip, angle, sample_rate=5000.0))
    assert sentence.startswith("position slips by ")
    assert "between samples 2300 and 2301, and the motor does not" in sentence
    assert faults(Window(rounded + slip, angle + 1e3 * slip, sample_rate=5000.0)) == ()


def test_a_ramp_of_the_gap_is_refused_or_lies_within_the_interval():
    for case in corrupted_windows("ramp of 2 deg/s", 6, 11):
        estimate = estimate_gap(case.window, case.servo)
        assert not estimate.ok or estimate.interval[0] <= case.gap <= estimate.interval[1]
        if estimate.status is GapStatus.LOWER_BOUND:
            assert estimate.gap < case.gap + math.radians(0.1)
