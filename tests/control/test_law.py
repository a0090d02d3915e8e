"""The tick: exactness, dead zone (erratum E16), limits, bumplessness, and the same bits interpreted and compiled."""

import random
from array import array
from dataclasses import replace
from itertools import pairwise
from math import exp, inf
from typing import Any

import numba
import numpy as np
import pytest
from exploration import extent
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from servotwin.control import Controller, LawParameters, LawState, start, tick, transfer

PAPER = Controller(Kp=1377.7, Ki=18907.6, Kd=-135.1, Tf=0.1, sample_rate=5000.0)
LIMITED = PAPER.replace(voltage_limit=4.0, rate_limit=1e3, loop_filter_hz=20.0, enter=0.6, leave=1.4)


def run(law: LawParameters, errors: list[float], state: LawState | None = None) -> list[LawState]:
    """States after each tick for a given error sequence, the measurement at zero."""
    states = []
    state = start(0.0) if state is None else state
    for error in errors:
        state = tick(law, state, error, 0.0)
        states.append(state)
    return states


def test_constant_error_gives_the_closed_form_step_response() -> None:
    error, rate = 3e-4, 5000.0
    voltages = [state.voltage for state in run(PAPER.law(), [error] * 5000)]
    times = [k / rate for k in range(5000)]
    exact = [error * (PAPER.Kp + PAPER.Ki * t + PAPER.Kd / PAPER.Tf * exp(-t / PAPER.Tf)) for t in times]
    assert voltages == pytest.approx(exact, rel=1e-11)


@pytest.mark.parametrize("rate", [50.0, 5000.0])
def test_held_random_errors_agree_with_scipy(rate: float) -> None:
    kp, ki, kd, tf = PAPER.Kp, PAPER.Ki, PAPER.Kd, PAPER.Tf
    numerator = [kp * tf + kd, kp + ki * tf, ki]
    a, b, c, d, _ = signal.cont2discrete(signal.tf2ss(numerator, [tf, 1.0, 0.0]), 1.0 / rate, method="zoh")
    errors = np.random.default_rng(3).normal(size=400) * 1e-3
    _, oracle, _ = signal.dlsim((a, b, c, d, 1.0 / rate), errors)
    law = PAPER.replace(sample_rate=rate).law()
    assert [s.voltage for s in run(law, errors.tolist())] == pytest.approx(oracle[:, 0].tolist(), rel=1e-9, abs=1e-9)


def test_loop_filter_is_the_exact_low_pass() -> None:
    law = PAPER.replace(loop_filter_hz=20.0).law()
    state = start(0.0)
    for k in range(1, 1000):
        state = tick(law, state, 0.0, 1.0)
        assert state.filtered == pytest.approx(1.0 - exp(-2.0 * np.pi * 20.0 * k / 5000.0), rel=1e-11)


def test_without_loop_filter_the_measurement_passes_unchanged() -> None:
    state = tick(PAPER.law(), start(1e8), 0.0, 1.2345e-9)
    assert state.filtered == 1.2345e-9


def test_inside_the_dead_zone_e16_holds() -> None:
    law = PAPER.law(1e-3)
    before = run(law, [2e-3] * 100)[-1]
    inside = run(law, [0.9e-3] * 500, before)
    assert {state.voltage for state in inside} == {0.0}
    assert {state.active for state in inside} == {0.0}
    assert {state.integral for state in inside} == {before.integral}
    assert inside[-1].derivative == pytest.approx(before.derivative * exp(-0.1 / PAPER.Tf), rel=1e-11)
    again = run(law, [-2e-3], inside[-1])[0]
    kick = PAPER.Kd / PAPER.Tf * (-2e-3 - inside[-1].derivative)
    assert again.voltage == pytest.approx(PAPER.Kp * -2e-3 + before.integral + kick, rel=1e-12)


def test_a_dead_zone_that_stops_the_integral_only() -> None:
    """Inside, the law is the one without integral action plus the integral as it was; outside it is the plain one."""
    errors = [2e-3] * 100 + [0.9e-3] * 400 + [-0.2e-3] * 300 + [-1.5e-3] * 200
    law, plain = PAPER.replace(integral_only=True).law(1e-3), PAPER.law(None)
    states = run(law, errors)
    stopped = states[99].integral
    assert {state.integral for state in states[100:800]} == {stopped}
    held = run(PAPER.replace(Ki=0.0).law(None), errors)
    inside = [state.voltage for state in states[100:800]]
    assert inside == pytest.approx([state.voltage + stopped for state in held[100:800]], rel=1e-12)
    assert states[:100] == run(plain, errors[:100])
    assert states[800:] == run(plain, errors[800:], states[799])


def test_a_step_of_the_reference_gives_the_pulse_of_the_velocity_feedforward() -> None:
    """It decays exponentially, and its area is the feedforward times the step; inside the dead zone it acts too."""
    step, gain, time, rate = 3e-4, 190.0, 0.02, 5000.0
    law = Controller(0.0, 0.0, 0.0, 0.1, sample_rate=rate, velocity_feedforward=gain, velocity_time=time)
    for tolerance in (None, 1e-3):
        voltages = [state.voltage for state in run(law.law(tolerance), [step] * 2000)]
        exact = [gain / time * step * exp(-k / (rate * time)) for k in range(2000)]
        assert voltages == pytest.approx(exact, rel=1e-9, abs=1e-13)
    assert sum(voltages) / rate == pytest.approx(gain * step, rel=6e-3)


def test_a_ramp_of_the_reference_is_fed_forward_in_proportion_to_its_speed() -> None:
    speed, rate = 0.02, 5000.0
    law = Controller(0.0, 0.0, 0.0, 0.1, sample_rate=rate, velocity_feedforward=190.0, velocity_time=0.02).law()
    voltages = [state.voltage for state in run(law, [speed * k / rate for k in range(2000)])]
    assert voltages[-1] == pytest.approx(190.0 * speed, rel=6e-3)


@pytest.mark.slow
def test_the_velocity_feedforward_starts_from_rest_and_ends_in_it() -> None:
    law = PAPER.replace(Ki=0.0, velocity_feedforward=190.0).law()
    assert tick(law, start(2e-3), 2e-3, 2e-3).voltage == 0.0
    state = tick(law, start(2e-3), 3e-3, 3e-3)
    assert state.voltage == pytest.approx(190.0 / 0.1 * 1e-3, rel=1e-12)
    for _ in range(400_000):
        state = tick(law, state, 3e-3, 3e-3)
    assert abs(state.voltage) < 1e-300


def test_outside_its_dead_zone_either_law_is_the_same() -> None:
    errors = [2e-3, -3e-3, 5e-3] * 20
    assert run(LIMITED.replace(integral_only=True).law(1e-3), errors) == run(LIMITED.law(1e-3), errors)


@given(integral=st.floats(-5.0, 5.0), change=st.floats(-5.0, 5.0), error=st.floats(-3e-3, 3e-3))
def test_a_new_feedforward_takes_over_what_the_integral_supplied(integral: float, change: float, error: float) -> None:
    """The voltage does not jump, and what the feedforward supplies from now on the integral gives up for good."""
    old = PAPER.replace(Ki=200.0, integral_only=True, feedforward=0.1)
    new = old.replace(feedforward=0.1 + change)
    state = start(0.0)._replace(integral=integral)
    moved = transfer(old.law(1e-3), new.law(1e-3), state, error, 0.0)
    before, after = (tick(law.law(1e-3), s, error, 0.0) for law, s in ((old, state), (new, moved)))
    assert after.voltage == pytest.approx(before.voltage, abs=1e-9)
    assert abs(moved.integral) <= abs(integral)
    assert moved.integral * integral >= 0.0
    if change * integral > 0.0 and abs(change) < abs(integral):
        assert abs(moved.offset) < 1e-12
        assert moved.integral + new.feedforward == pytest.approx(integral + old.feedforward, abs=1e-12)


def test_the_boundary_belongs_to_the_dead_zone() -> None:
    law = PAPER.law(1e-3)
    assert run(law, [1e-3])[0].active == 0.0
    assert run(law, [np.nextafter(1e-3, 1.0)])[0].active == 1.0


def test_hysteresis_opens_below_enter_and_closes_above_leave() -> None:
    law = PAPER.replace(enter=0.5, leave=1.5).law(1e-3)
    errors = [1.0e-3, 0.6e-3, 0.5e-3, 1.4e-3, -1.5e-3, -1.6e-3, -0.6e-3]
    assert [s.active for s in run(law, errors)] == [1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("tolerance", [None, 0.0])
def test_without_dead_zone_an_idle_law_wakes_up(tolerance: float | None) -> None:
    idle = LawState(5.0, 0.0, 0.0, 0.0, 0.0)
    state = tick(PAPER.law(tolerance), idle, 0.0, 0.0)
    assert (state.active, state.voltage) == (1.0, 5.0)


@pytest.mark.slow
def test_limits_hold_and_the_integral_does_not_wind_up() -> None:
    law = PAPER.replace(voltage_limit=2.0).law()
    saturated = run(law, [2e-3] * 20_000)
    assert max(abs(s.voltage) for s in saturated) == 2.0
    assert abs(saturated[-1].integral) < 5.0
    unlimited = run(PAPER.law(), [2e-3] * 20_000)
    assert unlimited[-1].integral > 100.0
    back = [s.voltage for s in run(law, [-2e-3] * 2000, saturated[-1])]
    assert next(k for k, voltage in enumerate(back) if voltage < 0.0) < 500


def test_rate_limit_bounds_every_change() -> None:
    law = PAPER.replace(rate_limit=100.0).law(1e-3)
    rng = random.Random(1)
    states = run(law, [rng.uniform(-3e-3, 3e-3) for _ in range(2000)])
    changes = [abs(b.voltage - a.voltage) for a, b in pairwise(states)]
    assert max(changes) <= 0.02 * (1 + 1e-12)


def test_a_voltage_that_ramps_down_inside_the_dead_zone_leaves_the_integral_alone() -> None:
    law = PAPER.replace(rate_limit=100.0, tracking_time=0.01).law(1e-3)
    before = run(law, [3e-3] * 100)[-1]
    inside = run(law, [0.5e-3] * 50, before)
    assert 0.0 < inside[-1].voltage < before.voltage
    assert {state.integral for state in inside} == {before.integral}


def test_without_limits_nothing_is_corrected() -> None:
    errors = [1e-3, -2e-3, 0.5e-3] * 50
    fast = run(PAPER.replace(tracking_time=1e-3).law(), errors)
    assert fast == run(PAPER.replace(tracking_time=1.0).law(), errors)


@given(ki=st.floats(-1e5, 1e5), error=st.floats(-1e-2, 1e-2))
def test_a_new_integral_gain_is_bumpless(ki: float, error: float) -> None:
    state = run(PAPER.law(), [1e-3, 2e-3, -1e-3] * 30)[-1]
    kept = tick(PAPER.law(), state, error, 0.0).voltage
    assert tick(PAPER.replace(Ki=ki).law(), state, error, 0.0).voltage == kept


def test_the_feedforward_is_added_at_all_times_and_the_limits_act_on_the_sum() -> None:
    law, plain = PAPER.replace(feedforward=0.25, voltage_limit=8.0).law(1e-3), PAPER.law(1e-3)
    assert {state.voltage for state in run(law, [0.9e-3] * 20)} == {0.25}
    assert run(law, [-2e-3])[0].voltage == run(plain, [-2e-3])[0].voltage + 0.25
    assert run(law, [2e-2] * 2000)[-1].voltage == 8.0


def test_the_offset_fades_with_the_release_time() -> None:
    law = PAPER.replace(release_time=0.25).law(1e-3)
    states = run(law, [0.0] * 5000, start(0.0)._replace(offset=0.7))
    assert states[0].voltage == 0.7
    assert [s.voltage for s in states] == pytest.approx([0.7 * exp(-k / 5000.0 / 0.25) for k in range(5000)], rel=1e-11)


_GAINS = st.tuples(st.floats(-5e3, 5e3), st.floats(-1e5, 1e5) | st.just(0.0), st.floats(-500.0, 500.0))


@given(
    gains=_GAINS,
    tf=st.floats(0.01, 1.0),
    feedforward=st.floats(-0.2, 0.2),
    tolerances=st.tuples(st.floats(0.0, 3e-3), st.floats(0.0, 3e-3)),
    inputs=st.tuples(st.floats(-5e-3, 5e-3), st.floats(-5e-3, 5e-3)),
    limited=st.booleans(),
)
def test_a_swap_leaves_the_voltage_where_it_is(
    gains: tuple[float, float, float],
    tf: float,
    feedforward: float,
    tolerances: tuple[float, float],
    inputs: tuple[float, float],
    limited: bool,
) -> None:
    first = LIMITED if limited else PAPER
    second = first.replace(**dict(zip(("Kp", "Ki", "Kd"), gains, strict=True)), Tf=tf, feedforward=feedforward)
    old, new = first.law(tolerances[0]), second.law(tolerances[1])
    state = run(old, [1e-3, 2e-3, -1e-3] * 30)[-1]
    moved = transfer(old, new, state, *inputs)
    assert tick(new, moved, *inputs).voltage == pytest.approx(tick(old, state, *inputs).voltage, abs=1e-9)


def test_a_swap_to_the_same_law_changes_nothing() -> None:
    law = PAPER.law(1e-3)
    state = run(law, [1e-3, 2e-3, 3e-4] * 30)[-1]._replace(offset=0.3)
    moved = transfer(law, law, state, 2e-3, 1e-3)
    assert moved._replace(offset=0.3) == state
    assert moved.offset == pytest.approx(0.3, abs=1e-13)


def test_voltage_of_the_old_law_beyond_its_limit_is_dropped() -> None:
    old, new = PAPER.replace(voltage_limit=4.0).law(), PAPER.replace(Kp=100.0, Ki=0.0, Kd=0.0, voltage_limit=4.0).law()
    moved = transfer(old, new, run(old, [0.1] * 10)[-1], 0.1, 0.0)
    assert moved.offset == pytest.approx(4.0 - 10.0, rel=1e-12)


def test_without_integral_action_the_integral_becomes_a_fading_offset() -> None:
    old, new = PAPER.law(), PAPER.replace(Ki=0.0, release_time=0.2).law()
    state = run(old, [1e-3] * 500)[-1]
    moved = transfer(old, new, state, 0.0, 0.0)
    assert (moved.integral, moved.offset) == (0.0, pytest.approx(state.integral, rel=1e-12))
    assert run(new, [0.0] * 20_000, moved)[-1].voltage == pytest.approx(0.0, abs=1e-8)


@given(power=st.integers(-40, 40), seed=st.integers(0, 10))
def test_the_law_is_homogeneous_bit_for_bit(power: int, seed: int) -> None:
    rng, scale = random.Random(seed), 2.0**power
    errors = [rng.uniform(-3e-3, 3e-3) for _ in range(50)]
    plain = run(PAPER.law(1e-3), errors)
    scaled = run(PAPER.law(1e-3 * scale), [error * scale for error in errors])
    assert [s.voltage * scale for s in plain] == [s.voltage for s in scaled]


def test_the_friction_feedforward_has_the_sign_of_the_last_change_of_the_reference() -> None:
    """None before the first change; it holds where the reference rests, and in the dead zone; the limit acts on it."""
    law = Controller(0.0, 0.0, 0.0, 0.1, sample_rate=1000.0, friction_feedforward=0.05, feedforward=0.01)
    references = [0.0, 0.0, 1e-4, 1e-4, 3e-4, 2e-4, 2e-4, -1e-4, -1e-9]
    signs = [0.0, 0.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0]
    for tolerance in (None, 1e-3):
        voltages = [state.voltage for state in run(law.law(tolerance), references)]
        assert voltages == pytest.approx([0.01 + 0.05 * sign for sign in signs], abs=1e-15)
    limited = run(law.replace(voltage_limit=0.03).law(), references)
    assert [state.voltage for state in limited] == pytest.approx(np.clip(voltages, -0.03, 0.03).tolist(), abs=1e-15)


def test_a_new_friction_feedforward_fades_in() -> None:
    old = PAPER.replace(Ki=0.0, release_time=0.2).law()
    new = PAPER.replace(Ki=0.0, release_time=0.2, friction_feedforward=0.05).law()
    state = run(old, [1e-3] * 500)[-1]
    moved = transfer(old, new, state, 1e-3, 0.0)
    assert tick(new, moved, 1e-3, 0.0).voltage == pytest.approx(tick(old, state, 1e-3, 0.0).voltage, abs=1e-12)
    later = run(new, [1e-3] * 20_000, moved)[-1].voltage - run(old, [1e-3] * 20_000, state)[-1].voltage
    assert later == pytest.approx(0.05, abs=1e-9)


_compiled_tick: Any = numba.njit(tick)


@numba.njit
def _compiled_run(parameters: Any, state: Any, references: Any, measurements: Any, out: Any) -> None:
    for k in range(len(references)):
        state = _compiled_tick(parameters, state, references[k], measurements[k])
        out[k, 0], out[k, 1], out[k, 2] = state.integral, state.derivative, state.filtered
        out[k, 3], out[k, 4], out[k, 5] = state.voltage, state.active, state.offset
        out[k, 6], out[k, 7], out[k, 8] = state.reference, state.ahead, state.direction
        out[k, 9], out[k, 10] = state.notch_band, state.notch_low


def _signals(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A wandering reference and a noisy measurement that cross every threshold and limit."""
    rng = np.random.default_rng(11)
    reference = np.repeat(rng.uniform(-4e-3, 4e-3, samples // 500), 500)
    lag = signal.lfilter([0.01], [1.0, -0.99], reference)
    return reference, lag + rng.normal(0.0, 3e-4, samples)


STOPPED = LIMITED.replace(integral_only=True, Ki=300.0, voltage_limit=1.0, rate_limit=150.0)
BIASED = LIMITED.replace(feedforward=-0.37, release_time=30.0)
FED = LIMITED.replace(velocity_feedforward=190.0, velocity_time=0.03, friction_feedforward=0.07)
NOTCHED = LIMITED.replace(notch_hz=4.3, notch_damping=0.4, voltage_limit=1.0, rate_limit=150.0)


@pytest.mark.slow
@pytest.mark.random
@pytest.mark.parametrize(
    "controller",
    [LIMITED, PAPER, BIASED, STOPPED, FED, NOTCHED],
    ids=["limits, hysteresis, filter", "paper", "offset, feedforward", "integral only", "fed forward", "notch"],
)
def test_ticks_interpreted_and_compiled_agree_bit_for_bit(controller: Controller) -> None:
    """A million of them in `make fuzz`."""
    samples = extent(100_000, 1_000_000)
    law = controller.law(1e-3)
    reference, measurement = _signals(samples)
    compiled = np.empty((samples, len(LawState._fields)))
    first = start(0.0)._replace(offset=2.3)
    _compiled_run(law, first, reference, measurement, compiled)
    state, interpreted = first, array("d")
    for r, y in zip(reference.tolist(), measurement.tolist(), strict=True):
        state = tick(law, state, r, y)
        interpreted.extend(state)
    assert interpreted.tobytes() == compiled.tobytes()
    assert np.count_nonzero(np.diff(compiled[:, 4])) > 100
    if controller.voltage_limit is not None:
        saturated = np.abs(compiled[:, 3]) == law.voltage_limit
        rate_limited = np.isclose(np.abs(np.diff(compiled[:, 3])), law.rate_step)
        assert samples // 2000 < np.count_nonzero(saturated) < samples - 1000
        assert np.count_nonzero(rate_limited) > 100


def test_parameters_are_plain_floats_for_the_compiler() -> None:
    assert all(type(value) is float for value in (*LIMITED.law(1e-3), *start(0.0)))
    assert replace(PAPER, voltage_limit=None).law().voltage_limit == inf
