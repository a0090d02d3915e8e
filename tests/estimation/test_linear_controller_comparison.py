"""Is a window's command that of the cascade or the linear law that is stated for it? Windows of exact loops."""

from functools import cache

import numpy as np
import pytest
from twin_messages import message_of

from servotwin.control.gains import gains_of
from servotwin.estimation.controller import compare_controller
from servotwin.estimation.linear_controller import run_linear
from servotwin.estimation.window import Window
from servotwin.messages import Setting
from servotwin.plant.axis import Axis
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.twin.evidence_rows import rows
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.step import WindowArrival, step

AXIS = Axis.preset("two-mass-drive")
LAW = AXIS.controller
BEGIN, LENGTH, RATE = 29.5, 5.0, 2000.0
OTHER = {
    "velocity_gain": (0.5, LAW.replace(velocity_gain=0.5 * LAW.velocity_gain)),
    "position_gain": (0.5, LAW.replace(position_gain=0.5 * LAW.position_gain)),
    "integral gain": (3.0, LAW.replace(integral_time=LAW.integral_time / 3.0)),
}


@cache
def loop(law, tolerance=None):
    """A window of the drive under a law."""
    run = simulate(
        AXIS.replace(controller=law), 35.0, reference=SquareWave(0.1, 60.0), gap=0.02, tolerance=tolerance,
        sample_rate=RATE,
    )  # fmt: skip
    return Window.from_run(run, BEGIN, LENGTH)


def from_the_zone(law, integral):
    """A window of a cascade that begins at rest in a dead zone of 0.01 rad, which hides its integral until a step."""
    time = np.arange(6000) / RATE
    after = np.maximum(time - 0.2, 0.0)
    position = 0.005 + 0.2 * (1.0 - np.exp(-4.0 * after) * np.cos(8.0 * after))
    reference = np.where(time < 0.2, 0.0, 0.2)
    inputs, linear = np.column_stack([reference, position / law.ratio, position]), law.linear()
    first = linear.start(*inputs[0, 1:])
    states = tuple(x + integral * (name in linear.holds) for name, x in zip(linear.names, first.states, strict=False))
    start = first._replace(states=linear.padded(states), active=0.0)
    voltage = run_linear(linear.parameters(0.01), start, inputs)
    return Window(position, inputs[:, 1], voltage, reference, sample_rate=RATE)


@pytest.mark.parametrize(
    ("law", "tolerance"),
    [
        (LAW, None),
        (LAW, 0.01),
        (LAW.replace(integral_only=False), 0.01),
        (LAW.replace(enter=0.5, leave=1.5), 0.01),
        (LAW.replace(voltage_limit=20.0), None),
        (LAW.replace(velocity_feedforward=0.5, low_pass_hz=50.0, feedforward=0.5), None),
        (LAW.replace(notch_hz=20.0), None),
        (LAW.linear(), 0.01),
    ],
    ids=["own", "zone", "open zone", "hysteresis", "limited", "fed forward", "notch", "linear law"],
)
def test_a_cascade_explains_its_own_command_whatever_its_states_were_before(law, tolerance):
    made = compare_controller(loop(law, tolerance), law, tolerance or 0.0)
    assert made.agrees
    assert made.unexplained < 0.01 * made.swing
    assert made.sentence == ""


@pytest.mark.parametrize("integral", [-4.0, 4.0])
def test_an_integral_of_a_cascade_that_the_dead_zone_hides_until_a_limit_is_found(integral):
    law = LAW.replace(integral_only=False, voltage_limit=6.0, sample_rate=RATE)
    made = compare_controller(from_the_zone(law, integral), law, 0.01)
    assert made.agrees
    assert made.unexplained < 1e-6 * made.swing


@pytest.mark.parametrize("name", list(OTHER))
def test_another_loop_of_a_cascade_is_told_by_its_factor(name):
    factor, law = OTHER[name]
    made = compare_controller(loop(law), LAW, 0.0)
    assert not made.agrees
    assert made.factors == pytest.approx(
        {"velocity_gain": 1.0, "position_gain": 1.0, "integral gain": 1.0} | {name: factor}, rel=0.02
    )
    assert f"{name} {factor:g}" in made.sentence


def test_another_gain_of_a_linear_law_is_told():
    law = LAW.linear()
    made = compare_controller(loop(law.replace(gain=0.6)), law, 0.0)
    assert made.factors == pytest.approx({"gain": 0.6}, rel=0.02)


def test_a_command_that_is_recorded_two_samples_late_is_still_the_stated_laws():
    window = loop(LAW)
    late = np.concatenate([np.full(2, window.voltage[0]), window.voltage[:-2]])
    assert compare_controller(window.replace(voltage=late), LAW, 0.0).agrees


def test_a_law_whose_ticks_are_slower_than_the_window_is_compared_at_its_ticks():
    run = simulate(AXIS, 35.0, reference=SquareWave(0.1, 60.0), gap=0.02, sample_rate=4.0 * RATE)
    window = Window.from_run(run, BEGIN + 1.0 / (4.0 * RATE), LENGTH)
    for law in (LAW, LAW.linear()):
        made = compare_controller(window, law, 0.0)
        assert made.agrees
        assert made.unexplained < 1e-6 * made.swing


def test_a_law_in_ticks_of_another_rate_or_a_window_without_angle_is_not_compared():
    window = loop(LAW)
    other = LAW.replace(sample_rate=500.0).linear()
    assert compare_controller(window, other, 0.0) is None
    blind = Window(window.position, voltage=window.voltage, reference=window.reference, sample_rate=RATE)
    assert compare_controller(blind, LAW, 0.0) is None


def alarms_under(law):
    """Alarms and settings of a twin of the drive after two windows under a law."""
    settings = TwinSettings(policy="paper", k_dz=0.0)
    model = TwinModel.of(AXIS, settings, start=Setting.of(0.0, gains_of(LAW)))
    state, said = model.initial_state("axis"), []
    for number in range(2):
        arrival = WindowArrival(message_of(loop(law), number, start=10.0 * number), 10.0 * number)
        result = step(model, state, arrival, 10.0 * number)
        state = result.state
        said += [row.status for row in rows(result.evidence, 1, "") if row.kind == "alarm"]
    return said, state.other_controller


@pytest.mark.slow
def test_a_twin_says_that_another_velocity_loop_runs_and_nothing_where_its_own_does():
    said, count = alarms_under(OTHER["velocity_gain"][1])
    assert count == 2
    assert any("voltage is not that of the stated controller" in each and "velocity_gain 0.5" in each for each in said)
    said, count = alarms_under(LAW)
    assert count == 0
    assert not any("stated controller" in each for each in said)
