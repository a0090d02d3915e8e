"""Moves of a few counts of the motor's encoder: the model is exact, and the motion is too small to tell."""

import pytest

from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate


def estimate(amplitude: float, gap: float, stiffness: float = 1.0) -> GapEstimate:
    """Of the two-mass drive's step between two places, rad, with one count of 1.5 mrad at the motor."""
    axis = Axis.preset("two-mass-drive")
    machine = axis.scaled({"k": stiffness})
    run = simulate(machine, 36.0, reference=SquareWave(amplitude, 60.0), gap=gap, sample_rate=2000.0)
    return estimate_gap(Window.from_run(run, 29.5, 5.0), axis)


@pytest.mark.parametrize("amplitude", [1e-3, 5e-3])
def test_a_motion_of_few_counts_is_too_small_and_no_mismatch(amplitude: float) -> None:
    found = estimate(amplitude, 2e-3)
    assert found.status is GapStatus.UNIDENTIFIABLE
    assert "counts of the coarser encoder" in found.reasons[0]
    assert found.reasons[0].endswith("larger moves are needed")


def test_counts_that_make_a_softer_shaft_likelier_are_no_mismatch() -> None:
    found = estimate(7e-3, 5e-3)
    assert found.status is GapStatus.UNIDENTIFIABLE
    assert "times softer than the stated one" in found.reasons[0]
    assert "rounding may be all that the model leaves" in found.reasons[1]
