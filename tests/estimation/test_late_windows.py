"""Windows of encoders whose delay is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import servotwin as st
from servotwin.estimation.late_window import prompt_window
from servotwin.estimation.learning.wear import Wear
from servotwin.plant.plants import prompt_plant
from servotwin.twin.estimating import estimator_of
from servotwin.twin.settings import TwinSettings

AXIS = st.Axis.preset("ball-screw")
RATE = AXIS.controller.sample_rate
assert RATE is not None
LATE = AXIS.replace(sensors=replace(AXIS.sensors, position_delay=2.0 / RATE, encoder_delay=1.0 / RATE))
GAP = 20e-6 / AXIS.p


@pytest.fixture(scope="module")
def window() -> st.Window:
    """Both encoders of a ball screw, late by one and by two samples."""
    run = st.simulate(LATE, 0.8, reference=st.SquareWave(1e-3, 0.4), gap=GAP, sample_rate=RATE)
    return st.Window.from_run(run, 0.02, 0.76)


def test_prompt_windows_hold_what_was_true_at_each_sample(window: st.Window) -> None:
    prompt = prompt_window(window, LATE)
    assert prompt.theta_m is not None
    assert window.theta_m is not None
    assert prompt.samples == window.samples - 2
    assert np.array_equal(prompt.theta_m, window.theta_m[1:-1])
    assert np.array_equal(prompt.position, window.position[2:])
    assert prompt_window(window, AXIS) is window
    assert prompt_plant(LATE) == AXIS
    assert prompt_plant(AXIS) is AXIS


@pytest.mark.slow
def test_a_stated_delay_costs_no_window(window: st.Window) -> None:
    """Where it is not stated, the model leaves motion that friction might explain."""
    told, untold = st.estimate_gap(window, LATE), st.estimate_gap(window, AXIS)
    assert told.ok
    assert told.gap == pytest.approx(GAP, rel=0.01)
    assert told.model_version == LATE.version
    assert not untold.ok


@pytest.mark.slow
def test_the_twin_takes_off_the_same_delay_once(window: st.Window) -> None:
    settings = TwinSettings().on(LATE)
    expected = Wear(settings.initial_gap).expect(settings.trend, "boot", 0.4, 0.4, settings.learning)
    found = estimator_of(LATE, settings)(window, expected)
    assert found.ok
    assert found.gap == pytest.approx(GAP, rel=0.01)
    assert found.model_version == LATE.version


@pytest.mark.slow
def test_the_joint_estimate_knows_the_delay(window: st.Window) -> None:
    (gap,) = st.estimate_jointly(window, LATE).gaps
    assert gap.ok
    assert gap.gap == pytest.approx(GAP, rel=0.01)
