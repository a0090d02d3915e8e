"""Margins of the paper's loops (errata E1, E11, E12), and python-control as an independent judge."""

import math
import warnings

import control
import numpy as np
import pytest
from exploration import examples, explored
from hypothesis import given
from hypothesis import strategies as st

from servotwin.plant import linear
from servotwin.plant import loop as loops
from servotwin.plant.axis import Axis
from servotwin.plant.linear import LinearSystem
from servotwin.plant.margins import Margins, bandwidth, gain_crossovers, margins, peak, sensitivity_peak
from servotwin.plant.servo import Servo


def degrees(found: Margins) -> list[float]:
    return [math.degrees(crossover.phase_margin) for crossover in found.gain_crossovers]


def omegas(found: Margins) -> list[float]:
    return [crossover.omega for crossover in found.gain_crossovers]


def test_table1_as_printed_misses_the_stated_crossover() -> None:
    servo = Servo.preset("table1")
    found = servo.margins()
    assert abs(servo.loop().response(10.0)) == pytest.approx(0.49997, abs=5e-6)
    assert omegas(found) == pytest.approx([6.3311], abs=5e-5)
    assert degrees(found) == pytest.approx([15.04], abs=5e-3)
    assert found.bandwidth == pytest.approx(11.32, abs=5e-3)
    assert found.stable


@pytest.mark.parametrize("preset", ["paper", "paper-gain2"])
def test_twice_the_loop_gain_meets_it(preset: str) -> None:
    found = Servo.preset(preset).margins()
    assert omegas(found) == pytest.approx([9.9996, 24.9, 28.5], abs=0.05)
    assert omegas(found)[0] == pytest.approx(9.9996, abs=5e-5)
    assert degrees(found)[0] == pytest.approx(14.498, abs=5e-4)
    assert found.bandwidth == pytest.approx(27.85, abs=5e-3)
    assert found.Ms == pytest.approx(4.6, abs=0.05)
    assert found.stable


def test_the_loop_filter_costs_phase() -> None:
    servo = Servo.preset("paper")
    found = servo.margins(servo.controller.replace(loop_filter_hz=20.0))
    assert degrees(found)[0] == pytest.approx(9.970, abs=5e-4)


def test_every_crossover_is_one_to_rounding() -> None:
    loop = Servo.preset("paper").loop()
    for crossover in gain_crossovers(loop):
        assert abs(loop.response(crossover.omega)) == pytest.approx(1.0, abs=1e-13)


def test_phase_crossover_is_the_gain_that_destabilises() -> None:
    servo = Servo.preset("paper")
    (crossover,) = servo.margins().phase_crossovers
    law = servo.controller
    for factor, stable in ((1.0 - 1e-6, True), (1.0 + 1e-6, False)):
        gain = factor * crossover.gain_margin
        scaled = law.replace(Kp=law.Kp * gain, Ki=law.Ki * gain, Kd=law.Kd * gain)
        assert servo.closed_loop(scaled).is_stable() is stable


def test_phase_margin_is_the_delay_that_destabilises() -> None:
    """A long Pade chain as delay: just below the margin stable, just above not."""
    servo = Servo.preset("paper")
    first = servo.margins().gain_crossovers[0]
    delay = first.phase_margin / first.omega
    loop = servo.loop().to_control()
    for factor, stable in ((0.995, True), (1.005, False)):
        late = control.tf2ss(*control.pade(factor * delay, 4))
        poles = control.feedback(late * loop, 1).poles()
        assert bool(np.max(poles.real) < 0.0) is stable


@st.composite
def servos(draw: st.DrawFn) -> Servo:
    n = draw(st.sampled_from([2, 3, 5]))
    servo = Servo.preset("paper").replace(
        n=n,
        m=tuple(draw(st.floats(1.0, 10.0)) for _ in range(n)),
        k=tuple(draw(st.floats(5e3, 2e4)) for _ in range(n)),
        k_d=draw(st.sampled_from([math.inf, 1e6])),
    )
    gains = {name: getattr(servo.controller, name) * draw(st.floats(0.2, 1.5)) for name in ("Kp", "Ki", "Kd", "Tf")}
    return servo.replace(**gains)


@pytest.mark.slow
@examples(25)
@given(servos(), st.sampled_from([None, 20.0]))
def test_crossovers_and_margins_against_python_control(servo: Servo, filter_hz: float | None) -> None:
    law = servo.controller.replace(loop_filter_hz=filter_hz)
    found = servo.margins(law)
    judge = control.tf(servo.loop(law).numerator[::-1], servo.loop(law).denominator[::-1])
    gain_margins, phase_margins, _, phase_omegas, gain_omegas, _ = control.stability_margins(judge, returnall=True)
    assert omegas(found) == pytest.approx(sorted(gain_omegas), rel=1e-6)
    expected = [margin for _, margin in sorted(zip(gain_omegas, phase_margins, strict=True))]
    assert degrees(found) == pytest.approx(expected, abs=1e-4)
    mine = [(x.omega, x.gain_margin) for x in found.phase_crossovers]
    theirs = sorted((w, g) for w, g in zip(phase_omegas, gain_margins, strict=True) if 0.0 < w < math.inf)
    assert np.ravel(mine) == pytest.approx(np.ravel(theirs), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "k_d"), explored([(40, math.inf), (40, 1e6), (100, math.inf), (100, 1e6)], 0, 1))
def test_a_long_chain_has_margins(n: int, k_d: float) -> None:
    """Its polynomials are lost to rounding, those of a hundred masses overflow; the matrices are not."""
    servo = Servo.preset("paper").replace(n=n, k_d=k_d)
    found, loop = servo.margins(), servo.loop()
    omega = np.geomspace(0.1, 200.0, 331)
    identity = np.eye(loop.B.size)
    values = np.array([loop.C @ np.linalg.solve(1j * w * identity - loop.A, loop.B) for w in omega])
    np.testing.assert_allclose(loop.response(omega), values, rtol=1e-6, atol=1e-9)
    places = np.flatnonzero(np.diff(np.abs(values) > 1.0))
    assert len(found.gain_crossovers) >= len(places) > 0
    for i in places:
        assert any(omega[i] <= crossover.omega <= omega[i + 1] for crossover in found.gain_crossovers)
    assert found.stable is bool(np.max(servo.closed_loop().poles().real) < 0.0)


@pytest.mark.slow
@examples(25)
@given(servos())
def test_responses_agree_in_both_forms_and_with_python_control(servo: Servo) -> None:
    omega = np.logspace(-1, 3, 41)
    for system in (servo.G1(), servo.G2(), servo.plant(), servo.loop(), servo.closed_loop()):
        judge = system.to_control()
        np.testing.assert_allclose(judge(1j * omega), system.response(omega), rtol=1e-6)


@pytest.mark.slow
@examples(25)
@given(servos())
def test_sensitivity_peak_against_a_fine_grid(servo: Servo) -> None:
    loop, found = servo.loop(), servo.margins()
    assert found.stable is math.isfinite(found.Ms)
    if not found.stable:
        return
    omega = np.unique(np.concatenate([np.logspace(-2, 3, 4001), found.Ms_omega * (1 + np.linspace(-1e-3, 1e-3, 201))]))
    seen = np.abs(1.0 / (1.0 + loop.response(omega)))
    assert np.max(seen) <= found.Ms * (1.0 + 1e-9)
    assert np.max(seen) >= found.Ms * (1.0 - 1e-6)


@pytest.mark.slow
@examples(25)
@given(servos())
def test_bandwidth_is_the_first_fall_by_3_db(servo: Servo) -> None:
    closed, width = servo.closed_loop(), servo.margins().bandwidth
    assert abs(closed.response(width)) == pytest.approx(math.sqrt(0.5), rel=1e-9)
    assert np.all(np.abs(closed.response(np.linspace(0.0, width * 0.9999, 4001))) > math.sqrt(0.5))


def test_stability_agrees_with_the_poles_of_python_control() -> None:
    servo = Servo.preset("paper")
    judge = control.feedback(servo.loop().to_control(), 1).poles()
    np.testing.assert_allclose(np.sort_complex(servo.closed_loop().poles()), np.sort_complex(judge), rtol=1e-8)


def test_step_against_python_control_and_zero_steady_state_error() -> None:
    closed = Servo.preset("paper").closed_loop()
    time = np.linspace(0.0, 20.0, 2001)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        judge = control.step_response(closed.to_control(), time).outputs
    np.testing.assert_allclose(closed.step(time), judge, atol=1e-8)
    assert closed.step(time)[-1] == pytest.approx(1.0, abs=1e-6)
    assert float(closed.response(0.0).real) == 1.0


def test_feedback_of_known_first_order_loop() -> None:
    loop = linear.integrator(4.0)
    closed = linear.feedback(loop, linear.gain(1.0))
    assert closed.poles() == pytest.approx([-4.0])
    assert bandwidth(closed) == pytest.approx(4.0, rel=1e-14)
    assert gain_crossovers(loop)[0].omega == pytest.approx(4.0, rel=1e-14)
    assert gain_crossovers(loop)[0].phase_margin == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("damping", [0.01, 0.1, 0.5])
def test_peak_of_a_resonance_in_closed_form(damping: float) -> None:
    numerator, denominator = np.array([9.0]), np.array([9.0, 6.0 * damping, 1.0])
    omega, value = peak(linear.realised(numerator, denominator))
    assert value == pytest.approx(1.0 / (2.0 * damping * math.sqrt(1.0 - damping**2)), rel=1e-9)
    assert omega == pytest.approx(3.0 * math.sqrt(1.0 - 2.0 * damping**2), rel=1e-4)


def test_a_loop_below_one_has_no_crossover() -> None:
    low = linear.lag(0.5, 1.0)
    assert gain_crossovers(low) == ()
    assert margins(low, linear.feedback(low, linear.gain(1.0))).Ms == pytest.approx(1.0, rel=1e-6)
    assert bandwidth(linear.gain(1.0)) == math.inf


def test_a_loop_without_gain_has_margins_without_a_word() -> None:
    """A stepper whose controller has no gain; and with one that is as good as none."""
    stepper = Axis.preset("stepper-stage")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = stepper.replace(Ki=0.0).margins()
        assert stepper.replace(Kp=1e-300).margins().Ms == pytest.approx(stepper.margins().Ms)
    assert (found.Ms, found.bandwidth, found.gain_crossovers, found.phase_crossovers) == (1.0, math.inf, (), ())


def test_pidf_with_terms_left_out() -> None:
    law = Servo.preset("paper").controller
    omega = np.array([0.1, 1.0, 10.0])
    s = 1j * omega
    for changes in ({}, {"Ki": 0.0}, {"Kd": 0.0}, {"Ki": 0.0, "Kd": 0.0}):
        some = law.replace(**changes)
        expected = some.Kp + some.Ki / s + some.Kd * s / (some.Tf * s + 1.0)
        system: LinearSystem = loops.pidf(some)
        np.testing.assert_allclose(system.response(omega), expected, rtol=1e-13)
        assert system.B.size == (some.Ki != 0.0) + (some.Kd != 0.0)


def test_a_stiff_screw_differs_from_the_rigid_one_by_the_load_on_the_motor() -> None:
    """The load that the paper neglects turns the motor's integrator into a slow pole, through the ground spring."""
    servo = Servo.preset("paper")
    rigid, stiffest = servo.plant().response(10.0), servo.replace(k_d=1e13).plant().response(10.0)
    errors = [abs(servo.replace(k_d=k_d).plant().response(10.0) / stiffest - 1.0) for k_d in (1e7, 1e9)]
    assert errors[1] == pytest.approx(errors[0] / 100.0, rel=1e-2)  # first order in 1 / k_d
    assert 0.01 < abs(stiffest / rigid - 1.0) < 0.02
    slowest = np.max(servo.replace(k_d=1e9).plant().poles().real)
    assert slowest == pytest.approx(-(servo.p**2) * servo.k * servo.R / (servo.k_T * servo.k_B), rel=0.01)


@pytest.mark.parametrize("preset", ["paper", "table1", "paper-gain2"])
def test_the_sensitivity_peak_alone_is_that_of_all_margins(preset):
    servo = Servo.preset(preset)
    assert sensitivity_peak(servo.loop(), servo.closed_loop()) == servo.margins().Ms
    unstable = servo.replace(Kp=1e3 * servo.controller.Kp)
    assert sensitivity_peak(unstable.loop(), unstable.closed_loop()) == math.inf


def test_states_in_units_many_powers_of_ten_apart_give_the_response_without_a_word() -> None:
    """An axis of nanometres in hours; scipy warned of what is an exact division by powers of two."""
    near = np.array([[-1.0, 2.0, 0.5], [0.3, -2.0, 1.0], [0.2, 0.7, -3.0]])
    units = np.array([1.0, 1e12, 1e-12])
    far = near * units[:, None] / units
    B, C, unknown = units * np.array([1.0, 0.0, 1.0]), np.array([0.0, 1.0, 1.0]) / units, np.full(4, np.inf)
    omega = np.geomspace(0.1, 10.0, 7)
    wanted = [C @ (units * np.linalg.solve(1j * w * np.eye(3) - near, B / units)) for w in omega]
    np.testing.assert_allclose(LinearSystem(far, B, C, 0.0, unknown, unknown).response(omega), wanted, rtol=1e-12)
