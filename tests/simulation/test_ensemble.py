"""Ensembles: every member is the run that it would be alone, however many threads share the work."""

import numpy as np
import pytest

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Automaton, Guard, Mode
from servotwin.hybrid.ensemble import Members, run_ensemble, run_family
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic
from servotwin.simulation import simulate
from servotwin.simulation.ensemble import (
    Cases,
    simulate_members,
    summarise_members,
)
from servotwin.simulation.to_and_fro import errors_to_and_fro

DEGREE = np.pi / 180.0
TABLE1 = Servo.preset("table1")


def test_members_are_runs() -> None:
    gaps = np.array([0.0, 0.3, 10.0, 33.0, 60.0])[:, None] * DEGREE
    tolerances = np.array([0.0, 0.7, 2.0]) * TABLE1.tolerance_for(10.0 * DEGREE)
    members = simulate_members(TABLE1, None, 20.0, Cases(1e-3, gaps, tolerances, 0.02), ("position",))["position"]
    assert members.shape == (5, 3, 2001)
    for i, gap in enumerate(gaps[:, 0].tolist()):
        for j, tolerance in enumerate(tolerances.tolist()):
            options = {"reference": 1e-3, "gap": gap, "tolerance": tolerance or None, "theta_d0": 0.02}
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
        Cases(1e-3, gaps[:, None], tolerances),
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


@pytest.mark.parametrize(
    ("plant", "law"),
    [
        ({}, {"feedforward": 0.05}),
        ({}, {"voltage_limit": 3.0, "loop_filter_hz": 40.0, "enter": 0.5, "leave": 1.5}),
        ({"n": 2, "m": 4.0}, {"Ki": 0.0}),
        ({"k_d": 1e6}, {}),
    ],
)
def test_disturbed_members_of_any_structure_are_runs(plant: dict[str, float], law: dict[str, float]) -> None:
    servo = Servo.preset("paper").replace(**plant)
    controller = servo.controller.replace(**law)
    biases, tolerances = [0.0, -0.07], [0.0, servo.tolerance_for(5.0 * DEGREE)]
    frictions = [0.0, 0.05 * servo.k_T / servo.R] if servo.rigid else [0.0]
    members = simulate_members(
        servo,
        controller,
        3.0,
        Cases(-1e-3, 8.0 * DEGREE, tolerances, 0.03, np.array(biases)[:, None], np.array(frictions)[:, None, None]),
        outputs=("error", "voltage"),
    )
    for k, b, t in np.ndindex(len(frictions), 2, 2):
        options = {"reference": -1e-3, "gap": 8.0 * DEGREE, "tolerance": tolerances[t] or None, "theta_d0": 0.03}
        disturbances = {"input_bias": biases[b], "friction": frictions[k]}
        alone = simulate(servo, 3.0, controller=controller, sample_rate=100.0, **options, **disturbances)
        found = members["voltage"][k, b, t], members["error"][k, b, t]
        for values, expected in zip(found, (alone.voltage, alone.channel("error", 0, 301)), strict=True):
            assert np.abs(values - expected).max() < 1e-9 * np.abs(expected).max(), (k, b, t)


def test_figures_are_those_of_the_samples() -> None:
    paper, rng = Servo.preset("paper"), np.random.default_rng(5)
    servos = np.array([paper.replace(k=1e4 * rng.uniform(0.85, 1.15)) for _ in range(5)])[:, None]
    cases = Cases(np.array([0.3e-3, 2e-3]), np.array([4.0, 20.0]) * DEGREE, np.array([0.0, 1e-5]))
    samples = simulate_members(servos, None, 6.0, cases, outputs=("error", "theta_m"))
    figures = summarise_members(servos, None, 6.0, cases, 2.0, {"error": 1e-4}, outputs=("error", "theta_m"))
    for name, y in samples.items():
        found, last = figures[name], y[..., -200:]
        expected = {
            "lowest": y.min(axis=-1),
            "highest": y.max(axis=-1),
            "mean": y.mean(axis=-1),
            "mean_square": np.mean(y**2, axis=-1),
            "mean_size": np.abs(y).mean(axis=-1),
            "travel": np.abs(np.diff(y)).sum(axis=-1),
            "last_lowest": last.min(axis=-1),
            "last_highest": last.max(axis=-1),
            "last_mean": last.mean(axis=-1),
            "last_mean_square": np.mean(last**2, axis=-1),
        }
        for figure, value in expected.items():
            assert np.allclose(getattr(found, figure), value, rtol=1e-10, atol=1e-18), (name, figure)
        assert found.lowest.shape == (5, 2)
    beyond = [[np.flatnonzero(np.abs(y) > 1e-4)[-1] + 1 for y in row] for row in samples["error"]]
    assert np.array_equal(figures["error"].outside, beyond)
    assert not figures["theta_m"].outside.any()


def test_threads_change_no_bit() -> None:
    gaps = np.linspace(0.0, 40.0, 17) * DEGREE
    cases = Cases(1e-3, gaps, 1e-5)
    one, three = (simulate_members(TABLE1, None, 5.0, cases, threads=k)["error"] for k in (1, 3))
    assert np.array_equal(one, three)


def test_wrong_members_are_refused() -> None:
    with pytest.raises(InvalidInput, match="gap"):
        simulate_members(TABLE1, None, 1.0, Cases(gap=[0.1, -0.1]))
    with pytest.raises(InvalidInput, match="tolerance"):
        simulate_members(TABLE1, None, 1.0, Cases(tolerance=np.nan))
    with pytest.raises(InvalidInput, match="continuous controller"):
        simulate_members(TABLE1, TABLE1.controller.replace(sample_rate=1e3), 1.0, Cases())
    with pytest.raises(InvalidInput, match="friction"):
        simulate_members(TABLE1, None, 1.0, Cases(friction=-0.1))
    with pytest.raises(InvalidInput, match="no output 'speed'"):
        simulate_members(TABLE1, None, 1.0, Cases(), outputs=("speed",))
    with pytest.raises(InvalidInput, match="limits name 'voltage'"):
        summarise_members(TABLE1, None, 1.0, Cases(), 0.5, {"voltage": 1.0}, outputs=("error",))
    with pytest.raises(InvalidInput, match="last 201 of 101"):
        summarise_members(TABLE1, None, 1.0, Cases(), 2.01)


def test_a_member_that_slides_is_named() -> None:
    flow = np.array([[0.0, -1.0], [0.0, 0.0]])
    modes = (Mode(flow, (Guard([-1.0, 0.0], 1),), "a"), Mode(-flow, (Guard([1.0, 0.0], 0),), "b"))
    automaton = Automaton(modes, ("x", "one"))
    starts = [[5.0, 1.0], [7.0, 1.0], [0.35, 1.0]]
    with pytest.raises(ZenoError, match=r"\b2\b"):
        run_ensemble(automaton, starts, [0, 0, 0], 0.1, 20, [1.0, 0.0], threads=1)
    with pytest.raises(InvalidInput, match="modes"):
        run_ensemble(automaton, starts, [0, 0, 2], 0.1, 20, [1.0, 0.0])


def test_a_family_has_one_structure() -> None:
    down, up = (Automaton((Mode([[0.0]], (Guard([sign], 0),)),), ("x",)) for sign in (-1.0, 1.0))
    members = Members(np.array([0, 1]), np.array([0, 0]), np.array([[1.0], [-1.0]]))
    traces, _ = run_family((down, up), np.ones((2, 1, 1, 1)), members, 0.1, 3)
    assert np.array_equal(traces[:, 0], [[1.0] * 3, [-1.0] * 3])
    with pytest.raises(InvalidInput, match="same states"):
        run_family((down, Automaton((Mode([[0.0]]),), ("x",))), np.ones((2, 1, 1, 1)), members, 0.1, 3)
    with pytest.raises(InvalidInput, match="automaton of 0 to 0"):
        run_family((down,), np.ones((1, 1, 1, 1)), members, 0.1, 3)


@pytest.mark.parametrize("seed", range(6))
def test_moves_to_and_fro_are_those_of_one_run(seed: int) -> None:
    """An elastic screw, integral action that stops, saturation, friction and bias, each in some of the cases."""
    rng = np.random.default_rng(seed)
    servo = Servo.preset(("paper", "table1")[seed % 2])
    servo = servo.replace(k_d=20.0 * float(servo.stiffnesses.max())) if seed == 1 else servo
    scale, stops = rng.uniform(0.6, 1.2), seed in (2, 3)
    law = servo.controller.replace(Kp=scale * servo.controller.Kp, Kd=scale * servo.controller.Kd, Ki=0.0)
    law = law.replace(Ki=0.02 * servo.controller.Ki, integral_only=True, leave=2.0) if stops else law
    law = law.replace(voltage_limit=0.5) if seed == 4 else law
    size, gap, tolerance = rng.uniform(1e-4, 2e-3), rng.uniform(0.0, 0.6), 2e-5 if stops else 0.0
    friction, bias = 0.05 * servo.k_T / servo.R if seed in (3, 5) else 0.0, rng.uniform(-0.05, 0.05)
    found = errors_to_and_fro(servo, law, 10.0, Cases(size, gap, tolerance, 0.0, bias, friction), 2, 200.0)
    run = simulate(
        servo,
        30.0,
        controller=law,
        reference=PiecewiseCubic.zero_order_hold([0.0, 10.0, 20.0], [size, 0.0, size]),
        gap=gap,
        tolerance=tolerance or None,
        theta_d0=0.0,
        sample_rate=200.0,
        input_bias=bias,
        friction=friction,
    )
    back, forth = np.abs(run.position[2000:4001]), np.abs(size - run.position[4000:])
    assert found == pytest.approx(0.5 * (back.mean() + forth.mean()), rel=1e-5 if friction else 1e-12)
