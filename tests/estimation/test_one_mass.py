"""The shaft's simulation for a load of one mass is that for any number of masses, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.estimation.output_error.models import Priors, ShaftModel
from servotwin.estimation.output_error.one_mass import run_one_mass
from servotwin.estimation.output_error.shaft import run_shaft
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.transmission import Transmission


@pytest.mark.parametrize("friction", [0.0, 4.0])
@pytest.mark.parametrize("damping", [0.0, 2.0])
@pytest.mark.parametrize("gains", [(0.0, 0.0), (0.05, 1.0)])
def test_one_mass_moves_as_a_chain_does(friction: float, damping: float, gains: tuple[float, float]) -> None:
    load = Load((5.6,), (0.0,), (0.3,), "rotary", friction, 1.0)
    shaft = Transmission(1.0, 3300.0, damping, in_gap="free")
    axis = Axis(TorqueDrive(J=0.4, lag=1e-3), shaft, load, Controller(60.0, 20.0, 40.0, 0.01))
    model, time = ShaftModel(axis, Priors(0.08, 0.5, 0.05, 0.005, 1e-3)), np.arange(3000) / 1000.0
    drive, measured = 0.1 * np.sin(9.0 * time), 0.08 * np.sin(9.0 * time - 0.3)
    moved = []
    for run in (run_shaft, run_one_mass):
        made = model.prepared(drive, 1e-3, model.start(0.015, 0.0, (0.0, 0.0)))
        motion, sides = np.empty((3, time.size)), np.empty(time.size, dtype=np.int8)
        run(
            made.drive,
            made.parts,
            made.interval,
            made.half,
            *made.matrices,
            measured,
            gains,
            made.friction,
            made.scratch(),
            made.state,
            motion,
            sides,
        )
        moved.append((motion, sides))
    (motion, sides), (other, others) = moved
    assert set(sides.tolist()) == {-1, 0, 1}
    assert np.count_nonzero(np.diff(sides)) > 10
    assert np.array_equal(motion, other)
    assert np.array_equal(sides, others)
