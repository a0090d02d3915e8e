"""Linear laws on axes, sampled and continuous, against scipy's integrator and a law in numpy; filtered PIDs too."""

import math

import numpy as np
import pytest
from exploration import explored
from law_oracle import ContinuousOracle, continuous_positions, numpy_law, sampled_positions
from test_axis import TWO_MASS

from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

RATE = 200.0


def position_and_speed(integral: float) -> LinearLaw:
    """Two measurements: the load's position, and the motor's speed as the difference of two ticks."""
    gain, damping = 60.0, 40.0
    return LinearLaw(
        A=[[1.0, 0.0], [0.0, 0.0]],
        B=[[integral / RATE, 0.0, -integral / RATE], [0.0, 1.0, 0.0]],
        C=[1.0, damping * RATE],
        D=[gain, -damping * RATE, -gain],
        sample_rate=RATE,
        discrete=True,
        names=("integral", "before"),
        holds=("integral",),
        windup=(0.05, 0.0),
    )


def pieces(law: LinearLaw) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Matrices outside, and inside with the integral stopped."""
    A, B, C, D, windup = (np.array(each) for each in (law.A, law.B, law.C, law.D, law.windup))
    B_inside, windup_inside = B.copy(), windup.copy()
    B_inside[0], windup_inside[0] = 0.0, 0.0
    return (A, B, C, D, windup), (A, B_inside, C, D, windup_inside)


LAWS = {
    "plain": (position_and_speed(20.0), None),
    "dead zone": (position_and_speed(20.0).replace(enter=0.6, leave=1.4), 0.2),
    "limits": (position_and_speed(20.0).replace(voltage_limit=8.0, rate_limit=300.0), None),
    "all": (position_and_speed(20.0).replace(voltage_limit=8.0, rate_limit=300.0, enter=0.6, leave=1.4), 0.2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", explored(LAWS, 0, 3))  # the last one has what the others have
def test_a_sampled_law_agrees_with_an_independent_loop(name: str) -> None:
    law, tolerance = LAWS[name]
    axis, gap, count = TWO_MASS.replace(controller=law), 0.03, 300
    axis.check_loop()
    times = np.arange(count) / RATE
    references = np.where(times < 0.75, 0.2, -0.3)
    expected, commands = sampled_positions(axis, numpy_law(law, tolerance, pieces(law)), gap, references, RATE)
    steps = PiecewiseCubic.zero_order_hold([0.0, 0.75], [0.2, -0.3])
    run = simulate(axis, count / RATE, reference=steps, gap=gap, tolerance=tolerance, sample_rate=RATE)
    assert np.abs(run.position[:-1] - expected).max() < 1e-8 * np.ptp(expected)
    assert np.abs(run.voltage[:-1] - commands).max() < 1e-8 * np.ptp(commands)
    if tolerance is not None:
        assert {"enter", "leave"} <= set(run.events.kind)


# Load's position with an integral, and the motor's speed behind a low-pass of 5 ms; the position error's is the other.
CONTINUOUS = LinearLaw(
    A=[[0.0, 0.0], [0.0, -200.0]],
    B=[[20.0, 0.0, -20.0], [0.0, 200.0, 0.0]],
    C=[1.0, 40.0 * 200.0],
    D=[60.0, -40.0 * 200.0, -60.0],
    names=("integral", "slow angle"),
    holds=("integral",),
    windup=(2.0, 0.0),
)
ZONED = {
    "plain": (CONTINUOUS, None),
    "dead zone": (CONTINUOUS.replace(enter=0.6, leave=1.4), 0.02),
    "dead zone that opens the loop, on the motor": (CONTINUOUS.replace(on="motor", integral_only=False), 0.05),
    "dead zone that leaves the speed": (
        CONTINUOUS.replace(
            integral_only=False, B_inside=[[0.0, 0.0, 0.0], [0.0, 200.0, 0.0]], D_inside=[0.0, -40.0 * 200.0, 0.0]
        ),
        0.05,
    ),
    "limit": (CONTINUOUS.replace(voltage_limit=8.0), None),
    "both": (CONTINUOUS.replace(voltage_limit=8.0, enter=0.6, leave=1.4), 0.02),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", explored(ZONED, 2, 4))  # the last one has what the others have
def test_a_continuous_law_agrees_with_an_independent_integrator(name: str) -> None:
    law, tolerance = ZONED[name]
    axis, gap = TWO_MASS.replace(controller=law), 0.03
    axis.check_loop()
    run = simulate(axis, 6.0, reference=SquareWave(0.2, 6.0), gap=gap, tolerance=tolerance, sample_rate=100.0)
    oracle = ContinuousOracle(axis, gap, law=law, tolerance=tolerance)
    expected = continuous_positions(oracle, 0.2, 3.0, run.time[:-1])
    assert np.abs(run.position[:-1] - expected).max() < 1e-8 * np.ptp(expected)
    assert oracle.seen >= {"contact"} | ({"zone"} if tolerance else set()) | ({"limit"} if law.voltage_limit else set())


@pytest.mark.parametrize("name", ZONED)
def test_a_sampled_tick_tends_to_the_continuous_law(name: str) -> None:
    law, tolerance = ZONED[name]

    def position(each: LinearLaw) -> np.ndarray:
        return simulate(
            TWO_MASS, 1.0, controller=each, reference=0.2, gap=0.03, tolerance=tolerance, sample_rate=100.0
        ).position

    exact = position(law)
    errors = [np.abs(position(law.replace(sample_rate=rate)) - exact).max() for rate in (2e4, 1e5)]
    assert errors[1] < 0.3 * errors[0] < 0.002


def matrices(pid: Controller) -> LinearLaw:
    """A filtered PID with low-pass and notch written anew: states integral, derivative, filtered, band, low.

    The notch is (s^2 + 2 depth zeta w s + w^2) / (s^2 + 2 zeta w s + w^2) behind the three actions.
    """
    assert pid.loop_filter_hz is not None
    slope, omega, rate = pid.Kd / pid.Tf, 2.0 * math.pi * pid.notch_hz, 2.0 * math.pi * pid.loop_filter_hz
    actions, reference = np.array([1.0, -slope, -(pid.Kp + slope), 0.0, 0.0]), pid.Kp + slope
    A, B = np.zeros((5, 5)), np.zeros((5, 3))
    A[0, 2], B[0, 0] = -pid.Ki, pid.Ki
    A[1, 1:3], B[1, 0] = -1.0 / pid.Tf, 1.0 / pid.Tf
    A[2, 2], B[2, 2] = -rate, rate
    A[3], B[3, 0] = omega * (actions - [0.0, 0.0, 0.0, 2.0 * pid.notch_damping, 1.0]), omega * reference
    A[4, 3] = omega
    C = actions - [0.0, 0.0, 0.0, 2.0 * pid.notch_damping * (1.0 - pid.notch_depth), 0.0]
    return LinearLaw(A=A.tolist(), B=B.tolist(), C=C.tolist(), D=[reference, 0.0, 0.0])


@pytest.mark.slow
def test_a_filtered_pid_with_low_pass_and_notch_agrees_with_an_independent_integrator() -> None:
    """Its load knocks from flank to flank, and meets one again before the shaft's twist has faded."""
    shaft = Transmission(p=1.0, k_d=3300.0, c_d=12.0, in_gap="free")
    pid = Controller(40.0, 0.2, 25.0, 0.02, loop_filter_hz=30.0, notch_hz=11.0, notch_damping=0.5, notch_depth=0.1)
    axis, gap = TWO_MASS.replace(controller=pid, transmission=shaft), 0.03
    run = simulate(axis, 6.0, reference=SquareWave(0.2, 6.0), gap=gap, sample_rate=100.0)
    oracle = ContinuousOracle(axis, gap, law=matrices(pid))
    expected = continuous_positions(oracle, 0.2, 3.0, run.time[:-1])
    assert np.abs(run.position[:-1] - expected).max() < 1e-8 * np.ptp(expected)
    changes = run.events[np.isin(run.events.kind, ("contact", "release"))]
    assert changes.time == pytest.approx(oracle.changes, abs=1e-6)
    apart = np.diff(changes.time)[changes.kind[:-1] == "release"]
    assert apart.min() < 3.0 * shaft.c_d / shaft.k_d
