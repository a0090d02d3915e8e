"""The kernel on relay loops: limit cycles in closed form, and sliding relays that must be refused, not followed."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from servotwin.hybrid.automaton import Array, Automaton, Guard, Mode
from servotwin.hybrid.trajectory import Trajectory, ZenoError

WIDTH, PUSH = 0.3, 1.7


def relay(plant: Array, drive: Array, output: Array, width: float = WIDTH, push: float = PUSH) -> Automaton:
    """``x' = plant x + drive u`` with ``u = -push`` from where the output exceeds `width`, ``+push`` from below
    ``-width``; the last state is the constant 1."""
    n = len(drive)
    modes = []
    for sign in (1.0, -1.0):
        flow = np.zeros((n + 1, n + 1))
        flow[:n, :n], flow[:n, n] = plant, sign * push * drive
        row = np.append(sign * output, -width)
        switch = Guard(row, 1 - len(modes), None, "switch", int(-sign))
        modes.append(Mode(flow, (switch,), "up" if sign > 0 else "down"))
    return Automaton(tuple(modes), (*(f"x{i}" for i in range(n)), "one"))


def run(automaton: Automaton, state: list[float], step: float, samples: int) -> tuple[Trajectory, Array]:
    trajectory = Trajectory(automaton, np.array([*state, 1.0]), 0, step)
    trajectory.advance(samples)
    return trajectory, np.array([event[0] for event in trajectory.events()])


@pytest.mark.parametrize("step", [1e-3, 0.037])
def test_integrator_swings_as_a_triangle(step: float) -> None:
    """x' = u: the period is 4 width / push, from any start."""
    trajectory, times = run(relay(np.zeros((1, 1)), np.ones(1), np.ones(1)), [0.11], step, int(50.0 / step))
    first = (WIDTH - 0.11) / PUSH
    expected = first + 2.0 * WIDTH / PUSH * np.arange(len(times))
    assert len(times) == 1 + int((int(50.0 / step) * step - first) / (2.0 * WIDTH / PUSH))
    assert np.abs(times - expected).max() < 1e-13 * times[-1]
    phase = (times[:-1] + times[1:]) / 2.0
    assert np.abs(trajectory.at(phase, [1.0, 0.0])).max() < 1e-13
    assert np.abs(np.abs(trajectory.at(times, [1.0, 0.0])) - WIDTH).max() < 1e-14


def test_lag_swings_as_exponentials() -> None:
    """T x' = u - x: the half period is T log((push + width) / (push - width)), reached at the first switch."""
    lag = 0.23
    automaton = relay(np.array([[-1.0 / lag]]), np.array([1.0 / lag]), np.ones(1))
    trajectory, times = run(automaton, [0.0], 1e-3, 30_000)
    half = lag * np.log((PUSH + WIDTH) / (PUSH - WIDTH))
    assert len(times) > 300
    assert np.abs(np.diff(times) / half - 1.0).max() < 1e-12
    assert times[0] == pytest.approx(lag * np.log(PUSH / (PUSH - WIDTH)), rel=1e-14)
    assert np.abs(trajectory.sampled([1.0, 0.0])).max() <= WIDTH * (1.0 + 1e-14)


FAST, SLOW = 5.0, 0.8


def second_order() -> Automaton:
    """1 / ((s + FAST)(s + SLOW)) with states (y, y')."""
    plant = np.array([[0.0, 1.0], [-FAST * SLOW, -FAST - SLOW]])
    return relay(plant, np.array([0.0, 1.0]), np.array([1.0, 0.0]), width=0.05)


def half_period() -> float:
    """The root of y(half) = width on the symmetric cycle (Tsypkin), pole by pole."""

    def error(half: float) -> float:
        slow, fast = np.tanh(SLOW * half / 2.0) / SLOW, np.tanh(FAST * half / 2.0) / FAST
        return PUSH * (slow - fast) / (FAST - SLOW) - 0.05

    return brentq(error, 1e-3, 20.0, xtol=1e-15, rtol=1e-15)


def cycle(time: float) -> Array:
    """(y, y') of the symmetric cycle at `time` after a switch to +push."""
    half, result = half_period(), np.zeros(2)
    for pole, sign in ((SLOW, 1.0), (FAST, -1.0)):
        mode = 1.0 / pole - 2.0 * np.exp(-pole * time) / (pole * (1.0 + np.exp(-pole * half)))
        slope = 2.0 * np.exp(-pole * time) / (1.0 + np.exp(-pole * half))
        result += PUSH * sign / (FAST - SLOW) * np.array([mode, slope])
    return result


def test_second_order_plant_finds_its_cycle() -> None:
    half = half_period()
    trajectory, times = run(second_order(), [0.01, 0.0], 1e-3, 40_000)
    periods = times[22::2] - times[20:-2:2]
    assert len(periods) > 10
    assert np.abs(periods / (2.0 * half) - 1.0).max() < 1e-12
    top = brentq(lambda t: cycle(t)[1], 0.0, half, xtol=1e-15)
    amplitude = -cycle(top)[0]
    # The events alternate; the one with side +1 switches to +push, and y goes on falling until `top`.
    start = next(event[0] for event in trajectory.events()[20:] if event[2] == 1)
    assert trajectory.at([start + top], [1.0, 0.0, 0.0])[0] == pytest.approx(-amplitude, rel=1e-12)
    assert trajectory.at([start + top], [0.0, 1.0, 0.0])[0] == pytest.approx(0.0, abs=1e-12)
    late = trajectory.sampled([1.0, 0.0, 0.0], 20_000)
    assert amplitude * (1.0 - 1e-6) < np.abs(late).max() <= amplitude * (1.0 + 1e-12)


def test_the_cycle_started_on_itself_stays() -> None:
    half = half_period()
    start = cycle(0.0)
    assert start[0] == pytest.approx(-0.05, rel=1e-12)
    _, times = run(second_order(), start.tolist(), 0.01, 2000)
    assert np.abs(times / (half * np.arange(1, len(times) + 1)) - 1.0).max() < 1e-12


def test_third_order_plant_without_hysteresis() -> None:
    """1 / (s + 1)^3: y(half) = 0 on the symmetric cycle; the switch has no width to hide rounding in."""
    plant = np.array([[-1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])
    automaton = relay(plant, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), width=0.0)
    _, times = run(automaton, [0.5, -0.2, -0.3], 0.01, 20_000)

    def error(half: float) -> float:
        # On the cycle x(half) = -x(0): x(0) = -(I + exp)^-1 (I - exp) drive for unit gain at rest.
        flow = expm(plant * half)
        at_rest = np.ones(3)
        return float(np.linalg.solve(np.eye(3) + flow, (np.eye(3) - flow) @ at_rest)[2])

    half = brentq(error, 1.0, 6.0, xtol=1e-14)
    assert np.abs(np.diff(times)[-20:] / half - 1.0).max() < 1e-11


SLIDING = {
    "integrator": (np.zeros((1, 1)), np.ones(1), np.ones(1), [-0.4]),
    "lag": (np.array([[-2.0]]), np.ones(1), np.ones(1), [0.9]),
    "second order with a zero": (np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([0.0, 1.0]), np.ones(2), [0.3, 0.1]),
}


@pytest.mark.parametrize("name", SLIDING)
@pytest.mark.parametrize("step", [1e-4, 0.02])
def test_sliding_relay_is_refused(name: str, step: float) -> None:
    plant, drive, output, state = SLIDING[name]
    automaton = relay(plant, drive, output, width=0.0)
    trajectory = Trajectory(automaton, np.array([*state, 1.0]), 0, step)
    with pytest.raises(ZenoError, match=r"mode '(up|down)'.*slides"):
        trajectory.advance(int(40.0 / step))
    assert 0.0 < trajectory.time < 40.0
    distance = abs(trajectory.state[:-1] @ output)
    assert distance < 1e-12


def test_sliding_begins_at_the_exact_time() -> None:
    plant, drive, output, state = SLIDING["integrator"]
    trajectory = Trajectory(relay(plant, drive, output, width=0.0), np.array([*state, 1.0]), 0, 1e-3)
    with pytest.raises(ZenoError):
        trajectory.advance(1000)
    assert trajectory.time == pytest.approx(0.4 / PUSH, rel=1e-14)


def test_relay_without_hysteresis_on_a_double_integrator_is_a_clock() -> None:
    """x'' = -sign(x): parabolas, the quarter period is sqrt(2 x0), and the amplitude is kept."""
    plant = np.array([[0.0, 1.0], [0.0, 0.0]])
    automaton = relay(plant, np.array([0.0, 1.0]), np.array([1.0, 0.0]), width=0.0, push=1.0)
    trajectory = Trajectory(automaton, np.array([0.5, 0.0, 1.0]), 1, 1e-3)
    trajectory.advance(300_000)
    times = np.array([event[0] for event in trajectory.events()])
    assert len(times) == 150
    assert np.abs(times - (2.0 * np.arange(150) + 1.0)).max() < 1e-10


def test_a_short_bump_that_an_event_sets_off_is_not_missed() -> None:
    """The event starts five exponentials whose sum x (1 - x)^4, x = exp(-t), rises above a level and falls again within
    a few search steps: long gone where the coarse search would look next."""
    weights, level, begin = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), 0.07, 3.978
    n = 7  # the five exponentials, a clock, one
    flow = np.zeros((n, n))
    flow[:5, :5], flow[5, 6] = -np.diag(np.arange(1.0, 6.0)), 1.0
    start = np.eye(n)
    start[:5, 6] = 1.0
    ring = Guard(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -begin]), 1, start, "ring")
    rise = Guard(np.array([*weights, 0.0, -level]), 2, None, "rise")
    fall = Guard(-np.array([*weights, 0.0, -level]), 1, None, "fall")
    names = (*(f"x{k}" for k in range(1, 6)), "clock", "one")
    automaton = Automaton((Mode(flow, (ring,)), Mode(flow, (rise,)), Mode(flow, (fall,))), names)
    state = np.zeros(n)
    state[6] = 1.0
    trajectory = Trajectory(automaton, state, 0, 0.4)
    assert trajectory.step == 0.4
    trajectory.advance(200)

    def bump(time: float) -> float:
        x = np.exp(-time)
        return float(x * (1.0 - x) ** 4 - level)

    top = np.log(5.0)
    expected = [begin, begin + brentq(bump, 0.0, top, xtol=1e-15), begin + brentq(bump, top, 9.0, xtol=1e-15)]
    assert [event[1] for event in trajectory.events()] == ["ring", "rise", "fall"]
    assert [event[0] for event in trajectory.events()] == pytest.approx(expected, rel=1e-12)
