"""Positions that a drive computed from its motor's encoder: never a gap of zero."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.estimation.motors_position import is_motors_position
from servotwin.plant.signals import Array

EMPS = st.Axis.preset("emps")  # rigid, and its controller reads the motor
GAP = 0.4  # rad


@cache
def recorded() -> tuple[st.Window, Array]:
    """Window with the drive's position, and the load's own, m."""
    run = st.simulate(EMPS, 2.0, reference=st.SquareWave(1e-2, 1.0), gap=GAP)
    window = st.Window.from_run(run, 0.45, 1.0)
    first = round(0.45 * run.sample_rate)
    return window, run.position[first : first + window.samples]


def late(position: Array, samples: int) -> Array:
    return np.concatenate([np.full(samples, position[0]), position[:-samples]])


COMPUTED: dict[str, Callable[[Array], Array]] = {
    "as it is": lambda position: position,
    "a sample late": lambda position: late(position, 1),
    "three samples late": lambda position: late(position, 3),
    "held for five samples": lambda position: position[5 * (np.arange(position.size) // 5)],
    "in coarse counts": lambda position: 1e-5 * np.round(position / 1e-5),
    "with another ratio": lambda position: 1.001 * position,
}


@pytest.mark.parametrize("kind", COMPUTED)
def test_a_drives_position_is_the_motors_own(kind: str) -> None:
    window, _ = recorded()
    computed = window.replace(position=COMPUTED[kind](EMPS.p * np.asarray(window.theta_m)))
    assert is_motors_position(computed, EMPS)
    with pytest.raises(InvalidInput, match=r"position follows the motor's angle.*state feedback = \"load\""):
        st.estimate_gap(computed, EMPS)


def test_a_smoothed_position_shows_no_gap_either() -> None:
    window, _ = recorded()
    own = EMPS.p * np.asarray(window.theta_m)
    smoothed = window.replace(position=own[0] + lfilter([0.2], [1.0, -0.8], own - own[0]))
    estimate = st.estimate_gap(smoothed, EMPS)
    assert estimate.status is st.GapStatus.UNIDENTIFIABLE
    assert "position follows the motor's angle" in estimate.reasons[0]


@pytest.mark.parametrize("size", [GAP, 0.1 * GAP, 0.01 * GAP])
def test_the_loads_own_position_shows_the_gap(size: float) -> None:
    run = st.simulate(EMPS, 2.0, reference=st.SquareWave(1e-2, 1.0), gap=size)
    window = st.Window.from_run(run, 0.45, 1.0)
    first = round(0.45 * run.sample_rate)
    own = window.replace(position=run.position[first : first + window.samples])
    assert not is_motors_position(own, EMPS)
    estimate = st.estimate_gap(own, EMPS)
    assert estimate.ok
    assert estimate.gap == pytest.approx(size, rel=0.03)


def test_an_axis_that_says_whose_the_position_is_has_no_gap() -> None:
    window, _ = recorded()
    stiff = window.replace(position=late(EMPS.p * np.asarray(window.theta_m), 1))
    text = EMPS.dumps().replace('feedback = "motor"', 'feedback = "load"').replace('on = "motor"\n', "")
    direct = st.Axis.loads(text, "emps.toml")
    assert not is_motors_position(stiff, direct)
    assert st.estimate_gap(stiff, direct).interval[0] == 0.0
