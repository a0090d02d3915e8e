"""Ensembles of sampled loops: every member is the run that it would be alone."""

import math
from types import ModuleType

import numpy as np
import pytest
from held_plant import HeldPlant

from servotwin.control import law
from servotwin.errors import InvalidInput
from servotwin.hybrid import automaton
from servotwin.hybrid.buffer_pool import BufferPool
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.plant.stack import sampled_plants
from servotwin.simulation import inputs, sampled_groups, simulate
from servotwin.simulation.sampled_ensemble import SampledCases, simulate_sampled, summarise_sampled

DEGREE = np.pi / 180.0
PAPER = Servo.preset("paper")
LIMITED = PAPER.controller.replace(
    voltage_limit=1.5, rate_limit=20.0, loop_filter_hz=40.0, tracking_time=0.05, enter=0.6, leave=1.4
)
LAWS = (PAPER.controller, LIMITED, PAPER.controller.replace(velocity_feedforward=150.0, notch_hz=4.0))


def test_members_are_runs() -> None:
    servos = np.array([PAPER, PAPER.replace(k=8e3, c=50.0)])[:, None, None]
    stopped = LIMITED.replace(sample_rate=1e3, integral_only=True, Ki=500.0)
    fed = LIMITED.replace(sample_rate=1e3, velocity_feedforward=150.0, notch_hz=4.0)
    others = [PAPER.controller.replace(sample_rate=5e3), LIMITED.replace(sample_rate=1e3)]
    laws = np.array([*others, stopped, fed])[:, None]
    tolerances = np.array([0.0, PAPER.tolerance_for(2.0 * DEGREE)])
    cases = SampledCases(1e-3, 3.0 * DEGREE, tolerances, 0.01, 0.05)
    wave = SquareWave(1.0, 1.0)
    members = simulate_sampled(servos, laws, 2.0, cases, ("error", "voltage", "theta_m"), shape=wave)
    assert members["error"].shape == (2, 4, 2, 201)
    for i, j, k in np.ndindex(2, 4, 2):
        alone = simulate(
            servos[i, 0, 0],
            2.0,
            controller=laws[j, 0],
            reference=SquareWave(1e-3, 1.0),
            gap=3.0 * DEGREE,
            tolerance=float(tolerances[k]) or None,
            theta_d0=0.01,
            input_bias=0.05,
            sample_rate=100.0,
        )
        expected = {"error": alone.reference - alone.position, "voltage": alone.voltage, "theta_m": alone.theta_m}
        for name, values in expected.items():
            assert np.abs(members[name][i, j, k] - values).max() <= 1e-9 * np.abs(values).max(), (i, j, k, name)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("resolution", [0.0, 1e-6])
def test_delayed_members_follow_an_interpreted_loop(delay: int, resolution: float) -> None:
    """The edge's tick on plain floats and an exact plant that shares no code."""
    rate, count, gap, tolerance = 1000.0, 400, 2.0 * DEGREE, PAPER.tolerance_for(1.5 * DEGREE)
    controller = LIMITED.replace(sample_rate=rate)
    plant, parameters, state = HeldPlant(PAPER, gap, 0.0, 1.0 / rate), controller.law(tolerance), law.start(0.0)
    waiting, rows = [0.0] * delay, []
    for _ in range(count):
        measured = plant.state[plant.loop.last]
        if resolution:
            measured = round(measured / resolution) * resolution
        state = law.tick(parameters, state, 1e-3, float(measured))
        waiting.append(state.voltage)
        applied = waiting.pop(0)
        rows.append((plant.state[plant.loop.last], applied))
        plant.step(applied)
    cases = SampledCases(1e-3, gap, tolerance, delay=delay, resolution=resolution)
    found = simulate_sampled(PAPER, controller, 0.4, cases, ("position", "voltage"), sample_rate=rate)
    for values, expected in zip(found.values(), np.array(rows).T, strict=True):
        assert np.abs(values[:-1] - expected).max() < 1e-11 * np.abs(expected).max()
    assert plant.contacts >= 1


def test_figures_are_those_of_the_samples() -> None:
    controller = PAPER.controller.replace(sample_rate=5e3)
    cases = SampledCases(np.array([0.3e-3, 2e-3]), np.array([4.0, 20.0])[:, None] * DEGREE, delay=[1, 2])
    samples = simulate_sampled(PAPER, controller, 3.0, cases)
    figures = summarise_sampled(PAPER, controller, 3.0, cases, 1.0, {"error": 1e-4})
    for name, y in samples.items():
        found, last = figures[name], y[..., -100:]
        assert np.array_equal(found.lowest, y.min(axis=-1))
        assert np.array_equal(found.last_highest, last.max(axis=-1))
        assert np.allclose(found.mean_square, np.mean(y**2, axis=-1), rtol=1e-12)
        assert np.allclose(found.last_mean, last.mean(axis=-1), rtol=1e-12)
    beyond = [[np.flatnonzero(np.abs(y) > 1e-4)[-1] + 1 for y in row] for row in samples["error"]]
    assert np.array_equal(figures["error"].outside, beyond)


@pytest.mark.parametrize("name", ["paper", "robot-joint"])
def test_what_a_room_held_before_changes_no_bit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups of different structures share the memory of their large tables."""
    axis = PAPER if name == "paper" else Axis.preset(name)
    rate = axis.controller.sample_rate or 1e3
    laws = np.array([law.replace(sample_rate=rate, loop_filter_hz=hz) for law in LAWS for hz in (None, 40.0)])
    cases = SampledCases(1e-3, np.array([[1.0], [3.0]]) * DEGREE, [[[0.0]], [[1e-4]]], 0.01, 0.05, delay=1)

    def figures() -> list[bytes]:
        found = summarise_sampled(axis, laws, 1.0, cases, 0.2, sample_rate=100.0, threads=1)
        return [np.asarray(values).tobytes() for each in found.values() for values in each]

    expected = figures()
    monkeypatch.setattr(sampled_groups, "_ROOMS", BufferPool(most=1))
    monkeypatch.setattr(sampled_groups, "zeros", lambda count: np.full(count, math.nan))
    assert figures() == expected


def test_few_plants_are_assembled_once() -> None:
    plants = [PAPER, PAPER.replace(k=8e3)]
    assert sampled_plants(plants, 0, True, False) is sampled_plants(list(plants), 0, True, False)
    assert sampled_plants(plants, 0, True, False) is not sampled_plants(plants, 0, False, False)
    many = [PAPER.replace(k=8e3 + number) for number in range(9)]
    assert sampled_plants(many, 0, True, False) is not sampled_plants(many, 0, True, False)


def test_threads_change_no_bit() -> None:
    controller = PAPER.controller.replace(sample_rate=1e3)
    cases = SampledCases(1e-3, np.linspace(0.0, 20.0, 7) * DEGREE, 1e-5, delay=1)
    one, three = (simulate_sampled(PAPER, controller, 2.0, cases, threads=k)["error"] for k in (1, 3))
    assert np.array_equal(one, three)


@pytest.mark.parametrize("sample_rate", [5e3, 50.0])
def test_the_members_before_change_no_bit(sample_rate: float) -> None:
    """Calm members make tables for the long rests, which later members of the same plant and law find filled."""
    controller = PAPER.controller.replace(sample_rate=5e3, Ki=0.0)
    gaps = np.array([0.0, 10.0, 10.0, 25.0]) * DEGREE
    starts, duration = np.array([0.0, 0.01, -0.03, 0.1]), 20.0

    def errors(which: slice, threads: int) -> np.ndarray:
        cases = SampledCases(1e-3, gaps[which], 2e-5, starts[which], 0.01)
        return simulate_sampled(PAPER, controller, duration, cases, ("error",), sample_rate, threads)["error"]

    together = errors(slice(None), 1)
    for member in range(gaps.size):
        assert np.array_equal(errors(slice(member, member + 1), 1)[0], together[member]), member
    assert np.array_equal(errors(slice(None), 3), together)


@pytest.mark.parametrize(
    ("cases", "options", "message"),
    [
        (SampledCases(gap=-1.0), {}, "gap"),
        (SampledCases(delay=0.5), {}, "delay.*integer of 0 to"),
        (SampledCases(resolution=-1e-6), {}, "resolution.*0 m or more"),
        (SampledCases(), {"outputs": ("current",)}, "no output 'current'"),
        (SampledCases(), {"limits": {"position": 1.0}}, "limits name 'position'"),
        (SampledCases(), {"last": 2.0}, "longer than the run"),
        (SampledCases(), {"sample_rate": 300.0}, "whole multiple"),
        (SampledCases(), {"controllers": PAPER.controller}, "sample_rate"),
    ],
)
def test_what_an_ensemble_refuses(cases: SampledCases, options: dict[str, object], message: str) -> None:
    given = {"controllers": PAPER.controller.replace(sample_rate=1e3), "last": 0.5} | options
    with pytest.raises(InvalidInput, match=message):
        summarise_sampled(PAPER, duration=1.0, cases=cases, **given)


def test_what_members_share_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search simulates hundreds of controllers on the same few machines."""
    counts = dict.fromkeys(("plant_forces", "speeds"), 0)

    def counted(module: ModuleType, name: str) -> None:
        original = getattr(module, name)

        def call(*given: object) -> object:
            counts[name] += 1
            return original(*given)

        monkeypatch.setattr(module, name, call)

    counted(inputs, "plant_forces")
    counted(automaton, "speeds")
    axis = Axis.preset("ball-screw")
    plants = np.array([axis, axis.scaled({"k": 0.97})], dtype=object)[:, None, None]
    for scale in (0.5, 0.6):
        own = axis.pidf
        laws = np.array([own.replace(Kp=scale * own.Kp * more) for more in (1.0, 1.01, 1.02)], dtype=object)[:, None]
        cases = SampledCases(np.linspace(1e-4, 3e-4, 8), 1e-3, 0.0)
        summarise_sampled(plants, laws, 0.01, cases, 0.005, sample_rate=own.sample_rate)
    assert counts["speeds"] == 1
    assert counts["plant_forces"] <= 2 * (len(plants) + 1)
