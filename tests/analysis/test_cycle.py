"""Exact limit cycles: known digits, the event simulation, finite differences and symmetries as judges."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from exploration import examples
from hypothesis import assume, given
from hypothesis import strategies as st

from servotwin.analysis.limit_cycles.cycle import CycleStatus, limit_cycle
from servotwin.analysis.limit_cycles.orbit import Orbit
from servotwin.analysis.limit_cycles.poincare import Section, guard_events
from servotwin.analysis.limit_cycles.scaled import scaled_loop, shift
from servotwin.errors import InvalidInput
from servotwin.hybrid.trajectory import Trajectory
from servotwin.plant.servo import Servo
from servotwin.simulation.simulate import simulate

GAP = math.radians(10.0)


@cache
def orbit(preset="paper", share=0.0, gap=GAP, step=1e-3) -> Orbit:
    servo = Servo.preset(preset)
    found = limit_cycle(servo, gap, servo.tolerance_for(gap, share), step=step)
    assert found.status is CycleStatus.CYCLE, found.reason
    assert found.orbit is not None
    return found.orbit


def simulated(servo, gap, tolerance, controller, duration, step=1e-3):
    """Frequency (Hz) and amplitude (m) at the end of a long run: times of like events, and extremes on a fine grid."""
    run = simulate(servo, duration, controller=controller, reference=step, gap=gap, tolerance=tolerance)
    releases = [event.time for event in run.events if event.kind == "release" and event.side == 1]
    return releases, run.position


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "frequency", "amplitude"),
    [
        ("paper", 1.480016436988, 0.179574563547e-3),
        ("paper-gain2", 1.480016436988, 0.5 * 0.179574563547e-3),
        ("table1", 0.910227448140, 0.054039772707e-3),
    ],
)
def test_known_digits_of_the_presets(preset, frequency, amplitude):
    found = orbit(preset)
    assert found.frequency == pytest.approx(frequency, abs=2e-12)
    assert found.amplitude == pytest.approx(amplitude, rel=1e-11)
    assert found.centre == pytest.approx(1e-3, rel=1e-10)
    assert found.symmetric
    assert found.stable
    assert found.residual < 1e-12


@pytest.mark.slow
def test_a_motion_that_passes_a_stable_orbit_does_not_end_on_it():
    """It comes within 6 % of the orbit, and swings on beside it, by 22 % further."""
    servo, gap, step = Servo.preset("paper"), 1.77e-3, -1.0925e-6
    controller = replace(servo.controller, Kp=2304.384, Ki=25500.6, Kd=-53.29308)
    found = limit_cycle(servo, gap, controller=controller, step=step)
    assert found.status is CycleStatus.IRREGULAR
    assert "a stable orbit at 1.53" in found.reason
    run = simulate(servo, 400.0, controller=controller, reference=step, gap=gap, sample_rate=600.0)
    swings = np.ptp(run.position[-60_000:].reshape(-1, 600), axis=1)  # of 100 seconds, each of 1.5 periods
    assert swings.max() > 1.1 * swings.min()


def test_known_multipliers_of_the_half_period():
    found = orbit()
    assert np.abs(found.half_multipliers[:3]) == pytest.approx([0.5853, 0.5513, 0.5513], abs=1e-4)
    by_size = np.sort(np.abs(found.half_multipliers[:6]) ** 2)
    assert np.sort(np.abs(found.multipliers[:6])) == pytest.approx(by_size, rel=1e-8)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_the_event_simulation_converges_to_the_orbit(share):
    servo, found = Servo.preset("paper"), orbit(share=share)
    duration = 40.0 if share == 0.0 else 300.0
    releases, position = simulated(servo, GAP, servo.tolerance_for(GAP, share), servo.controller, duration)
    assert 1.0 / np.diff(releases)[-1] == pytest.approx(found.frequency, rel=1e-9)
    assert 0.5 * np.ptp(position[-100_000:]) == pytest.approx(found.amplitude, rel=1e-8)


def test_the_multipliers_are_the_rate_at_which_a_run_comes_closer():
    found, servo = orbit("table1"), Servo.preset("table1")
    releases, _ = simulated(servo, GAP, None, servo.controller, 30.0)
    errors = np.abs(np.array(np.diff(releases))[8:13] * found.frequency - 1.0)
    assert errors[1:] / errors[:-1] == pytest.approx(abs(found.multipliers[0]), rel=0.01)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_the_derivative_of_the_map_against_differences(share):
    servo = Servo.preset("paper")
    loop = scaled_loop(servo, GAP, servo.tolerance_for(GAP, share), None, 1e-3)
    found = orbit(share=share)
    start, mode = (found.start - loop.displacement) / loop.unit, found.start_mode
    run = Trajectory(loop.loop.automaton, start, mode, loop.sample_step)
    run.advance(1)
    first = guard_events(run)[1][0]
    section = Section(loop.loop.automaton, first, first, 1, loop.sample_step, 3.0 * found.period)
    shot = section.shoot(start)
    row = np.asarray(loop.loop.automaton.modes[first.mode].guards[first.guard].row)
    rng = np.random.default_rng(1)
    for _ in range(5):
        off = rng.normal(size=len(start)) * np.abs(start) * loop.free
        off -= row * (row @ off) / (row @ row)  # within the section
        forward, backward = (section.shoot(start + sign * 1e-6 * off).state for sign in (1.0, -1.0))
        expected = shot.derivative @ off
        np.testing.assert_allclose((forward - backward) / 2e-6, expected, atol=1e-5 * np.abs(expected).max())


def test_the_amplitude_is_proportional_to_the_gap_and_the_frequency_the_same():
    small, large = orbit(gap=math.radians(0.05)), orbit(gap=math.radians(57.3))
    assert small.frequency == pytest.approx(orbit().frequency, rel=1e-12)
    assert large.amplitude / small.amplitude == pytest.approx(57.3 / 0.05, rel=1e-11)


def test_scaling_everything_by_a_power_of_two_changes_no_bit():
    one, four = orbit(share=0.5), orbit(share=0.5, gap=4.0 * GAP, step=4e-3)
    assert four.frequency == one.frequency
    assert four.motor_amplitude == 4.0 * one.motor_amplitude


@pytest.mark.slow
def test_the_extremes_are_the_signal_s_own():
    found = orbit(share=0.5)
    _, position = found.signal("position", 20_001)
    assert found.highest >= position.max()
    assert found.highest == pytest.approx(position.max(), rel=1e-7)
    assert found.lowest == pytest.approx(position.min(), rel=1e-7)
    _, angle = found.signal("theta_m", 20_001)
    assert found.motor_amplitude == pytest.approx(0.5 * np.ptp(angle), rel=1e-6)


def test_the_second_half_mirrors_the_first():
    found = orbit(share=0.5)
    _, voltage = found.signal("voltage", 2000)
    # The law's output jumps at the dead zone's edges, and a sample may fall on either side.
    different = np.abs(voltage[1000:] + voltage[:1000]) > 1e-9 * np.abs(voltage).max()
    assert different.sum() <= 2
    kinds = [(event.kind, event.side) for event in found.events]
    half = len(kinds) // 2
    assert [kind for kind, _ in kinds[:half]] == [kind for kind, _ in kinds[half:]]
    phases = np.array([event.phase for event in found.events])
    assert phases[half:] - phases[:half] == pytest.approx(0.5, abs=1e-12)


@pytest.mark.slow
def test_an_orbit_of_148_events_comes_as_one_of_two_mirror_images():
    """A dead zone of 0.4 p gap: ten seconds of hunting, off centre to one side or to the other."""
    one, other = orbit(share=0.4), orbit(share=0.4, gap=2.0 * GAP)
    assert not one.symmetric
    assert one.half_multipliers is None
    assert len(one.events) == 148
    assert other.amplitude == pytest.approx(2.0 * one.amplitude, rel=1e-9)
    assert 2.0 * (one.centre - 1e-3) == pytest.approx(1e-3 - other.centre, rel=1e-7)
    servo = Servo.preset("paper")
    run = simulate(servo, 120.0, reference=1e-3, gap=GAP, tolerance=servo.tolerance_for(GAP, 0.4))
    tail = run.position[-60_000:]
    assert 0.5 * np.ptp(tail) == pytest.approx(one.amplitude, rel=1e-6)
    assert 0.5 * (tail.max() + tail.min()) == pytest.approx(one.centre, rel=1e-6)


def random_servo(rng, n):
    paper = Servo.preset("paper")
    gains = {name: getattr(paper.controller, name) * rng.uniform(0.5, 1.2) for name in ("Kp", "Ki", "Kd")}
    return paper.replace(
        n=n,
        m=tuple(rng.uniform(1.0, 10.0, n) * 3 / n),
        k=tuple(rng.uniform(5e3, 2e4, n) * n / 3),
        c=tuple(rng.uniform(20.0, 60.0, n)),
        **gains,
    )


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 5])
@examples(4)
@given(seed=st.integers(0, 10_000), gap_deg=st.floats(0.5, 30.0), share=st.sampled_from([0.0, 0.3, 0.6]))
def test_random_servos_against_a_long_run(n, seed, gap_deg, share):
    servo, gap = random_servo(np.random.default_rng(seed), n), math.radians(gap_deg)
    assume(np.max(servo.closed_loop().poles().real) < -0.1)
    tolerance = servo.tolerance_for(gap, share)
    found = limit_cycle(servo, gap, tolerance)
    if found.status is CycleStatus.IRREGULAR:
        # A refusal, with its reason, is no wrong answer: dead zones can hunt for hours.
        assert found.orbit is None
        assert found.reason
        assert share > 0.0
        return
    assert found.status in (CycleStatus.CYCLE, CycleStatus.SETTLES), found.reason
    releases, position = simulated(servo, gap, tolerance, servo.controller, 80.0)
    if found.orbit is None:
        assert np.ptp(position[-50_000:]) < 1e-3 * servo.p * gap
    elif np.abs(found.orbit.multipliers[0]) < 0.8:
        # The run comes closer to the orbit by its largest multiplier in every period.
        left = 10.0 * np.abs(found.orbit.multipliers[0]) ** (70.0 / found.orbit.period)
        assert 0.5 * np.ptp(position[-50_000:]) == pytest.approx(found.orbit.amplitude, rel=1e-6 + left)
        period = np.array(releases) - releases[-1] + found.orbit.period
        assert np.min(np.abs(period)) < (1e-9 + left) * found.orbit.period


def test_an_elastic_screw_has_no_shift_and_a_rigid_one_has():
    servo = Servo.preset("paper")
    rigid = scaled_loop(servo, GAP, None, None, 1e-3)
    assert shift(servo, rigid.loop) is not None
    assert np.abs(rigid.loop.automaton.flows @ shift(servo, rigid.loop)).max() < 1e-6
    elastic = scaled_loop(servo.replace(k_d=1e7), GAP, None, None, 1e-3)
    assert shift(servo.replace(k_d=1e7), elastic.loop) is None
    assert elastic.mirror is None


@pytest.mark.parametrize(
    ("changes", "share", "status"),
    [
        ({"Ki": 0.0}, 0.0, CycleStatus.SETTLES),
        ({}, 1.0, CycleStatus.SETTLES),
        ({"Kp": 13777.0}, 0.0, CycleStatus.DIVERGES),
    ],
)
def test_no_cycle_is_a_status_with_a_reason(changes, share, status):
    servo = Servo.preset("paper").replace(**changes)
    found = limit_cycle(servo, GAP, servo.tolerance_for(GAP, share))
    assert found.status is status
    assert found.orbit is None
    assert found.reason


def test_a_loop_without_a_gap_settles():
    assert limit_cycle(Servo.preset("paper"), 0.0).status is CycleStatus.SETTLES


def test_a_cycle_slower_than_any_window_is_found():
    """Little integral action: the motor takes seconds to cross the gap while the position rests."""
    servo = Servo.preset("paper")
    law = servo.controller.replace(Ki=200.0, Kp=2.8 * servo.controller.Kp, Kd=2.8 * servo.controller.Kd)
    found = limit_cycle(servo, GAP, None, law)
    assert found.orbit is not None
    assert 1.0 / found.orbit.frequency > 20.0
    assert found.orbit.stable


def test_saturation_counts():
    servo = Servo.preset("paper")
    free, tight = (limit_cycle(servo, GAP, None, servo.controller.replace(voltage_limit=v)).orbit for v in (24.0, 0.15))
    assert free is not None
    assert free.frequency == pytest.approx(orbit().frequency, rel=1e-12)
    assert tight is not None
    assert any(event.kind == "saturate" for event in tight.events)
    assert tight.amplitude != pytest.approx(free.amplitude, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gap": -0.1}, "gap = -0.1 rad"),
        ({"gap": math.nan}, "gap = nan rad"),
        ({"gap": GAP, "step": 0.0}, "step = 0.0 m"),
        ({"gap": GAP, "tolerance": -1e-3}, "tolerance"),
        ({"gap": GAP, "controller": Servo.preset().controller.replace(sample_rate=100.0)}, "sample_rate = 100 Hz"),
        ({"gap": GAP, "controller": Servo.preset().controller.replace(rate_limit=1.0)}, "rate_limit"),
    ],
)
def test_loops_without_a_limit_cycle_search_are_refused(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        limit_cycle(Servo.preset("paper"), **arguments)
