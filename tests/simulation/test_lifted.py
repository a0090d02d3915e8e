"""Sampled loops in blocks of ticks: the same runs as tick by tick, and nothing missed."""

from typing import Any

import numpy as np
import pytest
from exploration import explored, extent
from random_sampled import DEGREE, SampledCase, largest_difference, random_case

from servotwin.hybrid.lifted import COARSE, level_stride
from servotwin.hybrid.lifted_blocks import settled_squares
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SquareWave, as_pieces
from servotwin.simulation import Simulation, simulate
from servotwin.simulation.inputs import RunInputs
from servotwin.simulation.lifted import TICKED, VAST
from servotwin.simulation.lifted_engine import LiftedEngine

PAPER = Servo.preset("paper")
ZONE = ("enter", "leave")


def share_of_ticks(engine: LiftedEngine) -> float:
    """Share of ticks taken one by one."""
    slots = engine.segments.slot[: engine.segments.size[0]]
    return float(np.mean(slots == TICKED) * slots.size / ((engine.samples - 1) * engine.every))


@pytest.mark.slow
@pytest.mark.random
@pytest.mark.parametrize("first", range(0, extent(50, 600), 50))
def test_random_loops_are_those_of_the_ticks(first: int) -> None:
    """Same events, switching ticks to the bit, states to 1e-9 of their range."""
    for seed in range(first, first + 50):
        case = random_case(seed)
        ticked, blocks = case.ticked(), case.in_blocks()
        assert largest_difference(case, ticked, blocks) < 1e-9, seed
        expected, found = ticked.events(), blocks.events()
        zones = [[event for event in events if event[1] in ZONE] for events in (expected, found)]
        assert zones[0] == zones[1], seed
        # At a gap of zero, and where a gap jumps, rounding decides on pairs of events that move nothing; so it does
        # where the motor rests in the dead zone under a velocity feedforward that has faded to 1e-17 V.
        fading = case.controller.velocity_feedforward != 0.0 and case.inputs.tolerance is not None
        if np.all(case.inputs.gap.coeffs[:, 0] > 0.0) and case.inputs.gap.jumps.size == 0 and not fading:
            assert [event[1:] for event in expected] == [event[1:] for event in found], seed
            times = np.array([[a[0], b[0]] for a, b in zip(expected, found, strict=True)]).reshape(-1, 2)
            assert np.all(np.abs(np.diff(times)) < 1e-7), seed


def counting_case(seed: int) -> SampledCase:
    """A random loop whose position sensor counts, coarsely or finely."""
    case = random_case(20_000 + seed)
    size = float(np.abs(case.inputs.reference.coeffs).max())
    share = 10.0 ** np.random.default_rng([32, seed]).uniform(-5.0, -1.0)
    case.servo = case.servo.replace(position_resolution=size * share)
    return case


@pytest.mark.slow
@pytest.mark.parametrize("first", explored([0, 50], 0))
def test_random_loops_with_counts_are_those_of_the_ticks(first: int) -> None:
    """The same counts at every sample, the dead zone to the tick, states to 1e-9 of their range."""
    for seed in range(first, first + 50):
        case = counting_case(seed)
        ticked, blocks = case.ticked(), case.in_blocks()
        assert largest_difference(case, ticked, blocks) < 1e-9, seed
        measured = [engine.channel("measured_position", 0, case.samples) for engine in (ticked, blocks)]
        assert np.array_equal(*measured), seed
        zones = [[event for event in each.events() if event[1] in ZONE] for each in (ticked, blocks)]
        assert zones[0] == zones[1], seed


def test_ticks_of_one_count_are_advanced_in_blocks() -> None:
    servo = PAPER.replace(position_resolution=1e-6)
    law = servo.controller.replace(sample_rate=5e3, Ki=0.0)
    inputs = RunInputs(PiecewiseCubic.constant(1e-3), PiecewiseCubic.constant(10.0 * DEGREE), None, 5e3, 1e-3)
    case = SampledCase(servo, law, inputs, 0.0, 60_001, 0)
    ticked, blocks = case.ticked(), case.in_blocks()
    assert share_of_ticks(blocks) < 0.2
    assert largest_difference(case, ticked, blocks) < 1e-9
    counts, expected = (engine.channel("measured_position", 0, case.samples) for engine in (blocks, ticked))
    assert np.array_equal(counts, expected)
    assert np.unique(counts).size > 500


@pytest.mark.parametrize("limit", [None, 0.8])
def test_ramps_of_a_limited_rate_are_advanced_in_blocks(limit: float | None) -> None:
    law = PAPER.controller.replace(sample_rate=5e3, rate_limit=3.0, voltage_limit=limit)
    inputs = RunInputs(PiecewiseCubic.constant(1e-3), PiecewiseCubic.constant(10.0 * DEGREE), None, 5e3, 1e-3)
    case = SampledCase(PAPER, law, inputs, 0.0, 20_001, 0)
    ticked, blocks = case.ticked(), case.in_blocks()
    voltage = ticked.channel("voltage", 0, case.samples)
    assert limit is None or (voltage.max() == limit and voltage.min() == -limit)
    steps = np.diff(voltage)
    assert np.mean(np.isclose(steps, 3.0 / 5e3)) > 0.3  # up
    assert np.mean(np.isclose(steps, -3.0 / 5e3)) > 0.3  # down
    assert share_of_ticks(blocks) < 0.01
    assert largest_difference(case, ticked, blocks) < 1e-7


def test_most_ticks_are_advanced_in_blocks() -> None:
    law = PAPER.controller.replace(sample_rate=5e3)
    wave = as_pieces(SquareWave(1e-3, 4.0), 20.0)
    inputs = RunInputs(wave, PiecewiseCubic.constant(10.0 * DEGREE), None, 5e3)
    case = SampledCase(PAPER, law, inputs, 0.0, 100_001, 0)
    assert share_of_ticks(case.in_blocks()) < 0.01
    calm = law.replace(Ki=0.0, voltage_limit=24.0)
    inputs = RunInputs(PiecewiseCubic.constant(1e-3), PiecewiseCubic.constant(0.0), None, 5e3)
    resting = SampledCase(PAPER, calm, inputs, 0.0, 500_001, 1).in_blocks()
    assert share_of_ticks(resting) < 0.01
    count = resting.segments.size[0]
    single = resting.segments.tick[:count][resting.segments.slot[:count] == TICKED]
    # At rest none, but for what is left of the last block, and the tick at the end.
    assert not np.any((single > 400_000) & (single < 499_999))


@pytest.mark.parametrize("every", [1, 100])
def test_a_calm_run_in_vast_blocks_is_that_of_the_ticks(every: int) -> None:
    law = PAPER.controller.replace(sample_rate=5e3, Ki=0.0)
    wave = as_pieces(SquareWave(1e-3, 60.0), 60.0)
    inputs = RunInputs(wave, PiecewiseCubic.constant(10.0 * DEGREE), None, 5e3 / every, 0.01)
    case = SampledCase(PAPER, law, inputs, 0.0, 300_000 // every + 1, 0)
    blocks = case.in_blocks()
    slots = blocks.segments.slot[: blocks.segments.size[0]]
    assert np.count_nonzero(slots <= VAST) > 20
    assert slots.size < 1000
    assert largest_difference(case, case.ticked(), blocks) < 1e-9


@pytest.mark.parametrize("rate", [1e3, 5e3])
@pytest.mark.parametrize("excess", [1e-5, 1e-8, 1e-11])
def test_a_touch_shorter_than_a_tick_is_not_missed(rate: float, excess: float) -> None:
    """The widest gap that is still crossed: a little narrower, and the contact lasts a small part of a tick."""
    law = PAPER.controller.replace(sample_rate=rate, Ki=0.0)

    reference = PiecewiseCubic.zero_order_hold([0.0, 0.5, 0.53], [1e-3, 0.2e-3, 1.2e-3])  # turns back inside the gap

    def touch(gap: float, block: bool) -> float:
        """How long the other flank is touched, s; 0: not at all."""
        options = {"controller": law, "reference": reference, "gap": gap, "sample_rate": rate}
        simulation = Simulation(PAPER, 0.6, **options)
        engine: Any = simulation.engine
        if block:
            engine = LiftedEngine(PAPER, law, simulation.inputs, 0.0, simulation.samples)
        engine.advance(simulation.samples - 1)
        touching = [event for event in engine.events() if event[0] > 0.5 and event[2] == -1]
        assert [kind for _, kind, _, _ in touching] in ([], ["contact", "release"])
        return touching[1][0] - touching[0][0] if touching else 0.0

    low, high = 1.0 * DEGREE, 4.0 * DEGREE
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if touch(middle, False) > 0.0 else (low, middle)
    narrow = low * (1.0 - excess)
    assert touch(high * (1.0 + excess), True) == 0.0
    assert 0.0 < touch(narrow, True) < (1.0 if excess > 1e-7 else 0.2) * 10.0 / rate
    assert touch(narrow, True) == pytest.approx(touch(narrow, False), rel=1e-2)


def scaled_run(factor: float, law_changes: dict[str, float]) -> LiftedEngine:
    law = PAPER.controller.replace(sample_rate=5e3, **law_changes)
    inputs = RunInputs(
        as_pieces(SquareWave(factor * 1e-3, 1.0), 4.0),
        PiecewiseCubic.constant(factor * 6.0 * DEGREE),
        PiecewiseCubic.constant(factor * PAPER.tolerance_for(4.0 * DEGREE)),
        1e3,
        factor * 0.02,
    )
    return SampledCase(PAPER, law, inputs, factor * 0.01, 4001, 1).in_blocks()


@pytest.mark.parametrize("power", [-20, -3, 2])
def test_scaling_everything_by_a_power_of_two_scales_every_bit(power: int) -> None:
    """No threshold is absolute: neither in metres nor in volts."""
    limits = {"voltage_limit": 2.0, "rate_limit": 200.0}
    factor = 2.0**power
    one = scaled_run(1.0, limits)
    other = scaled_run(factor, {name: factor * value for name, value in limits.items()})
    for name in ("position", "theta_m", "theta_d", "voltage"):
        assert np.array_equal(factor * one.channel(name, 0, 4001), other.channel(name, 0, 4001))
    assert one.events() == other.events()


@pytest.mark.parametrize("factor", [2.0**-8, 0.1, 1000.0])
def test_a_slower_machine_runs_slower(factor: float) -> None:
    """Time scaled in plant, law and inputs: the same samples with the same effort."""
    slow = PAPER.replace(
        m=PAPER.m * factor**2, c=PAPER.c * factor, J=PAPER.J * factor**2, L=PAPER.L * factor, k_B=PAPER.k_B * factor
    )
    law = PAPER.controller.replace(sample_rate=5e3, rate_limit=200.0, loop_filter_hz=300.0, Ki=500.0)
    slow_law = law.replace(
        Ki=law.Ki / factor,
        Kd=law.Kd * factor,
        Tf=law.Tf * factor,
        sample_rate=5e3 / factor,
        rate_limit=200.0 / factor,
        loop_filter_hz=300.0 / factor,
    )
    runs = []
    for servo, controller, scale in ((PAPER, law, 1.0), (slow, slow_law, factor)):
        inputs = RunInputs(
            as_pieces(SquareWave(1e-3, scale), 2.0 * scale),
            PiecewiseCubic.constant(6.0 * DEGREE),
            PiecewiseCubic.constant(2e-5),
            1e3 / scale,
        )
        runs.append(SampledCase(servo, controller, inputs, 0.01, 2001, 0).in_blocks())
    for name in ("position", "theta_m", "voltage"):
        a, b = (run.channel(name, 0, 2001) for run in runs)
        assert np.abs(a - b).max() < 1e-8 * np.abs(a).max()
    assert [event[1:] for event in runs[0].events()] == [event[1:] for event in runs[1].events()]
    assert abs(share_of_ticks(runs[0]) - share_of_ticks(runs[1])) < 0.002


def test_long_runs_without_noise_are_made_in_blocks() -> None:
    """`simulate` and a `Simulation`, which is always tick by tick, agree."""
    law = PAPER.controller.replace(sample_rate=5e3, loop_filter_hz=50.0)
    options = {"reference": SquareWave(1e-3, 2.0), "gap": 7.0 * DEGREE, "tolerance": 2e-5, "sample_rate": 1e3}
    simulation = Simulation(PAPER, 8.0, law, **options)
    simulation.advance(8000)
    ticked, run = simulation.run(), simulate(PAPER, 8.0, controller=law, **options)
    for name in ("q", "theta_m", "theta_d", "voltage", "measured_position"):
        expected = getattr(ticked, name)
        assert not np.array_equal(getattr(run, name), expected)
        assert np.abs(getattr(run, name) - expected).max() < 1e-9 * np.abs(expected).max()
    assert run.events.kind.tolist() == ticked.events.kind.tolist()


@pytest.mark.parametrize(
    ("changes", "gap", "tolerance", "delay"),
    [
        ({}, (10.0, 0.0), None, 0),
        ({"voltage_limit": 24.0}, (20.0, -0.1), None, 2),  # the gap closes on a loop at rest
        ({"Kp": 900.0, "Kd": -110.0}, (30.0, 0.05), 2e-4, 0),
        ({"rate_limit": 400.0, "loop_filter_hz": 60.0}, (5.0, 0.02), None, 1),
    ],
)
def test_long_rests_are_passed_on_the_vast_scale(
    changes: dict[str, float], gap: tuple[float, float], tolerance: float | None, delay: int
) -> None:
    """Blocks of 2048 ticks end where something switches at last: the events and states are those of the ticks."""
    law = PAPER.controller.replace(sample_rate=5e3, Ki=0.0, **changes)
    wave = as_pieces(SquareWave(1e-3, 40.0), 50.0)
    total = PiecewiseCubic(np.zeros(1), np.array([[gap[0] * DEGREE, gap[1] * DEGREE, 0.0, 0.0]]))
    zone = None if tolerance is None else PiecewiseCubic.constant(tolerance)
    case = SampledCase(PAPER, law, RunInputs(wave, total, zone, 1e3), 0.0, 50_001, delay)
    ticked, blocks = case.ticked(), case.in_blocks()
    assert 2 in blocks.memory.filled
    assert blocks.segments.size[0] < 0.02 * 250_000
    assert largest_difference(case, ticked, blocks) < 1e-9
    expected, found = ticked.events(), blocks.events()
    assert [event[1:] for event in expected] == [event[1:] for event in found]
    assert np.allclose([event[0] for event in expected], [event[0] for event in found], rtol=0.0, atol=1e-7)


def test_deviations_near_rest_are_those_of_what_moves() -> None:
    """Squares of the whole state are rounding there: they would be a million times as large."""
    law = PAPER.controller.replace(sample_rate=5e3, Ki=0.0)
    inputs = RunInputs(PiecewiseCubic.constant(1e-3), PiecewiseCubic.constant(10.0 * DEGREE), None, 1e3)
    blocks = SampledCase(PAPER, law, inputs, 0.0, 20_001, 0).in_blocks()
    t, slots = blocks.memory.lifted, blocks.segments.slot[: blocks.segments.size[0]]
    slot, n, watches = VAST - int(slots[slots <= VAST][-1]), t.states, len(blocks.memory.squares)
    stride, width = level_stride(t, COARSE), 3 * COARSE + 1 + n
    table = t.vast[slot * n * stride : (slot + 1) * n * stride].reshape(n, stride)
    matrices = [table[:, (watch + 1) * width - n : (watch + 1) * width] for watch in range(watches)]
    moving = np.zeros(n)
    moving[[blocks.plant.automaton.names.index(name) for name in ("current", "speed")]] = 1e-9
    squares, state = np.empty(watches), blocks.state + moving
    assert settled_squares(t, t.vast, slot, watches, COARSE, state, np.empty(n), squares)
    expected = [moving @ matrix @ moving for matrix in matrices]
    assert max(expected) > 0.0
    assert np.allclose(squares, expected, rtol=1e-3)
