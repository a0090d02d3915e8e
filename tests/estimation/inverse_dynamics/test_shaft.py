"""Resonance, damping and delay of a shaft from two encoders."""

import math
from dataclasses import replace

import numpy as np
import pytest
from drive_recordings import elastic, simulated
from scipy import signal

from servotwin.estimation.inverse_dynamics.conditioning import band_of
from servotwin.estimation.inverse_dynamics.identify import identify_drive
from servotwin.estimation.inverse_dynamics.shaft import shaft_response, split_inertia

LOAD, MOTOR = 12.0, 8.0


@pytest.mark.parametrize(("stiffness", "damping"), [(2e5, 60.0), (2e6, 200.0)])
def test_stiffness_and_inertias_of_an_elastic_axis(stiffness, damping):
    recording = elastic(stiffness, damping)
    shaft = shaft_response(recording)
    assert shaft.resonance == pytest.approx(math.sqrt(stiffness / LOAD) / (2.0 * math.pi), rel=0.005)
    split = split_inertia(recording, band_of(recording), shaft)
    assert split["load_inertia"] == pytest.approx(LOAD, rel=0.03)
    assert split["motor_inertia"] == pytest.approx(MOTOR, rel=0.05)
    assert shaft.stiffness(split["load_inertia"]) == pytest.approx(stiffness, rel=0.03)
    assert shaft.shaft_damping(split["load_inertia"]) == pytest.approx(damping, rel=0.3)
    assert abs(shaft.delay) < 1e-4
    assert shaft.highest > 2.0 * shaft.resonance


def test_a_gap_makes_the_shaft_seem_softer():
    """10 um at the load, of strokes of 120 mm."""
    shaft = shaft_response(elastic(gap=0.01))
    true = math.sqrt(2e5 / LOAD) / (2.0 * math.pi)
    assert 0.94 * true < shaft.resonance < 0.99 * true


@pytest.mark.slow
def test_a_late_encoder_is_told_from_elasticity():
    whole = elastic()
    places = np.arange(whole.load.size)
    late = replace(whole, load=np.interp(places - 3.0, places, whole.load))
    assert shaft_response(late).delay == pytest.approx(3.0 / whole.rate, abs=1e-4)
    assert shaft_response(late).resonance == pytest.approx(shaft_response(whole).resonance, rel=0.01)


def test_a_rigid_axis_shows_no_elasticity():
    whole = simulated(count=1e-8)
    rigid = replace(whole, load=whole.position + 1e-8 * np.random.default_rng(2).standard_normal(whole.position.size))
    shaft = shaft_response(rigid)
    assert shaft.resonance == math.inf
    assert split_inertia(rigid, band_of(rigid), shaft) is None
    assert shaft_response(whole) is None


def test_a_load_that_follows_in_another_way_is_told_so():
    # Of three masses, and of belts that slip, a "resonance" with a damping ratio of 1.6 or -1.7 was taken for a shaft.
    whole = elastic()
    omega, ratio = 2.0 * math.pi * 20.0, 1.6
    law = [2.0 * ratio * omega, omega**2], [1.0, 2.0 * ratio * omega, omega**2]
    above, below, _ = signal.cont2discrete(law, 1.0 / whole.rate, "foh")
    shaft = shaft_response(replace(whole, load=signal.lfilter(np.ravel(above), below, whole.position)))
    assert shaft.resonance == math.inf
    assert math.isnan(shaft.delay)


@pytest.mark.slow
@pytest.mark.parametrize("shake", [0.0, 1e-4])
def test_the_interval_contains_the_inertia_where_the_load_has_an_encoder_too(shake):
    # 11.4 +- 2.5 kg of 20 in the shaken log: an elasticity was looked for behind an only encoder.
    fit = identify_drive([elastic(shake=shake)]).symmetric
    assert abs(fit["inertia"] - LOAD - MOTOR) < fit.half_width("inertia")
