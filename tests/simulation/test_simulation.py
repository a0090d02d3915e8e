"""The resumable simulation: how it is cut does not matter, inputs jump where they should, wrong inputs are refused."""

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave
from servotwin.simulation import Simulation, simulate

DEGREE = np.pi / 180.0
PAPER = Servo.preset("paper")
SAMPLED = PAPER.controller.replace(sample_rate=5000.0)


@examples(25)
@given(
    half=st.sampled_from([0.05, 0.07, 0.1, 0.14, 0.2, 0.3, 0.34]),
    cuts=st.lists(st.integers(1, 4999), max_size=6),
    sampled=st.booleans(),
)
def test_cutting_at_the_jumps_changes_nothing(half: float, cuts: list[int], sampled: bool) -> None:
    """k * half is often a rounding error away from its sample: 0.1 * 3 is; no jump may be lost or taken twice."""
    options = {
        "reference": SquareWave(1e-3, 2.0 * half),
        "gap": SCurve(2.0 * DEGREE, 4.0 * DEGREE, 3.0 * half, half),
        "tolerance": PAPER.tolerance_for(2.0 * DEGREE),
        "controller": SAMPLED if sampled else PAPER.controller,
    }
    whole = Simulation(PAPER, 1.0, **options)
    whole.advance(5000)
    cut = Simulation(PAPER, 1.0, **options)
    at_jumps = [round(half * k * 5000) for k in range(1, int(1.0 / half) + 1)]
    for index in sorted({*cuts, *at_jumps, 5000} - {5001}):
        cut.advance(min(index, 5000))
    one, other = whole.run(), cut.run()
    assert np.abs(one.position - other.position).max() < 1e-13
    assert list(one.events.kind) == list(other.events.kind)


@pytest.mark.parametrize("half", [0.05, 0.07, 0.1, 0.14, 0.3])
def test_inputs_jump_at_their_samples(half: float) -> None:
    """The reference that is reported, the continuous law's voltage and the sampled tick: all at the same sample."""
    reference = SquareWave(1e-3, 2.0 * half)
    for controller in (PAPER.controller, SAMPLED):
        run = simulate(PAPER, 2.0, controller=controller, reference=reference, gap=1.0 * DEGREE)
        for k in range(1, int(2.0 / half)):
            index = round(k * half * 5000)
            change = 2e-3 * (-1.0) ** k
            assert run.reference[index] - run.reference[index - 1] == pytest.approx(change), k
            jump = (PAPER.controller.Kp + PAPER.controller.Kd / PAPER.controller.Tf) * change
            smooth = 2.0 * np.abs(np.diff(run.voltage[index - 6 : index])).max() + 2e-3
            assert abs(run.voltage[index] - run.voltage[index - 1] - jump) < smooth, k


def test_samples_and_times() -> None:
    run = simulate(PAPER, 0.0123, reference=1e-3, sample_rate=1000.0)
    assert run.time.tolist() == [k / 1000.0 for k in range(13)]
    for name in ("position", "theta_m", "theta_d", "voltage", "gap", "tolerance", "reference", "measured_position"):
        assert getattr(run, name).shape == (13,), name
    assert run.q.shape == (13, 3)
    assert np.array_equal(run.q[:, 2], run.q3)
    assert np.abs(run.q[:, 0] - PAPER.p * run.theta_d).max() < 1e-18


def test_events_are_in_order_and_named() -> None:
    gap = PiecewiseCubic.zero_order_hold([0.0, 0.8], [3.0 * DEGREE, 5.0 * DEGREE])
    law = PAPER.controller.replace(voltage_limit=1.0)
    options = {"controller": law, "gap": gap, "tolerance": PAPER.tolerance_for(2.0 * DEGREE)}
    events = simulate(PAPER, 4.0, reference=SquareWave(1e-3, 2.0), **options).events
    assert np.all(np.diff(events.time) >= 0.0)
    kinds = {"contact", "release", "enter", "leave", "saturate", "reference", "parameter"}
    assert set(events.kind) == kinds
    assert events.time[events.kind == "reference"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert events.time[events.kind == "parameter"].tolist() == [0.8]
    assert not events.state_triggered[np.isin(events.kind, ["reference", "parameter"])].any()
    inside = events[np.isin(events.kind, ["enter", "leave"]) & events.state_triggered]
    assert len(inside) > 4


def test_the_error_is_where_the_dead_zone_says() -> None:
    """Inside, the voltage is zero and the error small; outside it is not."""
    tolerance = PAPER.tolerance_for(3.0 * DEGREE)
    law = PAPER.controller.replace(enter=0.5, leave=1.5)
    run = simulate(PAPER, 8.0, controller=law, reference=SquareWave(1e-3, 4.0), gap=3.0 * DEGREE, tolerance=tolerance)
    error = np.abs(run.reference - run.position)
    inside = run.voltage == 0.0
    assert 100 < np.count_nonzero(inside) < len(inside) - 100
    assert error[inside].max() <= 1.5 * tolerance * (1.0 + 1e-9)
    assert error[~inside].min() >= 0.5 * tolerance * (1.0 - 1e-9)


def test_continuous_noise_is_held_and_reproducible() -> None:
    options = {"reference": 1e-3, "gap": 2.0 * DEGREE, "noise": Noise(std=1e-6)}
    one, same, other = (simulate(PAPER, 1.0, seed=seed, **options) for seed in (1, 1, 2))
    assert np.array_equal(one.measured_position, same.measured_position)
    assert not np.array_equal(one.position, other.position)
    assert 0.8e-6 < np.std(one.measured_position - one.position) < 1.2e-6
    cut = Simulation(PAPER, 1.0, seed=1, **options)
    for index in (1, 4096, 4097, 5000):
        cut.advance(index)
    assert np.abs(cut.run().position - one.position).max() < 1e-13


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"gap": -0.1}, r"gap = -0\.1 rad at t = 0 s is negative"),
        ({"gap": PiecewiseCubic([0.0], [[0.1, -0.2, 0.0, 0.0]])}, "gap = .* is negative"),
        ({"tolerance": -1e-6}, "tolerance = -1e-06 m"),
        ({"sample_rate": 0.0}, r"sample_rate = 0\.0 Hz"),
        ({"duration": np.inf}, "duration = inf s"),
        ({"duration": 0.0}, r"duration = 0\.0 s"),
        ({"theta_d0": np.nan}, "theta_d0 = nan rad"),
        ({"reference": "up"}, "'up' is not a signal"),
        ({"reference": np.nan}, "finite"),
        ({"controller": PAPER.controller.replace(rate_limit=1.0)}, "rate_limit needs a sampled controller"),
        ({"controller": SAMPLED, "sample_rate": 3000.0}, "whole multiple"),
    ],
)
def test_wrong_inputs_are_refused(options: dict[str, object], text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        simulate(PAPER, **({"duration": 1.0} | options))


def test_wrong_moves_are_refused() -> None:
    run = Simulation(PAPER, 1.0, reference=1e-3)
    run.advance(100)
    for index in (99, 5001):
        with pytest.raises(InvalidInput, match=rf"sample {index} is outside 100 \.\. 5000"):
            run.advance(index)
    with pytest.raises(InvalidInput, match="has no dead zone"):
        run.set_tolerance(1e-5)
    with pytest.raises(InvalidInput, match=r"samples 0 \.\. 102"):
        run.measured("position", 0, 102)
    zoned = Simulation(PAPER, 1.0, tolerance=0.0)
    with pytest.raises(InvalidInput, match=r"tolerance = -1\.0 m"):
        zoned.set_tolerance(-1.0)


@pytest.mark.parametrize("controller", [PAPER.controller, SAMPLED])
def test_measured_so_far(controller: object) -> None:
    """What a live caller sees at each stop is what the finished run holds."""
    options = {"controller": controller, "reference": SquareWave(1e-3, 0.4), "gap": 2.0 * DEGREE}
    live, whole = Simulation(PAPER, 0.5, **options), simulate(PAPER, 0.5, **options)
    last = 0
    for index in (3, 700, 2500):
        live.advance(index)
        for name in ("theta_m", "position", "voltage", "reference"):
            part = live.measured(name, last, index)
            assert part.shape == (index - last,)
            assert np.abs(part - whole.measured(name)[last:index]).max() <= 1e-13 * np.abs(whole.measured(name)).max()
        last = index
    assert live.time == 0.5


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("rate", [None, 1000.0])
def test_a_gap_that_jumps_shut_hits_the_chain_through_its_damper(rate: float | None, side: float) -> None:
    """The screw is put on its flank at once; the chain answers as G2 does to a step of the screw: the damper's impulse
    sets the second mass moving, at p c / m times the screw's jump."""
    servo, at = Servo.preset("paper"), 0.1
    still = servo.controller.replace(Kp=0.0, Ki=0.0, Kd=0.0, sample_rate=rate)
    gap = PiecewiseCubic([0.0, at], [[10.0 * DEGREE, 0.0, 0.0, 0.0], [2.0 * DEGREE, 0.0, 0.0, 0.0]])
    first, last = side * 4.0 * DEGREE, side * DEGREE
    run = simulate(servo, 0.3, controller=still, gap=gap, theta_d0=first, sample_rate=20_000.0)
    after = run.time >= at
    assert np.all(run.theta_m == 0.0)
    assert run.theta_d[after] == pytest.approx(last, rel=1e-12)
    assert run.position[~after] == pytest.approx(servo.p * first, rel=1e-12)
    answer = servo.p * first + (last - first) * servo.G2().step(run.time[after] - at)
    assert run.position[after] == pytest.approx(answer, rel=1e-9, abs=1e-12)
    speed = (run.q[after][1, 1] - run.q[after][0, 1]) * 20_000.0
    assert speed == pytest.approx(servo.p * (last - first) * servo.c / servo.m, rel=0.02)
