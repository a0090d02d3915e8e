"""The industrial cascade as a linear law: its transfer functions, its tick, its dead zone, refusals."""

import math

import numpy as np
import pytest

from servotwin.control.cascade import Cascade
from servotwin.control.linear_law import INPUTS
from servotwin.control.linear_tick import linear_tick
from servotwin.errors import InvalidInput

DRIVE = Cascade(
    position_gain=12.0, ratio=0.1, velocity_gain=3.0, integral_time=0.05, speed_filter=2e-3, velocity_feedforward=0.9,
    acceleration_feedforward=0.4, reference_filter=4e-3, notch_hz=45.0, notch_damping=0.4, notch_depth=0.2,
    low_pass_hz=200.0,
)  # fmt: skip


def responses(cascade: Cascade, omega: float) -> list[complex]:
    """Command per reference, motor's angle and load's position at a frequency, by the law's matrices."""
    law = cascade.linear()
    A, B, C, D = (np.array(each) for each in (law.A, law.B, law.C, law.D))
    return list(C @ np.linalg.solve(1j * omega * np.eye(law.n) - A, B) + D)


@pytest.mark.parametrize("on", ["load", "motor"])
@pytest.mark.parametrize("omega", [0.3, 20.0, 2.0 * math.pi * 45.0, 3000.0])
def test_its_transfer_functions_are_the_textbook_s(on: str, omega: float) -> None:
    c, s = DRIVE.replace(on=on), 1j * omega
    w = 2.0 * math.pi * 45.0
    notch = (s * s + 2 * 0.4 * 0.2 * w * s + w * w) / (s * s + 2 * 0.4 * w * s + w * w)
    behind = notch / (s / (2.0 * math.pi * 200.0) + 1.0)
    regulator = 3.0 * (1.0 + 1.0 / (0.05 * s)) * behind
    slow = 1.0 / (4e-3 * s + 1.0) ** 2
    reference = regulator * (12.0 / 0.1 + 0.9 / 0.1 * s * slow) + 0.4 / 0.1 * s * s * slow * behind
    speed = -regulator * s / (2e-3 * s + 1.0)
    position = -regulator * 12.0 / 0.1
    expected = [reference, speed, position] if on == "load" else [reference, speed + 0.1 * position, 0.0]
    assert responses(c, omega) == pytest.approx(expected, rel=1e-9)


def test_a_ramp_is_fed_forward_as_its_speed() -> None:
    """A drive in velocity mode: with all feedforward, the speed command is the ramp's speed over the ratio."""
    law = Cascade(0.0, 0.1, velocity_feedforward=1.0, sample_rate=1e3).linear()
    parameters, state = law.parameters(), law.start(0.0, 0.0)
    for k in range(400):
        state = linear_tick(parameters, state, 0.02 * k * 1e-3, 0.0, 0.0)
    assert state.command == pytest.approx(0.02 / 0.1, rel=1e-9)


def test_the_dead_zone_stops_the_velocity_integral() -> None:
    law = DRIVE.replace(sample_rate=2e3).linear()
    parameters, state = law.parameters(1e-3), law.start(0.0, 0.0)
    for _ in range(50):
        state = linear_tick(parameters, state, 2e-3, 0.0, 0.0)
    place = law.names.index("integral")
    stopped = state.states[place]
    for _ in range(2000):
        state = linear_tick(parameters, state, 0.5e-3, 0.0, 0.0)
    assert state.states[place] == stopped != 0.0
    # The notch passes what is constant; the low-pass too.
    assert state.command == pytest.approx(3.0 * 12.0 * 0.5e-3 / 0.1 + stopped, rel=1e-9)


@pytest.mark.parametrize("on", ["load", "motor"])
@pytest.mark.parametrize("rate", [None, 2e3])
def test_an_open_dead_zone_leaves_the_velocity_loop(on: str, rate: float | None) -> None:
    """Inside, all that is left is the velocity PI on a speed command of what the reference feeds forward."""
    cascade = DRIVE.replace(on=on, sample_rate=rate, integral_only=False)
    inside, still = cascade.linear().inside(), cascade.replace(position_gain=0.0).linear()
    assert (inside.A, inside.B, inside.C, inside.D) == (still.A, still.B, still.C, still.D)
    assert inside.windup == cascade.linear().windup


def test_an_open_dead_zone_brakes_the_motor() -> None:
    law = Cascade(12.0, 0.1, velocity_gain=3.0, speed_filter=2e-3, sample_rate=2e3, integral_only=False).linear()
    parameters, state = law.parameters(1e-3), law.start(0.0, 0.0)
    for k in range(400):
        state = linear_tick(parameters, state, 0.5e-3, 0.7 * k / 2e3, 0.0)
    assert state.command == pytest.approx(-3.0 * 0.7, rel=1e-9)


def test_the_integral_winds_back_at_the_limit() -> None:
    """Behind a long saturation the command leaves the limit within a few tracking times of the error's change."""
    law = Cascade(
        10.0, 1.0, velocity_gain=2.0, integral_time=0.1, voltage_limit=1.0, tracking_time=0.02, sample_rate=1e3
    )
    bare = law.linear().replace(windup=(0.0, 0.0))
    ticks = []
    for each in (law.linear(), bare):
        parameters, state = each.parameters(), each.start(0.0, 0.0)
        for _ in range(2000):
            state = linear_tick(parameters, state, 1.0, 0.0, 0.0)
        assert state.command == 1.0
        ticks.append(0)
        while state.command > 0.0:
            state = linear_tick(parameters, state, -0.1, 0.0, 0.0)
            ticks[-1] += 1
    assert ticks[0] < 100 < 10_000 < ticks[1]


def test_gains_change_without_a_bump_and_the_integral_goes_on() -> None:
    old = DRIVE.replace(sample_rate=2e3).linear()
    new = DRIVE.replace(sample_rate=2e3, position_gain=7.0, velocity_gain=4.0, notch_hz=None).linear()
    state, rng = old.start(0.0, 0.0), np.random.default_rng(4)
    for row in (1e-3 * rng.normal(size=(100, 3))).tolist():
        state = linear_tick(old.parameters(), state, *row)
    due = (1e-3, 0.02, 0.3e-3)
    moved = new.transfer(old, state, due, (None, None))
    commands = [linear_tick(law.parameters(), each, *due).command for law, each in ((old, state), (new, moved))]
    assert commands[1] == pytest.approx(commands[0], abs=1e-12)
    assert moved.states[new.names.index("integral")] == state.states[old.names.index("integral")]


def test_inputs_keep_their_order() -> None:
    assert INPUTS == ("reference", "y_motor", "y_load")
    assert DRIVE.linear().reads("y_load")
    assert not DRIVE.replace(on="motor").linear().reads("y_load")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DRIVE.replace(ratio=0.0), "cascade ratio = 0.0 m/rad: must be "),
        (lambda: DRIVE.replace(position_gain=-1.0), "cascade position_gain = -1.0 1/s: must be "),
        (lambda: DRIVE.replace(on="screw"), "cascade on = 'screw': must be one of load, motor"),
        (lambda: DRIVE.replace(leave=0.1), "cascade leave = 0.1 tolerances: must be at least enter = 1.0"),
        (lambda: DRIVE.replace(velocity_gain=None), "cascade integral_time = 0.05: needs a velocity loop"),
        (lambda: DRIVE.replace(Kp=1.0), "cascade has no value named 'Kp'"),
        (lambda: DRIVE.replace(rate_limit=5.0).linear(), "law rate_limit = 5.0 1/s: needs a sampled law"),
        (lambda: DRIVE.linear().parameters(), "law sample_rate = None: the tick needs a rate in Hz"),
    ],
)
def test_refusals_are_one_sentence(make: object, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        make()  # type: ignore[operator]
