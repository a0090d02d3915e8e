"""Tiny, closing and jumping gaps: no event is missed by the coarse search, and rounding never looks like Zeno."""

import math

import numpy as np
import pytest
from test_oracles import DEGREE, engine

from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave, Step, as_pieces
from servotwin.simulation import simulate

PRESETS = ("paper", "table1", "paper-gain2")


def tiny(seed: int) -> tuple[Servo, dict[str, object]]:
    """A gap between 0.001 and 0.5 degrees, constant or wearing, and a dead zone about as wide, or none."""
    rng = np.random.default_rng(seed)
    servo = Servo.preset(str(rng.choice(PRESETS)))
    size = 10.0 ** rng.uniform(-3.0, math.log10(0.5)) * DEGREE
    gap = [size, SCurve(0.0, size, 20.0), SCurve(size, size * rng.uniform(0.0, 2.0), 10.0, 5.0)][int(rng.integers(3))]
    signals = {
        "reference": SquareWave(1e-3 * rng.uniform(0.2, 2.0), float(rng.choice([4.0, 10.0, 40.0]))),
        "gap": gap,
        "tolerance": servo.tolerance_for(size) * rng.uniform(0.2, 2.0),
    }
    if rng.random() < 0.25:
        del signals["tolerance"]
    return servo, signals


@pytest.mark.slow
def test_the_coarse_search_misses_nothing() -> None:
    """30 runs of 20 s: the same events when every sample is looked at (refine 8), and four times finer still."""
    differing, events = [], 0
    for seed in range(30):
        servo, signals = tiny(seed)
        found = [engine(servo, 20.0, refine, **signals).events() for refine in (1, 8, 32)]
        # Where a ramp of the gap ends its rate is zero to rounding, and so is what that makes of a motor at rest; at
        # the run's own end the reference flips.
        knots = np.append(as_pieces(signals["gap"], 20.0).times, 20.0)
        kinds = [[event[1:] for event in run if np.abs(knots - event[0]).min() > 1e-9] for run in found]
        if kinds[1:] != kinds[:1] * 2:
            differing.append(seed)
        events += len(kinds[0])
    assert differing == []
    assert events > 5000


def degenerate(seed: int) -> tuple[Servo, dict[str, object]]:
    """Gaps that vanish, jump or kink just where the reference does, dead zones of no width, a screw on its flank."""
    rng = np.random.default_rng(seed)
    servo = Servo.preset(str(rng.choice(PRESETS)))
    law = servo.controller
    if rng.random() < 0.3:
        law = law.replace(voltage_limit=float(10.0 ** rng.uniform(-2.0, 1.0)))
    if rng.random() < 0.3:
        law = law.replace(enter=0.5, leave=1.5)
    if rng.random() < 0.3:
        law = law.replace(sample_rate=float(rng.choice([1000.0, 5000.0])))
    if rng.random() < 0.15:
        servo = servo.replace(k_d=1e6)
    half, size = float(rng.choice([2.0, 2.5, 5.0])), float(rng.choice([0.0, 1e-6, 1e-3, 0.1, 1.0, 20.0])) * DEGREE
    zero = [0.0, 0.0, 0.0, 0.0]
    gaps = [
        size,
        SCurve(0.0, size, 10.0),
        SCurve(size, 0.0, 5.0, half),
        PiecewiseCubic.zero_order_hold([0.0, half, 2.0 * half], [size, size / 2.0, 2.0 * size]),
        PiecewiseCubic.zero_order_hold([0.0, half, 2.0 * half], [size, 0.0, size]),
        PiecewiseCubic([0.0, half], [[size, *zero[1:]], [size, size / 10.0, *zero[2:]]]),
        PiecewiseCubic([0.0, 1.0, 3.0], [[size, *zero[1:]], [size, -size / 4.0, 0, 0], [size / 2.0, size / 4.0, 0, 0]]),
    ]
    references = [1e-3, SquareWave(1e-3, 2.0 * half), Step(1e-3, half), SCurve(0.0, 1e-3, half), 0.0]
    tolerance = float(rng.choice([0.0, 1e-9, 0.3, 1.0, 2.0])) * servo.tolerance_for(max(size, 0.1 * DEGREE))
    return servo, {
        "controller": law,
        "reference": references[int(rng.integers(len(references)))],
        "gap": gaps[int(rng.integers(len(gaps)))],
        "tolerance": None if rng.random() < 0.2 else tolerance,
        "theta_d0": float(rng.choice([-0.5, 0.0, 0.5])) * size,
        "sample_rate": float(rng.choice([1000.0, 5000.0])),
    }


@pytest.mark.slow
@pytest.mark.parametrize("block", range(4))
def test_degenerate_inputs_run(block: int) -> None:
    for seed in range(30 * block, 30 * block + 30):
        servo, options = degenerate(seed)
        run = simulate(servo, 10.0, **options)
        assert np.abs(run.position).max() < 0.02, seed
        beyond = np.abs(run.theta_m - run.theta_d) - 0.5 * run.gap
        assert beyond.max() < 2e-11 * max(1.0, np.abs(run.theta_m).max()), seed
        assert len(run.events) < 4000, seed


AT_REST = [
    ("paper-gain2", 0.0016774800298937139, 40.0, SCurve(0.0, 0.00012245191860293413, 20.0), 2.469503987057754e-08),
    (
        "paper-gain2",
        0.000618043490537173,
        10.0,
        SCurve(0.0011484234194369686, 0.0020744706828288466, 10.0, 5.0),
        2.5275939672694535e-07,
    ),
    ("table1", 0.001141716775445659, 40.0, SCurve(0.0, 0.00017501122607748338, 20.0), 2.8358311632707378e-08),
]


@pytest.mark.parametrize(("preset", "amplitude", "period", "gap", "tolerance"), AT_REST)
@pytest.mark.parametrize("refine", [1, 8, 32])
def test_a_motor_almost_at_rest_on_a_flank_is_not_zeno(
    preset: str, amplitude: float, period: float, gap: SCurve, tolerance: float, refine: int
) -> None:
    """Its speed was rounding to one guard, not to the other, which sent the mode to and fro without end."""
    reference = SquareWave(amplitude, period)
    run = engine(Servo.preset(preset), 20.0, refine, reference=reference, gap=gap, tolerance=tolerance)
    assert len(run.events()) > 20
