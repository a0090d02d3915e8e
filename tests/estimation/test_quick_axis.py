"""The quick fit of an axis's window beside another one: it tells a gap that moved from one that did not."""

import math
from functools import cache

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.output_error.estimator import problem_of
from servotwin.estimation.output_error.quick import quick_fit, unknowns_at
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate
from servotwin.twin.estimating import known_machine
from servotwin.twin.settings import TwinSettings

LAW = Controller(Kp=60.0, Ki=20.0, Kd=40.0, Tf=0.01)
SHAFT = Axis(
    TorqueDrive(J=0.4, lag=1e-3, friction=0.05),
    Transmission(p=1.0, k_d=3300.0, c_d=20.0, in_gap="free"),
    Load((5.6,), (0.0,), (0.3,), "rotary"),
    LAW,
)
HELD_BY_FRICTION = SHAFT.replace(load=Load((5.6,), (0.0,), (0.3,), "rotary", friction=0.5))
TWO_MASSES = SHAFT.replace(load=Load((4.0, 1.6), (0.0, 9000.0), (0.3, 2.0), "rotary"))
STAGE = Axis(
    VelocityDrive(5e-3),
    Transmission(5e-3 / (2.0 * math.pi)),
    Load((20.0,)),
    Controller(3e4, 1e4, 0.0, 0.1),
    Sensors(position_resolution=1e-8),
)
NOISE = 2e-5
MACHINES = {"shaft": SHAFT, "friction": HELD_BY_FRICTION, "two masses": TWO_MASSES}


@cache
def window(name: str, gap: float, number: int, k: float = 1.0) -> Window:
    """Three seconds of a machine whose shaft is `k` times as stiff as its model's, each from another instant on."""
    model = MACHINES[name]
    machine = model.replace(transmission=Transmission(1.0, 3300.0 * k, 20.0, "free"))
    run = simulate(machine, 8.0, reference=SquareWave(0.2, 4.0), gap=gap, sample_rate=1000.0)
    first = 1300 + 700 * number
    noise = NOISE * np.random.default_rng(number).normal(size=3000)
    part = slice(first, first + 3000)
    return Window(run.position[part] + noise, run.theta_m[part], sample_rate=1000.0, start=10.0 * number)


@cache
def beside(name: str, gap: float, k: float = 1.0) -> np.ndarray:
    return unknowns_at(window(name, gap, 0, k), MACHINES[name], gap)


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("number", [1, 2, 3])
def test_it_finds_the_gap_of_another_window(name: str, number: int) -> None:
    found = quick_fit(window(name, 0.03, number), MACHINES[name], beside(name, 0.03))
    assert found.converged
    assert abs(found.gap - 0.03) < 3.0 * found.std
    assert found.std < 0.005 * 0.03
    assert found.misfit == pytest.approx(NOISE, rel=0.1)


@pytest.mark.parametrize("moved", [-0.1, -0.02, 0.02, 0.1])
def test_it_finds_a_gap_that_moved(moved: float) -> None:
    gap = 0.03 * (1.0 + moved)
    found = quick_fit(window("shaft", gap, 1), SHAFT, beside("shaft", 0.03))
    assert abs(found.gap - gap) < 3.0 * found.std < 0.5 * abs(gap - 0.03)


@pytest.mark.parametrize("k", [0.95, 1.05])
def test_what_the_shaft_is_off_its_model_is_taken_from_the_other_window(k: float) -> None:
    found = quick_fit(window("shaft", 0.03, 2, k), SHAFT, beside("shaft", 0.03, k))
    assert abs(found.gap - 0.03) < 0.005 * 0.03
    assert found.misfit < 1.2 * NOISE
    other = quick_fit(window("shaft", 0.03, 2, k), SHAFT, beside("shaft", 0.03))
    assert other.misfit > 2.0 * NOISE  # a shaft of which the other window knew nothing is no machine of this one


def test_a_learnt_shaft_counts() -> None:
    """Its numbers stand in place of the model's, for both windows."""
    new = known_machine(SHAFT, TwinSettings(policy="paper"))
    assert new is not None
    learnt = FactorPrior(new.mean + np.log([1.05, 1.0, 1.0, 1.0]), new.covariance / 100.0, new.softness)
    values = unknowns_at(window("shaft", 0.03, 0, 1.05), SHAFT, 0.03, learnt)
    found = quick_fit(window("shaft", 0.03, 1, 1.05), SHAFT, values, learnt)
    assert abs(found.gap - 0.03) < 0.005 * 0.03
    shaft = [each.name for each in problem_of(window("shaft", 0.03, 1), SHAFT, learnt)[0].model.unknowns]
    assert abs(values[shaft.index("shaft stiffness")]) < 0.01


def test_a_window_without_a_move_shows_nothing() -> None:
    still = window("friction", 0.03, 1)
    rest = Window(
        0.1 + NOISE * np.random.default_rng(9).normal(size=3000), np.full(3000, 0.1), sample_rate=1000.0, start=0.0
    )
    found = quick_fit(rest, HELD_BY_FRICTION, beside("friction", 0.03))
    assert not found.noise_std < 0.1 * 0.03
    assert found.std > quick_fit(still, HELD_BY_FRICTION, beside("friction", 0.03)).std


@pytest.mark.parametrize("moved", [0.0, 0.1])
def test_one_mass_on_a_rigid_screw(moved: float) -> None:
    p, time = STAGE.p, np.arange(4000) / 1000.0

    def seen(at_load: float, phase: float) -> Window:
        angle = 3.0 * at_load / p * np.sin(2.0 * math.pi * 0.7 * time + phase)
        place = p * play(angle, at_load / p, angle[0])
        return Window(np.round((place + 1e-3) / 1e-8) * 1e-8, angle, sample_rate=1000.0)

    gap = 2e-6 * (1.0 + moved)
    values = unknowns_at(seen(2e-6, 0.3), STAGE, 2e-6 / p)
    found = quick_fit(seen(gap, 1.9), STAGE, values)
    assert abs(found.gap - gap / p) < found.std < 0.01 * gap / p
    # Half a count of the encoder at the load, and 0.2 % of the gap.
    assert found.least == pytest.approx(math.hypot(0.5e-8, 0.002 * gap) / p, rel=0.2)


def test_unknowns_of_another_model_are_refused() -> None:
    with pytest.raises(InvalidInput, match="beside 9 unknowns, and the model has 13"):
        quick_fit(window("two masses", 0.03, 1), TWO_MASSES, beside("shaft", 0.03))
