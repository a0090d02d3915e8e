"""Axes made of parts in other units: the same motion, the same gap and the same interval, to the last bits."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from exploration import explored
from scaling import AxisUnits, scaled_axis

from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.joint.estimator import estimate_jointly
from servotwin.estimation.joint.verdict import JointEstimate
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.signals import SquareWave
from servotwin.simulation import Run, simulate

# Presets with a gap (m at the load), half a period of steps to and fro (s), and their size (m).
MOVES = {"ball-screw": (25e-6, 0.4, 3e-4), "micro-positioner": (1e-6, 3.0, 1.2e-5)}
# Powers of two, with which the simulation differs by rounding of exponentials only.
UNITS = explored(
    [
        AxisUnits(time=2.0**-10),
        AxisUnits(time=2.0**10),
        AxisUnits(length=2.0**-20),
        AxisUnits(length=2.0**20),
        AxisUnits(torque=2.0**-20),
        AxisUnits(voltage=2.0**7),
        AxisUnits(2.0**-6, 2.0**-9, 2.0**-12, 2.0**4),
    ],
    *(0, 2, 6),
)


@cache
def estimated(name: str, units: AxisUnits) -> tuple[Run, GapEstimate]:
    """Two steps to and fro, and the gap of the second one's window."""
    gap, half, size = MOVES[name]
    axis, half, size = scaled_axis(Axis.preset(name), units), half * units.time, size * units.length
    run = simulate(
        axis,
        4.0 * half,
        reference=SquareWave(size, 2.0 * half),
        gap=gap / Axis.preset(name).p,
        sample_rate=axis.controller.sample_rate or 1.0,
    )
    return run, estimate_gap(Window.from_run(run, half, 2.0 * half), axis)


@cache
def estimated_jointly(name: str, units: AxisUnits) -> JointEstimate:
    """The gap and the other numbers of the second step's window."""
    (run, _), half = estimated(name, units), MOVES[name][1] * units.time
    return estimate_jointly(Window.from_run(run, half, 2.0 * half), scaled_axis(Axis.preset(name), units))


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("units", UNITS)
def test_an_axis_in_other_units_moves_and_is_estimated_alike(name: str, units: AxisUnits) -> None:
    (here, gap), (there, other) = estimated(name, AxisUnits()), estimated(name, units)
    size = np.ptp(here.position)
    assert np.abs(there.position / units.length - here.position).max() < 1e-9 * size
    assert np.array_equal(np.diff(there.theta_m) > 0.0, np.diff(here.theta_m) > 0.0)
    assert other.status is gap.status
    assert gap.ok
    assert other.gap == pytest.approx(gap.gap, rel=1e-6)
    assert other.std_total == pytest.approx(gap.std_total, rel=1e-5)
    assert gap.gap == pytest.approx(MOVES[name][0] / Axis.preset(name).p, rel=0.01)
    assert math.isfinite(gap.std_total)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("units", UNITS)
def test_an_axis_in_other_units_has_the_same_numbers(name: str, units: AxisUnits) -> None:
    first, second = estimated_jointly(name, AxisUnits()), estimated_jointly(name, units)
    assert second.gap.status is first.gap.status
    assert second.gap.gap == pytest.approx(first.gap.gap, rel=1e-6)
    assert second.gap.std == pytest.approx(first.gap.std, rel=1e-3)
    for number, one in first.parameters.items():
        other = second.parameters[number]
        if not math.isnan(one.factor):
            assert other.factor == pytest.approx(one.factor, rel=1e-5)
            assert other.std / other.value == pytest.approx(one.std / one.value, rel=1e-2)
