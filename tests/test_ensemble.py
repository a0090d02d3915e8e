"""Ensembles: every member is the run that it would be alone, however many threads share the work."""

import numpy as np
import pytest

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Automaton, Guard, Mode
from servotwin.hybrid.ensemble import run_ensemble
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.servo import Servo
from servotwin.simulation import simulate
from servotwin.simulation.ensemble import simulate_ensemble, simulate_members

DEGREE = np.pi / 180.0
TABLE1 = Servo.preset("table1")


def test_members_are_runs() -> None:
    gaps = np.array([0.0, 0.3, 10.0, 33.0, 60.0])[:, None] * DEGREE
    tolerances = np.array([0.0, 0.7, 2.0]) * TABLE1.tolerance_for(10.0 * DEGREE)
    members = simulate_ensemble(TABLE1, 20.0, reference=1e-3, gap=gaps, tolerance=tolerances, theta_d0=0.02)
    assert members.shape == (5, 3, 2001)
    for i, gap in enumerate(gaps[:, 0].tolist()):
        for j, tolerance in enumerate(tolerances.tolist()):
            options = {"reference": 1e-3, "gap": gap, "tolerance": tolerance, "theta_d0": 0.02}
            alone = simulate(TABLE1, 20.0, sample_rate=100.0, **options).position
            assert np.abs(members[i, j] - alone).max() < 1e-12, (gap, tolerance)


def test_members_with_servos_and_controllers_of_their_own_are_runs() -> None:
    paper, rng = Servo.preset("paper"), np.random.default_rng(3)
    servos = [paper.replace(k=1e4 * rng.uniform(0.85, 1.15), c=36.9 * rng.uniform(0.5, 1.5)) for _ in range(2)]
    laws = [paper.controller, paper.controller.replace(Ki=0.0)]
    gaps, tolerances = np.array([3.0, 12.0]) * DEGREE, [0.0, paper.tolerance_for(10.0 * DEGREE)]
    outputs = simulate_members(
        np.array(servos)[:, None, None, None],
        np.array(laws)[:, None, None],
        5.0,
        reference=1e-3,
        gap=gaps[:, None],
        tolerance=tolerances,
        outputs=("voltage", "theta_m", "position"),
    )
    assert {values.shape for values in outputs.values()} == {(2, 2, 2, 2, 501)}
    for at in np.ndindex(2, 2, 2, 2):
        servo, law, gap, tolerance = (v[i] for v, i in zip((servos, laws, gaps.tolist(), tolerances), at, strict=True))
        options = {"reference": 1e-3, "gap": gap, "tolerance": tolerance or None, "controller": law}
        alone = simulate(servo, 5.0, sample_rate=100.0, **options)
        for name, values in outputs.items():
            expected = getattr(alone, name)
            assert np.abs(values[at] - expected).max() < 1e-9 * np.abs(expected).max(), (at, name)


def test_threads_change_no_bit() -> None:
    gaps = np.linspace(0.0, 40.0, 17) * DEGREE
    one, three = (simulate_ensemble(TABLE1, 5.0, 1e-3, gap=gaps, tolerance=1e-5, threads=k) for k in (1, 3))
    assert np.array_equal(one, three)


def test_wrong_members_are_refused() -> None:
    with pytest.raises(InvalidInput, match="gap"):
        simulate_ensemble(TABLE1, 1.0, gap=[0.1, -0.1])
    with pytest.raises(InvalidInput, match="tolerance"):
        simulate_ensemble(TABLE1, 1.0, tolerance=np.nan)
    with pytest.raises(InvalidInput, match="continuous controller"):
        simulate_ensemble(TABLE1, 1.0, controller=TABLE1.controller.replace(sample_rate=1e3))


def test_a_member_that_slides_is_named() -> None:
    flow = np.array([[0.0, -1.0], [0.0, 0.0]])
    modes = (Mode(flow, (Guard([-1.0, 0.0], 1),), "a"), Mode(-flow, (Guard([1.0, 0.0], 0),), "b"))
    automaton = Automaton(modes, ("x", "one"))
    starts = [[5.0, 1.0], [7.0, 1.0], [0.35, 1.0]]
    with pytest.raises(ZenoError, match=r"\b2\b"):
        run_ensemble(automaton, starts, [0, 0, 0], 0.1, 20, [1.0, 0.0], threads=1)
    with pytest.raises(InvalidInput, match="modes"):
        run_ensemble(automaton, starts, [0, 0, 2], 0.1, 20, [1.0, 0.0])
