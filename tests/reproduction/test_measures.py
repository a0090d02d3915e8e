"""The measures, on synthetic signals whose amplitude, frequency, bias and settling time are known in closed form."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.reproduction import measures

RATE = 1000.0


def grid(duration):
    return np.arange(round(duration * RATE) + 1) / RATE


def test_amplitude_is_half_the_peak_to_peak():
    assert measures.amplitude(np.array([-1.0, 3.0, 2.0])) == 2.0


@given(frequency=st.floats(0.5, 5.0), size=st.floats(1e-6, 1e3), offset=st.floats(-5.0, 5.0), phase=st.floats(0.0, 6.0))
def test_limit_cycle_of_a_sine(frequency, size, offset, phase):
    time = grid(10.0)
    found = measures.limit_cycle(time, size * (offset + np.sin(2 * np.pi * frequency * time + phase)))
    assert found.frequency == pytest.approx(frequency, rel=1e-3)
    assert found.amplitude == pytest.approx(size, rel=1e-3)


def test_no_limit_cycle_in_a_constant():
    found = measures.limit_cycle(grid(1.0), np.full(1001, 3.0))
    assert math.isnan(found.frequency)
    assert found.amplitude == 0.0


@pytest.mark.parametrize(("ratio", "expected"), [(0.99, True), (1.01, False)])
def test_settled_is_decided_at_the_threshold(ratio, expected):
    values = 1e-3 + ratio * measures.SETTLED * 1e-3 * np.sin(2 * np.pi * grid(5.0))
    assert measures.has_settled(values, 1e-3) is expected


@given(rate=st.floats(0.5, 5.0), band=st.floats(0.001, 0.5))
def test_settling_time_of_an_exponential(rate, band):
    time = grid(20.0)
    found = measures.settling_time(time, 1.0 - np.exp(-rate * time), 1.0, band)
    assert found == pytest.approx(-math.log(band) / rate, abs=1e-4 + 2e-4 / rate)


def test_settling_time_counts_from_the_first_sample_and_is_inf_when_never_reached():
    time = 100.0 + grid(2.0)
    assert measures.settling_time(time, np.where(time < 101.0, 1.0, 0.0), 0.0, 0.5) == pytest.approx(1.0, abs=1e-3)
    assert measures.settling_time(time, np.ones_like(time), 0.0, 0.5) == math.inf
    assert measures.settling_time(time, np.zeros_like(time), 0.0, 0.5) == 0.0


def test_upward_crossings_are_interpolated():
    found = measures.upward_crossings(np.array([0.0, 1.0, 2.0, 3.0]), np.array([-1.0, 3.0, -2.0, 2.0]))
    assert found == pytest.approx([0.25, 2.5])


def test_peaks_are_interior():
    assert measures.peaks(np.array([5.0, 1.0, 2.0, 0.0, 3.0, 3.0, 1.0, 9.0])).tolist() == [2, 4]


@pytest.mark.parametrize(("values", "expected"), [([1, 2, 2, 5], True), ([3, 1, 0], True), ([1, 2, 1], False)])
def test_a_sequence_is_monotone_if_it_never_turns(values, expected):
    assert measures.is_monotone(values) is expected


def test_steps_of_a_square_wave():
    """First step: settles with a known bias and time constant; second: a known oscillation about the reference."""
    time = grid(40.0)
    reference = np.where(time < 20.0, 1e-3, -1e-3)
    first = 0.98e-3 * (1.0 - np.exp(-time))
    second = -1e-3 + 0.2e-3 * np.sin(2 * np.pi * 1.6 * time)
    gap = time / 40.0
    one, two = measures.steps(time, np.where(time < 20.0, first, second), reference, gap, measures.Settling(1e-3))
    assert (one.begin, one.end, two.begin, two.end) == pytest.approx((0.0, 20.0, 20.0, 40.0))
    assert (one.reference, two.reference) == (1e-3, -1e-3)
    assert one.settled
    assert not two.settled
    assert one.bias == pytest.approx(0.02e-3, rel=1e-3)
    assert one.settling_time == pytest.approx(math.log(0.98 / 0.02), abs=2e-3)
    assert two.amplitude == pytest.approx(0.2e-3, rel=1e-4)
    assert two.deviation == pytest.approx(0.2e-3 / math.sqrt(2), rel=1e-3)
    assert two.settling_time == math.inf
    assert (one.gap_begin, two.gap_begin, two.gap_end) == pytest.approx((0.0, 0.5, 1.0), abs=1e-3)


def test_the_last_sample_is_not_a_step():
    time = grid(20.0)
    assert len(measures.steps(time, time, np.where(time < 20.0, 1.0, 2.0), time, measures.Settling(1.0))) == 1
