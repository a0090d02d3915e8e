"""A motor at rest on a flank of the gap: two modes must agree whether it leaves, at the limit of rounding."""

from __future__ import annotations

import numpy as np
import pytest

from servotwin.hybrid.crossing import rounding, series
from servotwin.hybrid.kernel import follow_schedule
from servotwin.hybrid.tables import TERMS
from servotwin.hybrid.trajectory import schedule_of
from servotwin.plant.servo import Servo
from servotwin.simulation import Simulation
from servotwin.simulation.sampled import SampledEngine

_OPEN, _CONTACT = 1, 2
_GAP = 0.125


def _at_rest(bias: float) -> tuple[SampledEngine, np.ndarray, int]:
    """Engine of a sampled loop, its state at rest on a flank under a voltage that cancels a bias (V), and the place of
    the voltage."""
    servo = Servo.preset("paper")
    law = servo.controller.replace(sample_rate=1000.0)
    simulation = Simulation(servo, 1.0, controller=law, gap=_GAP, input_bias=bias, sample_rate=1000.0)
    engine = simulation.engine
    assert isinstance(engine, SampledEngine)
    automaton, x = engine.plant.automaton, np.zeros(len(engine.state))
    for name, value in {"theta_m": 0.5 * _GAP, "voltage": -bias, "gap": _GAP, "input bias": bias}.items():
        x[automaton.index(name)] = value
    return engine, x, automaton.index("voltage")


def _after_a_step(engine: SampledEngine, x: np.ndarray, mode: int) -> int:
    """Mode after one search step; -1: none admits flow.

    From Python nobody else calls `cross`, which would be compiled once more for it. The kernel that all tests compile
    calls it at once where a step does not begin on the grid, for whose steps it has tables.
    """
    engine.record.size[:] = 0
    at, jumps = np.array([0, mode, 0, 0]), schedule_of([], engine.step, engine.plant.automaton, 1)
    follow_schedule(engine.tables, x, np.array([1e-300]), at, *jumps, engine.record, engine.scratch)
    return int(at[1])


@pytest.mark.slow
def test_a_rest_at_the_limit_of_rounding_ends_in_one_mode() -> None:
    """Where the first derivative that is not zero is as large as its rounding and the next one has the other sign,
    modes that read different ones would take turns without end."""
    random, ends = np.random.default_rng(2), list[int]()
    for bias in random.uniform(0.01, 0.03, 60):
        engine, x, voltage = _at_rest(bias)
        t, c = engine.tables, np.zeros(TERMS)
        x[voltage] = -bias - 1e-12
        series(t, _OPEN, 0, x, 1.0, c)
        order = int(np.argmax(np.abs(c) > 0.0))
        assert c[order] < 0.0 < c[order + 1]
        x[voltage] = -bias - 1e-12 * rounding(t, _OPEN, 0, order, x) / -c[order]
        for _ in range(12):
            ends.append(_after_a_step(engine, x.copy(), _CONTACT))
            x[voltage] = np.nextafter(x[voltage], random.choice((-1.0, 1.0)))
    assert set(ends) <= {_OPEN, _CONTACT}
