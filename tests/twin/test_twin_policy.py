"""The twin and its policy: the evidence that it gets, and the use of its decision."""

import math
from dataclasses import replace

import msgspec
import pytest
from twin_messages import PITCH, Rule, eq_21, known_gap, make, message_of, receipt, twin_of, window_message

from servotwin import messages
from servotwin.control.gains import gains_of
from servotwin.edge.guard import Instant, Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.supervisor import Rules, Switch, fall_back, offer
from servotwin.edge.watch import Violation
from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.learning.wear import TrendState
from servotwin.estimation.window import Window
from servotwin.messages import (
    Band,
    Cause,
    Fallback,
    Reason,
    Setting,
)
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.policy import Evidence, PaperPolicy, Redesign
from servotwin.simulation import simulate
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.twin import Twin


def test_the_policy_smooths_from_the_gap_it_last_tuned_for():
    servo = Servo.preset("paper")
    twin = twin_of(known_gap, PaperPolicy(servo, smoothing=0.5))
    updates = [twin.receive(window_message(k, 10.0 * k), 0.0)[1] for k in (1, 2, 3)]
    assert [update.setting.tolerance / servo.p for update in updates] == pytest.approx([0.1, 0.15, 0.225])
    assert [update.gap for update in updates] == pytest.approx([0.1, 0.2, 0.3])


def test_a_policy_may_leave_the_controller_alone():
    twin = twin_of(known_gap, Rule(lambda _: Redesign(None, math.nan, "quiet")))
    assert len(twin.receive(window_message(1, 10.0), 0.0)) == 1


DISTURBED = Disturbance(0.02, 1e-3, 1e-6, 0.3, 1.5)
OWN = Servo.preset("paper").controller
CALM = OWN.replace(Ki=0.0, feedforward=-0.02, sample_rate=5000.0, voltage_limit=24.0)


def with_policy(rule: Rule, **changes):
    start = Setting(1e-4, gains_of(OWN))
    twin = twin_of(known_gap, rule, observer=lambda _: DISTURBED, start=start, **changes)
    return twin, twin.log


def test_a_policy_sees_the_evidence():
    rule = eq_21()
    twin, store = with_policy(rule)
    _, update = twin.receive(window_message(1, 10.0), 0.0)
    evidence = rule.consulted[0]
    assert evidence.estimate.gap == 0.1
    assert evidence.disturbance == DISTURBED == store.disturbances["axis", "boot-1", 1]
    assert TrendState.of(evidence.trend) == TrendState.of(twin.trend)
    assert evidence.setting == Setting(1e-4, gains_of(OWN))
    assert evidence.tuned_for is None
    twin.receive(receipt(update), 1.0)
    twin.receive(window_message(2, 20.0, version=1), 2.0)
    evidence = rule.consulted[1]
    assert (evidence.setting.tolerance, evidence.tuned_for) == (PITCH * 0.1, 0.1)
    assert evidence.gains == gains_of(OWN)


def test_a_policy_sees_the_steps_of_the_reference_and_until_then_the_one_of_the_start():
    """A step at the first sample leaves a reference at rest; only what the position does then shows its size. Of a
    machine that goes to and fro it is half as long as all that follow."""
    servo = Servo.preset("paper")
    calm, worn = (
        simulate(servo, 4.0, reference=SquareWave(1e-3, 4.0), controller=servo.controller.replace(Ki=Ki), gap=gap)
        for Ki, gap in ((0.0, 0.1), (servo.controller.Ki, 0.5))
    )
    for run, start, first, steps in (
        (calm, 0.0, (1e-3,), (2e-3,)),
        (calm, 1.7, (2e-3,), (2e-3, 2e-3)),  # a step within the window
        (worn, 0.5, (), (2e-3,)),  # a limit cycle
    ):
        rule = eq_21()
        twin, _ = with_policy(rule)
        for sequence, begin in enumerate((start, 1.8), start=1):
            twin.receive(message_of(Window.from_run(run, begin, 1.5), sequence, boot="boot-1"), 10.0 * sequence)
        assert rule.consulted[0].steps == pytest.approx(first, rel=0.05)
        assert rule.consulted[-1].steps == pytest.approx(steps, rel=0.05)


def test_a_whole_controller_is_sent_and_known_to_be_in_force_once_it_is():
    """Its gains, thresholds and feedforward; the limits and the rate stay the edge's."""
    rule = Rule(lambda e: Redesign(Setting(0.0, gains_of(CALM), Band(1e-4, 5e-5, 1.0, 2.0)), e.estimate.gap, ""))
    twin, _ = with_policy(rule)
    _, update = twin.receive(window_message(1, 10.0), 0.0)
    assert messages.decode(messages.encode(update)) == update
    assert (update.setting.gains.Ki, update.setting.gains.feedforward, update.setting.band.effort) == (0.0, -0.02, 1.0)
    twin.receive(window_message(2, 20.0), 1.0)
    assert rule.consulted[1].gains.Ki == OWN.Ki
    twin.receive(window_message(3, 30.0, version=1), 2.0)
    assert rule.consulted[2].gains == gains_of(OWN.replace(Ki=0.0, feedforward=-0.02))


def test_what_somebody_else_set_is_not_known():
    rule = eq_21()
    twin, _ = with_policy(rule)
    twin.receive(window_message(1, 10.0, version=17), 0.0)
    assert rule.consulted[0].setting is None


def test_after_a_fallback_nothing_is_insisted_on_and_its_setting_is_known():
    rule = eq_21()
    twin, store = with_policy(rule)
    _, update = twin.receive(window_message(1, 10.0), 0.0)
    twin.receive(receipt(update), 1.0)
    twin.receive(window_message(2, 20.0, version=1), 2.0)
    assert twin.next_wake() is not None
    fallback = Fallback("axis", "boot-1", 2100, Cause.LIMIT_CYCLE, 1e-3, 1e-4, 1, 3, Setting(2e-4, gains_of(CALM)))
    assert twin.receive(fallback, 3.0) == []
    assert twin.next_wake() is None
    assert store.fallbacks == [fallback]
    _, again = twin.receive(window_message(3, 30.0, version=3), 4.0)
    evidence = rule.consulted[-1]
    assert (evidence.gains.Ki, evidence.setting.tolerance, evidence.tuned_for) == (0.0, 2e-4, None)
    assert (again.version, again.base_version) == (4, 3)


FELL_BACK = Fallback("axis", "boot-1", 2100, Cause.LIMIT_CYCLE, 1e-3, 1e-4, 1, 2, Setting(2e-4, gains_of(CALM)))
"""From version 1, under the number that the twin gives to its next update meanwhile."""


@pytest.mark.parametrize("receipt_first", [False, True])
@pytest.mark.parametrize("number", [2, 3])
def test_an_update_that_met_a_fallback_is_followed_by_one_for_the_next_window(number, receipt_first):
    twin, _ = with_policy(eq_21())
    _, first = twin.receive(window_message(1, 10.0), 0.0)
    twin.receive(receipt(first), 1.0)
    _, update = twin.receive(window_message(2, 20.0, version=1), 2.0)
    fallback = msgspec.structs.replace(FELL_BACK, parameter_version=number)
    letters = [fallback, receipt(update, Reason.FELL_BACK, in_force=number)]
    for letter in letters[::-1] if receipt_first else letters:
        assert twin.receive(letter, 3.0) == []
    assert twin.next_wake() is None
    _, again = twin.receive(window_message(3, 30.0, version=number), 4.0)
    assert (again.version, again.base_version) == (number + 1, number)


def test_twin_and_edge_agree_again_within_one_window_of_a_fallback():
    twin, _ = with_policy(eq_21())
    rules, switch = Rules(Limits(lifetime_s=math.inf), OWN), Switch(Parameters(setting=Setting(1e-4, gains_of(OWN))))
    _, first = twin.receive(window_message(1, 10.0), 0.0)
    switch, (applied,) = offer(switch, first, rules, Instant("axis", "boot-1", 1200, 100.0), 0.0)
    twin.receive(applied, 1.0)
    _, on_its_way = twin.receive(window_message(2, 20.0, version=1), 2.0)
    violation = Violation(Cause.LIMIT_CYCLE, 1e-3, 1e-4)
    calm = FallbackSet(Setting(0.0, gains_of(CALM)), refuse_s=0.0)
    switch, (fallback,) = fall_back(switch, calm, violation, Instant("axis", "boot-1", 2200, 100.0))
    assert fallback.parameter_version == on_its_way.version
    switch, (answer,) = offer(switch, on_its_way, rules, Instant("axis", "boot-1", 2300, 100.0), 0.0)
    assert (answer.reason, answer.parameter_version) == (Reason.FELL_BACK, fallback.parameter_version)
    assert [twin.receive(letter, 3.0) for letter in (fallback, answer)] == [[], []]
    _, anew = twin.receive(window_message(3, 30.0, version=fallback.parameter_version), 4.0)
    switch, (applied,) = offer(switch, anew, rules, Instant("axis", "boot-1", 3200, 100.0), 0.0)
    assert (applied.reason, switch.current.version) == (Reason.APPLIED, anew.version)


def test_no_earlier_update_of_a_chain_that_met_a_fallback_is_sent_again():
    twin, _ = with_policy(eq_21())
    sent = [twin.receive(window_message(k, 10.0 * k), 0.0)[1] for k in (1, 2, 3)]
    assert twin.receive(receipt(sent[0]), 1.0) == []
    for update in sent[1:]:
        assert twin.receive(receipt(update, Reason.FELL_BACK, in_force=2), 2.0) == []
        assert twin.next_wake() is None
    _, again = twin.receive(window_message(4, 40.0, version=2), 3.0)
    assert (again.version, again.base_version) == (4, 2)


def test_every_window_has_its_redesign_or_the_reason_why_not():
    twin, store = make(lambda w, p: replace(known_gap(w, p), status=GapStatus.LOWER_BOUND, reasons=("no motion",)))
    twin.receive(window_message(0, 10.0), 0.0)
    assert store.redesigns["axis", "boot-1", 0].reason == "the estimate is lower bound: no motion"
    twin, store = make()
    for k, start in enumerate((20.0, 10.0)):
        twin.receive(window_message(k, start), 0.0)
    assert [r.setting is None for r in store.redesigns.values()] == [False, True]
    assert "not newer" in store.redesigns["axis", "boot-1", 1].reason


def test_a_policy_that_finds_nothing_sends_nothing_and_is_quoted():
    def none(_: Evidence) -> Redesign:
        raise InvalidInput("no candidate has Ms <= 1")

    twin, store = with_policy(Rule(none))
    assert len(twin.receive(window_message(1, 10.0), 0.0)) == 1
    assert store.redesigns["axis", "boot-1", 1].reason == "no candidate has Ms <= 1"


@pytest.mark.slow
def test_the_packaged_twin_looks_for_the_bias():
    """20 mV before a step; a window without voltage says so."""
    servo = Servo.preset("paper").replace(Ki=0.0)
    run = simulate(servo, 12.0, reference=SquareWave(1e-3, 20.0), gap=0.1, input_bias=0.02)
    names = (("position", "m"), ("theta_m", "rad"), ("voltage", "V"), ("reference", "m"))
    part = slice(48_500, 58_500)
    channels = [pack for name, unit in names for pack in messages.pack_finely(name, unit, run.measured(name)[part])]
    message = msgspec.structs.replace(window_message(1, 9.7, channels=tuple(channels)), rate=5000.0)
    twin = Twin("axis", TwinModel.of(servo, TwinSettings()))
    store = twin.log
    twin.receive(message, 0.0)
    assert store.disturbances["axis", "boot-1", 1].bias == pytest.approx(0.02, abs=1e-3)
    twin.receive(window_message(2, 20.0), 0.0)
    assert "no reference and no voltage" in store.disturbances["axis", "boot-1", 2].reasons[0]
