"""A run of an unstable loop ends with the words for it: its motion grows without bound."""

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.axis import Axis
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.simulation.growth import advance_bounded

SENTENCE = r"the loop is unstable: its motion grows without bound.*; the controller .* is unstable on this "
TELESCOPE, PAPER = Axis.preset("telescope"), Servo.preset("paper")


def stiff(plant: Axis | Servo, factor: float, rate: float | None) -> Axis | Servo:
    """The machine with a gain that its loop does not bear, and nothing that limits its command."""
    law = plant.controller
    assert isinstance(law, Controller)
    return plant.replace(controller=law.replace(Kp=factor * law.Kp, voltage_limit=None, sample_rate=rate))


@pytest.mark.parametrize("rate", [None, 1000.0])
@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_an_axis_whose_contacts_are_lost_in_rounding_is_called_unstable(rate: float | None, gap: float) -> None:
    plant = stiff(TELESCOPE, 100.0, rate)
    with pytest.raises(InvalidInput, match=SENTENCE + "axis") as caught:
        simulate(plant, 40.0, reference=SquareWave(0.01, 2.0), gap=gap, sample_rate=1000.0)
    assert isinstance(caught.value, ZenoError)


@pytest.mark.parametrize(("rate", "noise"), [(None, None), (5000.0, None), (5000.0, Noise(1e-6))])
def test_a_servo_whose_position_overflows_is_called_unstable(rate: float | None, noise: Noise | None) -> None:
    with pytest.raises(InvalidInput, match=SENTENCE + "servo"):
        simulate(stiff(PAPER, 30.0, rate), 200.0, reference=SquareWave(1e-3, 20.0), gap=0.01, noise=noise)


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_a_linear_law_is_called_unstable(rate: float | None) -> None:
    drive = Axis.preset("two-mass-drive")
    law = LinearLaw(A=[], B=[], C=[], D=[3e4, 0.0, -3e4], sample_rate=rate, discrete=rate is not None)
    with pytest.raises(InvalidInput, match="the loop is unstable: its motion grows without bound"):
        simulate(drive.replace(controller=law), 400.0, reference=0.1, gap=0.01, sample_rate=1000.0)


def test_modes_that_change_without_end_in_a_stable_loop_keep_their_name() -> None:
    def slides() -> None:
        raise ZenoError("mode changes without end at t = 1 s")

    with pytest.raises(ZenoError, match="without end at t = 1 s") as caught:
        advance_bounded(PAPER, PAPER.controller, slides, lambda: np.zeros(3))
    assert not isinstance(caught.value, InvalidInput)


def test_a_bounded_run_of_an_unstable_loop_is_shown() -> None:
    run = simulate(stiff(TELESCOPE, 100.0, 1000.0), 0.5, reference=0.01, sample_rate=1000.0)
    assert 1.0 < float(np.max(np.abs(run.position))) < np.inf
