"""Settings of twin and edge that a servo's own units fill in where a file leaves them out."""

import math
from dataclasses import replace

import msgspec
import pytest
from scaling import Units, scaled

from servotwin.commissioning.edge_settings import Commissioning, Recording
from servotwin.commissioning.guarding import supervision_of
from servotwin.control.gains import gains_of
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.settings import Supervision
from servotwin.estimation.learning.trend_settings import TrendSettings
from servotwin.messages import Setting
from servotwin.plant.axis import Axis
from servotwin.plant.servo import PRESETS, Servo
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings, long_enough
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TriageSettings, TwinSettings

SERVO = Servo.preset("paper")
SETTINGS = TwinSettings(policy="paper", excitation=ExcitationSettings(), triage=TriageSettings())


def edge(servo: Servo, **recording: float) -> Commissioning:
    return Commissioning(servo, servo.controller, SETTINGS, Recording(**recording))


@pytest.mark.parametrize("name", PRESETS)
def test_the_presets_keep_the_papers_numbers(name: str) -> None:
    found = SETTINGS.on(Servo.preset(name))
    assert found.trend == TrendSettings()
    assert found.excitation is not None
    assert found.excitation.times == ExcitationSettings().times == (2.0, 0.3, 60.0, 0.85)
    assert found.triage is not None
    assert (found.triage.bias, found.triage.least_misfit) == (2e-3, 1e-7)
    assert edge(Servo.preset(name)).window == 1.0


@pytest.mark.parametrize("units", [Units(time=1e3), Units(2.0**-6, 2.0**-20, 2.0**7)])
def test_what_a_file_leaves_out_is_in_the_machines_own_units(units: Units) -> None:
    steps = Uncertainty(step=(units.length * 1e-4, units.length * 1e-3))
    model = TwinModel.of(scaled(SERVO, *units), SETTINGS.replace(uncertainty=steps))
    found = model.settings
    assert found.trend.rate_std_rad_per_s * units.time == pytest.approx(math.radians(0.2))
    assert found.trend.rate_walk_rad_per_s_per_sqrt_s * units.time**1.5 == pytest.approx(math.radians(0.015))
    assert found.excitation is not None
    assert found.excitation.times == pytest.approx([units.time * time for time in (2.0, 0.3, 60.0, 0.85)])
    assert found.triage is not None
    assert found.triage.bias_limit / units.voltage == pytest.approx(2e-3)
    assert found.triage.misfit_limit / units.length == pytest.approx(1e-7)
    assert found.on(scaled(SERVO, *units)) == found


@pytest.mark.parametrize(("time", "slow"), [(1e3, 1e3), (1.0, 1.0), (1e-3, 1.0)])
def test_updates_of_a_slow_machine_hold_for_longer_and_those_of_a_fast_one_as_long_as_the_link_needs(
    time: float, slow: float
) -> None:
    machine = scaled(SERVO, time)
    found = SETTINGS.on(machine)
    assert (found.holds_for, found.valid_for) == pytest.approx((slow * 40.0, slow * 60.0))


@pytest.mark.parametrize("name", ["ball-screw", "robot-joint"])
def test_an_axis_without_a_trend_wears_within_its_stated_range(name: str) -> None:
    axis, paper = Axis.preset(name), TrendSettings()
    for gap, horizon in ((math.radians(0.6), 40.0), (math.radians(30.0), 4.0)):
        known = SETTINGS.uncertainty.replace(gap=(0.0, gap))
        found = SETTINGS.replace(uncertainty=known, horizon=horizon).on(axis).trend
        share = gap / math.radians(60.0)
        assert found.rate_std_rad_per_s * horizon == pytest.approx(share * 40.0 * paper.rate_std_rad_per_s)
        walk = found.rate_walk_rad_per_s_per_sqrt_s * horizon**1.5
        assert walk == pytest.approx(share * 40.0**1.5 * paper.rate_walk_rad_per_s_per_sqrt_s)
        assert found.shared_error_rad == pytest.approx(share * paper.shared_error_rad)


def test_an_axis_keeps_a_stated_trend() -> None:
    stated = TrendSettings.for_wear(1e-3, 3600.0)
    assert SETTINGS.replace(trend=stated).on(Axis.preset("ball-screw")).trend == stated


@pytest.mark.parametrize("name", PRESETS)
def test_the_presets_are_supervised_with_the_papers_numbers(name: str) -> None:
    fallback = FallbackSet(Setting(1e-5))
    assert supervision_of(Servo.preset(name), TwinSettings(), fallback) == Supervision(fallback)


def test_the_edge_watches_in_the_machines_own_units() -> None:
    steps = Uncertainty(step=(1e-10, 2.5e-9), input_bias=(-10.0, 10.0))
    servo, fallback = scaled(SERVO, 8.0, 1e-6, 1e2), FallbackSet(Setting(1e-11))
    found = supervision_of(servo, TwinSettings(uncertainty=steps), fallback)
    assert found.period_s == pytest.approx(0.4)
    assert found.watch is not None
    assert (found.watch.slot_s, found.watch.window_s, found.watch.settling_s) == pytest.approx((0.08, 16.0, 24.0))
    assert (found.watch.error_floor, found.watch.effort_floor) == pytest.approx((1e-11, 2.0))


def test_the_command_of_a_stepper_is_no_evidence() -> None:
    """It is its position: a stage that works far from its zero would leave every band."""
    found = supervision_of(Axis.preset("stepper-stage"), TwinSettings(), FallbackSet(Setting(1e-6))).watch
    assert found is not None
    assert found.effort_floor == math.inf


def test_a_command_that_friction_holds_is_no_evidence_against_settings_that_predict_none() -> None:
    """A joint at rest under the integral of its own law fell back again and again."""
    joint, fallback = Axis.preset("robot-joint"), FallbackSet(Setting(1e-6))
    verified, ruled = (
        supervision_of(joint, TwinSettings(policy=policy), fallback).watch for policy in ("certified", "hysteresis")
    )
    assert verified is not None
    assert ruled is not None
    assert ruled.effort_floor - verified.effort_floor == pytest.approx(0.4)  # N m of its motor's friction


def test_what_a_file_states_counts() -> None:
    stated = replace(
        SETTINGS,
        trend=TrendSettings.for_wear(0.1, 100.0),
        excitation=ExcitationSettings(window=3.0, pre_trigger=0.1, interval=9.0, hold=1.0),
        triage=TriageSettings(least_misfit=1e-6, bias=1e-2),
        horizon=7.0,
        validity=9.0,
    )
    assert stated.on(scaled(SERVO, 10.0, 10.0, 10.0)) == stated


def test_windows_are_in_the_servos_own_time_but_hold_enough_samples() -> None:
    assert edge(scaled(SERVO, time=8.0)).window == pytest.approx(8.0)
    assert edge(scaled(SERVO, time=0.5)).window == pytest.approx(0.5)
    fast = edge(scaled(SERVO, time=1e-3))
    assert fast.window == 400 / 5000.0
    fast.check_window()
    assert edge(scaled(SERVO, time=1e-3), sample_rate=5e6).window == pytest.approx(1e-3)
    calm = Commissioning(scaled(SERVO, time=8.0), SERVO.controller.replace(Ki=0.0), SETTINGS)
    assert (calm.window, calm.pre_trigger) == pytest.approx((16.0, 2.4))


def test_windows_are_whole_samples_and_the_twin_may_request_longer_ones() -> None:
    slow = edge(SERVO.replace(k=7e3)).with_longest(4.0, 0.3, 250_000)
    agent = slow.agent_settings("axis", "boot-1")
    second = math.sqrt(1e4 / 7e3)
    assert agent.window_s == pytest.approx(second, abs=2e-4)
    assert agent.longest_window_s == pytest.approx(4.0 * second, abs=2e-4)
    request = SETTINGS.on(SERVO.replace(k=7e3)).excitation
    assert request is not None
    samples = round(5000.0 * request.times.window)
    assert samples <= agent.longest_samples
    assert long_enough(samples / 5000.0, round(5000.0 * request.times.pre_trigger) / 5000.0, request)
    fast = edge(scaled(SERVO, time=1e-3)).with_longest(4.0, 0.3, 250_000)
    assert fast.agent_settings("axis", "boot-1").longest_window_s == fast.window


@pytest.mark.parametrize("policy", ["hysteresis", "certified"])
def test_the_limits_of_an_edge_admit_the_servos_own_notch_and_feedforward(policy: str) -> None:
    law = SERVO.controller.replace(Ki=0.0, notch_hz=4.3, notch_damping=0.6, friction_feedforward=0.02)
    demands = Demands(machines=16, conditions=4, screened=2, settled=0.8, scales=(0.6,))
    twin = SETTINGS.replace(policy=policy, demands=demands)
    guarded = Commissioning(SERVO.replace(controller=law), law, twin).guarding
    assert guarded is not None
    scale = 0.6 if policy == "certified" else 1.0
    sent = msgspec.structs.replace(gains_of(law), Kp=scale * law.Kp, Kd=scale * law.Kd)
    assert guarded.limits.allows_gains(sent, gains_of(law))
