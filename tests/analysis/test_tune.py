"""Tuning: the paper's factorisation, exact specifications, Nyquist against poles, refusals."""

import json
import math

import numpy as np
import pytest
from exploration import examples
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scaling import AxisUnits, scaled_axis
from typer.testing import CliRunner

from servotwin.analysis.tuning import candidates
from servotwin.analysis.tuning.candidates import CONTROLLER_TYPES, Factors
from servotwin.analysis.tuning.response import FrequencyData, Plant, nyquist_stable
from servotwin.analysis.tuning.setpoint import overshoot, prefilter
from servotwin.analysis.tuning.tune import Specification, evaluate, tune
from servotwin.cli import app as cli
from servotwin.control.controller import Controller
from servotwin.design import tune as tune_plant
from servotwin.errors import InvalidInput
from servotwin.plant import linear, loop
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Samples
from servotwin.simulation.simulate import simulate

PAPER = Servo.preset("paper")
FIRST = PAPER.margins().gain_crossovers[0]


def test_the_printed_gains_have_the_stated_factors():
    gain = 1.0 / abs(PAPER.plant().response(10.0))
    again = Factors(gain, 10.0, math.radians(59.833), math.radians(0.470), math.radians(45.0), True).controller()
    # The crossover is 9.9996, not 10; the smaller angle has three digits.
    for name, digits in (("Kp", 1e-3), ("Ki", 2e-3), ("Kd", 1e-3), ("Tf", 1e-9)):
        assert getattr(again, name) == pytest.approx(getattr(PAPER.controller, name), rel=digits)


def test_the_tuner_is_at_least_as_good_as_the_paper_by_both_its_criteria():
    paper = PAPER.margins()
    specification = Specification(FIRST.omega, FIRST.phase_margin)
    smallest = tune(PAPER.plant(), specification)
    assert smallest.margins.Ms < 0.9 * paper.Ms
    bounded = Specification(FIRST.omega, FIRST.phase_margin, Ms_max=paper.Ms, prefer="Ki")
    largest = tune(PAPER.plant(), bounded)
    assert largest.margins.Ms <= paper.Ms
    assert largest.controller.Ki > PAPER.controller.Ki
    for one in (smallest, largest):
        crossovers = one.margins.gain_crossovers
        assert len(crossovers) == 3
        assert crossovers[0].omega == pytest.approx(FIRST.omega, rel=1e-9)
        assert crossovers[0].phase_margin == pytest.approx(FIRST.phase_margin, abs=1e-9)


def lag_plant() -> linear.LinearSystem:
    return linear.series(linear.lag(2.0, 0.5), linear.series(linear.lag(1.0, 0.1), linear.lag(1.0, 0.02)))


@pytest.mark.parametrize("kind", [kind for kind in CONTROLLER_TYPES if kind != "P"])
@pytest.mark.parametrize("gain", [1.0, -1.0])
def test_every_type_meets_its_specification(kind, gain):
    system = linear.series(linear.gain(gain), lag_plant())
    specification = Specification(6.0, math.radians(62.0 if kind in ("PI", "PID", "PIDF") else 85.0), kind)
    found = tune(system, specification)
    nearest = min(found.margins.gain_crossovers, key=lambda x: abs(x.omega - 6.0))
    assert nearest.omega == pytest.approx(6.0, rel=1e-9)
    assert nearest.phase_margin == pytest.approx(specification.phase_margin, abs=1e-9)
    assert found.margins.stable
    law = found.controller
    assert (law.Ki != 0.0) is CONTROLLER_TYPES[kind].integral
    assert math.copysign(1.0, law.Kp) == gain or kind == "PDF"
    if kind == "PI":
        assert law.Kd == 0.0


def test_a_proportional_controller_takes_the_margin_it_gets():
    system = lag_plant()
    found = tune(system, Specification(6.0, math.radians(40.0), "P"))
    assert found.controller.Kp == pytest.approx(1.0 / abs(system.response(6.0)), rel=1e-12)
    assert found.margins.gain_crossovers[0].phase_margin > math.radians(40.0)
    with pytest.raises(InvalidInput, match="turns it not at all"):
        tune(system, Specification(6.0, math.radians(100.0), "P"))


@pytest.mark.slow
@given(
    st.floats(1.0, 8.0),
    st.floats(20.0, 80.0),
    st.sampled_from(["PI", "PIDF", "PDF"]),
)
@examples(25)
def test_the_returned_controller_is_stable_and_meets_its_specification(crossover, margin_deg, kind):
    try:
        found = tune(PAPER.plant(), Specification(crossover, math.radians(margin_deg), kind))
    except InvalidInput:
        assume(False)
    judge = PAPER.margins(found.controller)
    assert judge.stable
    nearest = min(judge.gain_crossovers, key=lambda x: abs(x.omega - crossover))
    assert nearest.omega == pytest.approx(crossover, rel=1e-8)
    assert math.degrees(nearest.phase_margin) == pytest.approx(margin_deg, abs=1e-6)


@given(st.floats(1.0, 15.0), st.floats(0.1, 1.5), st.floats(0.0, 1.0), st.floats(0.1, 1.4))
@examples(60)
def test_nyquist_agrees_with_the_poles(wc, phz, share, al):
    factors = Factors(1.0 / abs(PAPER.plant().response(wc)), wc, phz, share * phz, al, True)
    poles = PAPER.closed_loop(factors.controller()).poles()
    assume(abs(np.max(poles.real)) > 1e-3)
    plant = Plant(PAPER.plant())
    omega = plant.search_frequencies(wc)
    loops = (factors.response(omega) * plant.response(omega))[None, :]
    assert bool(nyquist_stable(loops, plant.integrators + 1)[0]) is bool(np.max(poles.real) < 0.0)


@given(st.floats(0.5, 20.0), st.floats(0.05, 1.5), st.floats(0.0, 1.0), st.floats(0.05, 1.5))
@example(1.0, 1.0, 1.0, 1.0)
@example(7.0, 0.3, 1.0, 0.3)
@example(1.0, 1.0, 1e-300, 1.0)
def test_factors_are_those_of_their_gains(wc, phz, share, al):
    factors = Factors(3.0, wc, phz, share * phz, al, True)
    omega = np.logspace(-1, 3, 20)
    np.testing.assert_allclose(loop.pidf(factors.controller()).response(omega), factors.response(omega), rtol=1e-9)


def test_frequency_data_give_what_the_system_gives():
    system = PAPER.plant()
    omega = np.unique(np.concatenate([np.geomspace(1e-3, 1e4, 3000), np.linspace(5.0, 100.0, 4000)]))
    specification = Specification(4.2, math.radians(60.0))
    data = tune(FrequencyData(omega, system.response(omega), integrators=1), specification)
    exact = tune(system, specification)
    assert data.margins.stable
    assert data.margins.Ms == pytest.approx(exact.margins.Ms, rel=0.01)
    assert data.margins.gain_crossovers[0].omega == pytest.approx(4.2, rel=1e-6)


def test_a_delay_is_a_turn_of_the_phase_and_stays_stable():
    delay, specification = 0.02, Specification(4.2, math.radians(60.0))
    found = tune(PAPER.plant(), specification, delay)
    without = evaluate(PAPER.plant(), found.controller).gain_crossovers[0]
    assert without.phase_margin == pytest.approx(specification.phase_margin + 4.2 * delay, abs=1e-9)
    assert found.margins.gain_crossovers[0].phase_margin == pytest.approx(specification.phase_margin, abs=1e-9)
    assert found.margins.stable
    long = min(x.phase_margin / x.omega for x in found.margins.gain_crossovers if x.phase_margin > 0.0)
    assert not evaluate(PAPER.plant(), found.controller, delay + 1.05 * long).stable
    assert evaluate(PAPER.plant(), found.controller, delay + 0.95 * long).stable


def test_margins_without_polynomials_against_those_with():
    near, exact = evaluate(PAPER.plant(), PAPER.controller, delay=1e-12), PAPER.margins()
    assert [x.omega for x in near.gain_crossovers] == pytest.approx([x.omega for x in exact.gain_crossovers], rel=1e-8)
    assert near.phase_crossovers[0].gain_margin == pytest.approx(exact.phase_crossovers[0].gain_margin, rel=1e-6)
    assert near.Ms == pytest.approx(exact.Ms, rel=1e-6)


def test_dead_zone_and_limits_are_kept():
    like = PAPER.controller.replace(enter=0.5, leave=1.5, voltage_limit=24.0)
    found = tune(PAPER.plant(), Specification(4.2, math.radians(60.0)), like=like).controller
    assert (found.enter, found.leave, found.voltage_limit) == (0.5, 1.5, 24.0)


def unstable() -> linear.LinearSystem:
    return linear.LinearSystem(np.array([[1.0]]), np.ones(1), np.ones(1), 0.0, np.array([1.0]), np.array([-1.0, 1.0]))


@pytest.mark.parametrize(
    ("system", "specification", "message"),
    [
        (unstable(), (1.0, 60.0, "PI"), "has a pole at 1"),
        (PAPER.plant(), (10.0, 60.0, "PD"), "cannot be reached at 10 rad/s"),
        (PAPER.plant(), (10.0, 60.0, "PIDF"), "no stable PIDF controller"),
        (FrequencyData([1.0, 2.0, 3.0, 4.0], [1.0, 0.5, 0.3, 0.2]), (9.0, 60.0, "PI"), "1 to 4 rad/s"),
    ],
)
def test_an_unreachable_specification_is_refused_with_the_reason(system, specification, message):
    with pytest.raises(InvalidInput, match=message):
        tune(system, Specification(specification[0], math.radians(specification[1]), specification[2]))


def test_an_unreachable_sensitivity_names_the_one_that_can_be_had():
    with pytest.raises(InvalidInput, match=r"reaches there is 1\.597"):
        tune(PAPER.plant(), Specification(4.2, math.radians(60.0), Ms_max=1.2))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"crossover": 0.0}, "crossover = 0.0 rad/s"),
        ({"phase_margin": math.pi}, "phase margin = 180 deg"),
        ({"kind": "PIFD"}, "did you mean 'PID'"),
        ({"Ms_max": 1.0}, "Ms_max = 1.0"),
        ({"prefer": "Kd"}, "prefer = 'Kd'"),
    ],
)
def test_specifications_are_checked(changes, message):
    with pytest.raises(InvalidInput, match=message):
        Specification(**({"crossover": 4.2, "phase_margin": 1.0} | changes))


def test_setpoint_weights_equal_the_law_that_weighs():
    """F C = C_r, and with all weights one there is no filter."""
    law, omega = PAPER.controller, np.logspace(-1, 3, 30)
    s = 1j * omega
    above = 0.3 * law.Kp + law.Ki / s + 0.1 * law.Kd * s / (law.Tf * s + 1.0)
    np.testing.assert_allclose(prefilter(law, 0.3, 0.1).response(omega) * loop.pidf(law).response(omega), above)
    np.testing.assert_allclose(prefilter(law, 1.0, 1.0).response(omega), 1.0)


def test_setpoint_weights_calm_the_step_and_leave_the_end():
    tuned = tune(PAPER.plant(), Specification(FIRST.omega, FIRST.phase_margin)).controller
    assert overshoot(PAPER, tuned, 0.2, 0.2) < 0.7 * overshoot(PAPER, tuned)
    times = np.arange(8001) / 1000.0
    reference = Samples(times.tolist(), (1e-3 * prefilter(tuned, 0.2, 0.2).step(times)).tolist())
    run = simulate(PAPER, 8.0, controller=tuned, reference=reference, sample_rate=1000.0)
    assert np.max(run.position) / 1e-3 - 1.0 == pytest.approx(overshoot(PAPER, tuned, 0.2, 0.2), abs=0.01)
    assert run.position[-1] == pytest.approx(1e-3, rel=0.02)


@pytest.mark.parametrize(
    ("law", "weights", "message"),
    [
        (PAPER.controller, (1.5, 1.0), "weight b = 1.5"),
        (PAPER.controller.replace(Ki=0.0), (0.5, 0.5), "integral action"),
        (Controller(1.0, -1.0, 0.0, 1.0), (0.5, 0.5), "zeros are stable"),
        (Controller(1.0, 1.0, -1.0, 1.0), (0.5, 0.0), "only c = b"),
    ],
)
def test_weights_are_checked(law, weights, message):
    with pytest.raises(InvalidInput, match=message):
        prefilter(law, *weights)


def run(*arguments):
    return CliRunner().invoke(cli.app, ["tune", *map(str, arguments)])


def test_the_command_prints_gains_and_every_crossover():
    result = run(9.9996, 14.498)
    assert result.exit_code == 0
    for message in ("tuned", "present", "4.6111", "24.8765 rad/s", "28.4648 rad/s", "overshoot"):
        assert message in result.output


def test_the_command_as_json():
    found = json.loads(run(4.2, 60, "--b", 0.2, "--json").output)
    assert found["crossovers"][0]["omega"] == pytest.approx(4.2, rel=1e-9)
    assert found["overshoot_weighted"] < found["overshoot"]
    assert json.loads(run(4.2, 60, "--delay-ms", 5, "--json").output)["overshoot"] is None


@pytest.mark.parametrize(
    "arguments", [(10, 60), (10, 60, "--type", "PD"), (-1, 60), (4.2, 60, "--ms-max", 1.1), (4, 600)]
)
def test_a_user_error_is_one_sentence_and_exit_code_2(arguments):
    result = run("--", *arguments) if arguments[0] == -1 else run(*arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")
    assert "rad" not in result.stderr.replace("rad/s", "")  # the arguments are in degrees


@pytest.mark.parametrize(
    ("name", "crossover", "margin_deg", "Ms"),
    [("stepper-stage", 20.0, 60.0, 1.06), ("stepper-stage", 2.4, 30.0, 2.1), ("telescope", 0.31, 45.0, 1.32)],
)
def test_gains_do_not_cancel_one_another(name, crossover, margin_deg, Ms):
    """A lag by a filter far below the crossover has a Kp and a Kd / Tf that are thousands of times its gain there."""
    axis = Axis.preset(name).replace(sample_rate=None)
    law = tune(axis.plant(), Specification(crossover, math.radians(margin_deg))).controller
    found = axis.replace(controller=law).margins()
    at = loop.pidf(law).response([crossover])[0]
    assert abs(law.Kp) + abs(law.Kd) / law.Tf <= 10.01 * abs(at)
    assert found.gain_crossovers[0].omega == pytest.approx(crossover)
    assert found.Ms < Ms


def test_a_margin_that_only_cancelling_gains_give_is_refused_with_the_reason(monkeypatch):
    monkeypatch.setattr(candidates, "_MOST_CANCELLATION", 0.5)
    with pytest.raises(InvalidInput, match=r"60 deg without Kp and Kd / Tf that act .* over 0\.5 times its"):
        tune(Axis.preset("stepper-stage").plant(), Specification(20.0, math.radians(60.0)))


@pytest.mark.parametrize("stated", [None, 0.7])
def test_the_release_time_is_that_of_the_new_loop_unless_it_is_stated(tmp_path, stated):
    axis = Axis.preset("gantry")
    old, new = tmp_path / "old.toml", tmp_path / "new.toml"
    old.write_text(axis.replace(release_time=stated).dumps())
    assert run(4.0, 60, "--servo", old, "--output", new).exit_code == 0
    tuned = Axis.from_file(new)
    assert tuned.pidf.Kp != axis.pidf.Kp
    assert tuned.pidf.release == (stated or pytest.approx(5.0 / 4.0, rel=1e-6))


@pytest.mark.parametrize("time", [2.0**-10, 2.0**10])
def test_margins_of_a_loop_with_a_delay_are_the_same_in_another_unit_of_time(time):
    axis = Axis.preset("ball-screw")
    slower = scaled_axis(axis, AxisUnits(time=time))
    one, other = (
        tune_plant(plant, 60.0 / unit, math.radians(55.0), delay=2e-4 * unit).margins
        for plant, unit in ((axis, 1.0), (slower, time))
    )
    assert other.Ms == pytest.approx(one.Ms, rel=1e-9)
    assert len(other.phase_crossovers) == len(one.phase_crossovers) > 1


@pytest.mark.parametrize(
    ("name", "units"),
    [
        ("telescope", AxisUnits(time=2.0**10)),
        ("robot-joint", AxisUnits(time=2.0**-10, torque=2.0**6)),
        ("stepper-stage", AxisUnits(time=2.0**10, length=2.0**-20)),
    ],
)
def test_an_axis_is_tuned_alike_in_other_units(name, units):
    axis = Axis.preset(name)
    crossover = axis.margins().gain_crossovers[0].omega
    one, other = (
        tune_plant(plant, crossover / time, math.radians(55.0))
        for plant, time in ((axis, 1.0), (scaled_axis(axis, units), units.time))
    )
    assert other.factors.al == pytest.approx(one.factors.al, rel=1e-6)
    assert other.margins.Ms == pytest.approx(one.margins.Ms, rel=1e-6)
    assert other.controller.Ki * (units.time * one.controller.Kp) == pytest.approx(
        one.controller.Ki * other.controller.Kp, rel=1e-6
    )
