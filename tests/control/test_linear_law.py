"""Linear laws: the same bits interpreted and compiled, scipy's discretisation, a PIDF as one, transfer, refusals."""

from array import array

import numpy as np
import pytest
from exploration import extent
from scipy import signal
from scipy.linalg import expm

from servotwin.control import Controller, linear_tick, start, tick
from servotwin.control.cascade import Cascade
from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import LinearParameters, LinearState
from servotwin.control.matrices import at_rest, exponential
from servotwin.errors import InvalidInput
from servotwin.hybrid.compiled import bare, verbatim

compiled_tick = verbatim(linear_tick.linear_tick)


@bare
def _compiled_run(
    parameters: LinearParameters, state: LinearState, inputs: np.ndarray, out: np.ndarray, states: np.ndarray
) -> None:
    for i in range(len(inputs)):
        state = compiled_tick(parameters, state, inputs[i, 0], inputs[i, 1], inputs[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = state.command, state.active, state.offset
        for k, value in enumerate(state.states):
            states[i, k] = value


def random_law(seed: int, n: int, **values: object) -> LinearLaw:
    """A stable law of n states, sampled at 1 kHz."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 0.98 / np.abs(np.linalg.eigvals(A)).max()
    B, C, D, windup = (rng.normal(size=size) for size in ((n, 3), n, 3, n))
    names = tuple(f"s{i}" for i in range(n))
    return LinearLaw(
        A, B, C, D, sample_rate=1e3, discrete=True, names=names, holds=names[:1], windup=0.02 * windup, **values
    )


CASCADE = Cascade(
    0.3, 0.5, velocity_gain=0.02, integral_time=0.05, speed_filter=2e-2, velocity_feedforward=0.9,
    acceleration_feedforward=1e-4, reference_filter=2e-2, notch_hz=45.0, low_pass_hz=300.0, voltage_limit=2.5,
    rate_limit=1500.0, enter=0.5, leave=1.5, sample_rate=1e3,
)  # fmt: skip
LIMITS = {"voltage_limit": 2.5, "rate_limit": 1500.0, "enter": 0.5, "leave": 1.5, "feedforward": 0.1}


@pytest.mark.slow
@pytest.mark.random
@pytest.mark.parametrize(
    "law",
    [
        random_law(3, 3, on="motor", ratio=0.3, **LIMITS),
        random_law(7, 7, on="motor", ratio=0.3, integral_only=False, **LIMITS),
        CASCADE.linear(),
    ],
    ids=["random", "opening", "cascade"],
)
def test_ticks_interpreted_and_compiled_agree_bit_for_bit(law: LinearLaw) -> None:
    """A million of them in `make fuzz`."""
    count = extent(50_000, 1_000_000)
    parameters, first = law.parameters(0.6), law.start(0.0, 0.0)._replace(offset=1.3)
    inputs = np.random.default_rng(9).normal(size=(count, 3))
    advance, output = np.array(parameters.advance), np.array(parameters.output)
    given = parameters._replace(advance=advance, output=output)  # type: ignore[arg-type]
    out, states = np.empty((count, 3)), np.empty((count, len(first.states)))
    _compiled_run(given, first, inputs, out, states)
    state, interpreted, visited = first, array("d"), array("d")
    for row in inputs.tolist():
        state = linear_tick.linear_tick(parameters, state, *row)
        interpreted.extend((state.command, state.active, state.offset))
        visited.extend(state.states)
    assert interpreted.tobytes() == out.tobytes()
    assert visited.tobytes() == states.tobytes()
    command, active = out[:, 0], out[:, 1]
    for branch in (np.abs(command) == 2.5, np.isclose(np.abs(np.diff(command)), 1.5), np.diff(active) != 0.0):
        assert count / 1000 < np.count_nonzero(branch) < count


def test_the_exponential_agrees_with_scipy() -> None:
    rng = np.random.default_rng(1)
    for size in (1e-6, 1e-2, 1.0, 10.0):
        matrix = rng.normal(size=(7, 7)) * size
        exact = expm(matrix)
        found = np.array(exponential(tuple(map(tuple, matrix.tolist()))))
        assert np.abs(found - exact).max() < 2e-13 * np.abs(exact).max()


@pytest.mark.parametrize("rate", [50.0, 5000.0])
def test_held_inputs_agree_with_scipy(rate: float) -> None:
    """A system of scipy.signal, continuous, its tick beside scipy's own discretisation."""
    system = signal.TransferFunction([2.0, 60.0, 400.0], [0.01, 1.0, 0.0])
    law = LinearLaw.from_system(system, sample_rate=rate)
    errors = np.random.default_rng(3).normal(size=400)
    discrete = signal.cont2discrete(signal.tf2ss(system.num, system.den), 1.0 / rate, method="zoh")
    _, oracle, _ = signal.dlsim(discrete, errors)
    parameters, state, found = law.parameters(), law.start(0.0, 0.0), []
    for error in errors.tolist():
        state = linear_tick.linear_tick(parameters, state, error, 0.0, 0.0)
        found.append(state.command)
    assert found == pytest.approx(oracle[:, 0].tolist(), rel=1e-9, abs=1e-9)


def test_systems_of_python_control_and_scipy_are_the_same_law() -> None:
    control = pytest.importorskip("control")
    fraction = [1.0, 2.0], [1.0, 5.0, 6.0]
    laws = [
        LinearLaw.from_system(each)
        for each in (control.ss(control.tf(*fraction)), control.tf(*fraction), signal.TransferFunction(*fraction))
    ]
    for law in laws:
        static = np.array(law.C) @ np.linalg.solve(-np.array(law.A), np.array(law.B)) + np.array(law.D)
        assert static == pytest.approx([1 / 3, 0.0, -1 / 3], rel=1e-12)
    sampled = LinearLaw.from_system(
        control.ss([[0.5]], [[1.0, 2.0]], [[1.0]], [[0.0, 3.0]], 0.01), on="motor", ratio=0.1
    )
    assert (sampled.sample_rate, sampled.discrete) == (100.0, True)
    assert sampled.B[0] == pytest.approx((1.0, 0.2, 0.0))
    assert pytest.approx((0.0, 0.3, 0.0)) == sampled.D


def pidf(controller: Controller) -> LinearLaw:
    """The filtered PID as a linear law: Ki times the integral, and the filtered error."""
    c = controller
    return LinearLaw(
        A=[[0.0, 0.0], [0.0, -1.0 / c.Tf]],
        B=[[c.Ki, 0.0, -c.Ki], [1.0 / c.Tf, 0.0, -1.0 / c.Tf]],
        C=[1.0, -c.Kd / c.Tf],
        D=[c.Kp + c.Kd / c.Tf, 0.0, -c.Kp - c.Kd / c.Tf],
        sample_rate=c.sample_rate,
        names=("integral", "filtered error"),
        holds=("integral",),
        integral_only=c.integral_only,
        enter=c.enter,
        leave=c.leave,
        voltage_limit=c.voltage_limit,
        rate_limit=c.rate_limit,
        windup=(1.0 / c.tracking, 0.0),
    )


@pytest.mark.parametrize("integral_only", [False, True])
def test_a_filtered_pid_is_one_of_them_to_rounding(integral_only: bool) -> None:
    """With dead zone and limits; inside the zone the back-calculation rests as the integral does."""
    controller = Controller(
        1377.7, 18907.6, -135.1, 0.1, sample_rate=5e3, integral_only=integral_only, enter=0.6, leave=1.4,
        voltage_limit=1.5, rate_limit=1e4,
    )  # fmt: skip
    law, k = pidf(controller), np.arange(20_000)
    errors = (1.5e-3 * np.sin(2e-3 * k) * np.exp(-1e-4 * k)).tolist()
    own, parameters = controller.law(3e-4), law.parameters(3e-4)
    pid, state, voltages, commands = start(0.0), law.start(0.0, 0.0), [], []
    for error in errors:
        pid = tick(own, pid, error, 0.0)
        state = linear_tick.linear_tick(parameters, state, error, 0.0, 0.0)
        voltages.append(pid.voltage)
        commands.append(state.command)
        assert pid.active == state.active
    assert commands == pytest.approx(voltages, rel=1e-9, abs=1e-9)


def test_a_change_of_law_does_not_bump() -> None:
    """Within 1e-12 of the command that the old law would give; the difference then fades."""
    for seed in range(50):
        old, new = (random_law(seed + k, 4, **LIMITS) for k in (0, 1000))
        inputs = np.random.default_rng(seed).normal(size=(40, 3)).tolist()
        state = old.start(0.0, 0.0)
        for row in inputs:
            state = linear_tick.linear_tick(old.parameters(0.6), state, *row)
        due = (0.3, -0.2, 0.1)
        expected = linear_tick.linear_tick(old.parameters(0.6), state, *due).command
        moved = new.transfer(old, state, due, (0.6, 0.8))
        assert linear_tick.linear_tick(new.parameters(0.8), moved, *due).command == pytest.approx(expected, abs=1e-12)
        assert moved.states[:4] == state.states[:4]


def test_new_states_start_at_rest_and_old_ones_go_on() -> None:
    plain = LinearLaw([[0.0]], [[2.0, 0.0, -2.0]], [1.0], [3.0, 0.0, -3.0], 1e3, names=("integral",))
    filtered = LinearLaw(
        [[0.0, -2.0], [0.0, -50.0]], [[2.0, 0.0, 0.0], [0.0, 0.0, 50.0]], [1.0, -3.0], [3.0, 0.0, 0.0], 1e3,
        names=("integral", "low-pass"),
    )  # fmt: skip
    state = LinearState((0.7, 0.0, 0.0, 0.0), 0.5, 1.0, 0.0)
    moved = filtered.transfer(plain, state, (0.2, 0.0, 0.15), (None, None))
    assert moved.states == pytest.approx((0.7, 0.15, 0.0, 0.0), rel=1e-12)
    assert moved.offset == pytest.approx(0.0, abs=1e-12)
    assert at_rest(((0.5, 0.0), (1.0, 1.0)), (1.0, -2.0), {}) == pytest.approx((2.0, 0.0))


def test_outside_the_zone_the_held_states_move_and_inside_they_hold() -> None:
    law = random_law(3, 5).replace(integral_only=False)
    parameters, state = law.parameters(1.0), law.start(0.0, 0.0)
    for _ in range(10):
        state = linear_tick.linear_tick(parameters, state, 2.0, 0.3, 0.4)
    inside = linear_tick.linear_tick(parameters, state, 0.5, 0.3, 0.4)
    assert (inside.active, inside.command) == (0.0, 0.0)
    assert inside.states[0] == state.states[0] != 0.0
    free = np.array(law.A) @ state.states[:5]
    assert inside.states[1:5] == pytest.approx(free[1:], rel=1e-12)


GOOD = LinearLaw([[0.5]], [[1.0, 0.0, 0.0]], [1.0], [0.0, 0.0, 0.0], 100.0, discrete=True)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LinearLaw([[1.0, 0.0]], [[1.0, 0.0, 0.0]], [1.0], [0.0] * 3), "law A = .*: must be 1 by 1 numbers"),
        (lambda: LinearLaw([[1.0]], [[1.0, 0.0]], [1.0], [0.0] * 3), "law B = .*: must be 1 by 3 numbers"),
        (lambda: LinearLaw([[1.0]], [[1.0, 0.0, 0.0]], [1.0], [0.0]), "law D = .*: must be 3 numbers"),
        (lambda: GOOD.replace(A=[[float("nan")]]), "law A = .*: all 1 by 1 numbers must be finite"),
        (lambda: GOOD.replace(A="x"), "law A = 'x': must be 1 by 1 numbers"),
        (lambda: GOOD.replace(holds=("integral",)), "law holds = 'integral': the law has no such state; it has x1"),
        (lambda: GOOD.replace(on="screw"), 'law on = \'screw\': must be "load" or "motor"'),
        (lambda: GOOD.replace(ratio=-0.1), "law ratio = -0.1 m/rad: must be finite and greater than 0"),
        (lambda: GOOD.replace(leave=0.5), "law leave = 0.5: must be at least enter = 1.0"),
        (lambda: GOOD.replace(voltage_limit=0.0), "law voltage_limit = 0.0: must be finite and positive"),
        (lambda: GOOD.replace(sample_rate=None), "law sample_rate = None: discrete matrices need their rate in Hz"),
        (lambda: GOOD.replace(sample_rate=None, discrete=False).parameters(), "the tick needs a rate in Hz"),
        (lambda: GOOD.replace(Kp=1.0), "law has no value named 'Kp'"),
        (lambda: GOOD.parameters(-1.0), "tolerance = -1.0 m: must be finite and at least 0"),
        (lambda: LinearLaw.from_system(3.0), "must be a system of scipy.signal or python-control"),
        (
            lambda: LinearLaw.from_system(signal.StateSpace([[0.0]], [[1.0]], [[1.0], [2.0]], [[0.0], [0.0]])),
            "has 1 inputs and 2 outputs",
        ),
    ],
)
def test_refusals_are_one_sentence(make: object, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        make()  # type: ignore[operator]
