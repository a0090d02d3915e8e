"""Which policy a twin runs, what it needs, and what the edge is given for it."""

import math

import numpy as np
import pytest

from servotwin.config.table import Table, parse_toml
from servotwin.control.gains import gains_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.guard import Limits
from servotwin.errors import InvalidInput
from servotwin.messages import Gains
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.redesign.certified import fallback
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.policy import CertifiedPolicy, band_of
from servotwin.redesign.certified.uncertainty import LearntFactors, Uncertainty
from servotwin.redesign.dead_zones import HysteresisPolicy, MarginPolicy
from servotwin.redesign.policy import PaperPolicy
from servotwin.redesign.registry import certified_policy, policy_of
from servotwin.simulation import simulate
from servotwin.twin.settings import TwinSettings, read_twin_settings

PAPER = Servo.preset("paper")
TOML = """
servo = "paper"
duration_s = 5.0
[reference]
kind = "step"
size_mm = 1.0
[gap]
total_deg = 10.0
"""
NARROW = """
[twin.uncertainty]
k_percent = 5
c_percent = 20
k_b_percent = 3
m_percent = 2
gap_deg = [1, 30]
step_mm = [0.5, 2]
input_bias_v = [-0.02, 0.05]
friction_n_m = [0.0, 0.001]
[twin.demands]
Ms = 1.9
settled_percent = 98
overshoot_percent = 20
velocity_feedforward = false
"""


def load(tmp_path, text):
    path = tmp_path / "axis.toml"
    path.write_text(TOML + text, encoding="utf-8")
    return Scenario.load(path)


def test_each_name_has_its_policy():
    kinds = {"certified": CertifiedPolicy, "margin": MarginPolicy, "hysteresis": HysteresisPolicy, "paper": PaperPolicy}
    for name, kind in kinds.items():
        assert isinstance(policy_of(PAPER, TwinSettings(policy=name)), kind)
    assert TwinSettings().policy == "certified"


def test_each_policy_gets_what_is_set_of_it():
    assert policy_of(PAPER, TwinSettings(policy="paper", k_dz=1.5, smoothing=0.1)) == PaperPolicy(PAPER, 1.5, 0.1)
    assert policy_of(PAPER, TwinSettings(policy="paper")) == PaperPolicy(PAPER, 1.0, 0.0)
    known = Uncertainty(step=(1e-3, 2e-3))
    assert policy_of(PAPER, TwinSettings(policy="margin", uncertainty=known, k_noise=4.0)) == MarginPolicy(
        PAPER, (1e-3, 2e-3), 4.0
    )


@pytest.mark.slow
def test_certified_designs_for_the_controller_that_runs():
    """Loop filter and limits count, the sample rate stays; no more is fed forward than may be needed."""
    scenario = Scenario.preset("fig16").replace(twin=TwinSettings(demands=Demands(velocity_feedforward=False)))
    policy = certified_policy(scenario.model, scenario.twin)
    law = policy.fallback().setting.controller
    assert (law.loop_filter_hz, law.sample_rate) == (20.0, 5000.0)
    assert policy.feedforward_limit == 0.1
    # Nearly those of continuous time: at 5 kHz the hold costs little.
    assert policy.fallback().Ms == pytest.approx(PAPER.margins(law).Ms, rel=3e-3)
    assert policy.fallback().Ms != pytest.approx(PAPER.margins(law.replace(loop_filter_hz=None)).Ms, rel=1e-2)


def test_ranges_and_demands_carry_their_units():
    twin = read_twin_settings(Table("axis.toml", parse_toml(NARROW, "axis.toml").values["twin"]))
    assert twin.uncertainty == Uncertainty(
        0.05, 0.2, 0.03, 0.02, (math.radians(1.0), math.radians(30.0)), (0.5e-3, 2e-3), (-0.02, 0.05), (0.0, 0.001)
    )
    assert (twin.demands.Ms, twin.demands.settled, twin.demands.overshoot) == (1.9, 0.98, 0.2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[twin]\npolicy = 'certifed'", "twin.policy = 'certifed' is not allowed; give one of certified, margin"),
        ("[twin]\nk_dz = 1.0", "twin k_dz = 1.0: belongs to policy 'paper', and this is 'certified'"),
        ("[twin]\npolicy = 'margin'\nsmoothing = 0.1", "smoothing = 0.1: belongs to policy 'paper'"),
        ("[twin]\npolicy = 'paper'\nk_noise = 2.0", "k_noise = 2.0: belongs to policy 'margin'"),
        ("[twin.uncertainty]\ngap_deg = 60", "gap_deg = 60 is not allowed; give two numbers"),
        ("[twin.uncertainty]\ngap_deg = [60, 0]", "uncertainty.gap_deg = [60, 0] is not allowed"),
        (
            "[twin.uncertainty]\nk_percent = 100",
            "k_percent = 100 is not allowed; give a number, at least 0, below 100",
        ),
        ("[twin.uncertainty]\nk = 0.1", "unknown key 'twin.uncertainty.k'"),
        ("[twin.demands]\nMs = 0.5", "twin.demands.Ms = 0.5 is not allowed; give a number, at least 1"),
    ],
)
def test_a_wrong_setting_is_refused_in_one_sentence(tmp_path, text, words):
    with pytest.raises(InvalidInput) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert words in message
    assert "axis.toml" in message
    assert "\n" not in message


def test_an_empty_set_of_candidates_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(InvalidInput, match=r"axis\.toml.*no candidate has Ms <= 1 on this servo"):
        load(tmp_path, "[twin.demands]\nMs = 1.0")


@pytest.mark.slow
def test_a_range_without_a_verified_setting_is_refused_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(fallback, "ways_out", lambda *_: "another way out")
    reason = r"no fallback set for the servo's stated range: none of \d+ candidates "
    ranges = "steps of 0.1 to 2.5 mm from rest, gaps of 0 to 60 deg at the motor, input bias of "
    ranges += "-0.1 to 0.1 V, friction of 0 to 0"
    words = rf"{reason}.* by default are {ranges} N m; another way out; "
    words += r"without a twin it can be simulated: enabled = false in \[twin\], and no policy$"
    with pytest.raises(InvalidInput, match=words):
        load(tmp_path, "[twin.demands]\nsettled_percent = 100\nvelocity_feedforward = false\nMs = 1.2")


def test_an_unstable_loop_is_refused_under_every_policy(tmp_path):
    with pytest.raises(InvalidInput, match="is unstable on this servo even without a gap"):
        load(tmp_path, "[controller]\nkp_v_per_m = 13777")


def test_margin_has_no_map_for_a_limited_voltage():
    with pytest.raises(InvalidInput, match="policy 'margin' reads its dead zone from a map"):
        policy_of(PAPER.replace(voltage_limit=24.0), TwinSettings(policy="margin"))


@pytest.mark.parametrize("policy", ["paper", "hysteresis", "margin"])
def test_a_dead_zone_that_changes_nothing_is_refused(policy):
    proportional = PAPER.replace(Ki=0.0, integral_only=True)
    with pytest.raises(InvalidInput, match=rf"policy '{policy}': the dead zone that it sets changes nothing: .*none; "):
        policy_of(proportional, TwinSettings(policy=policy))
    policy_of(proportional, TwinSettings(policy="paper", k_dz=0.0))


@pytest.mark.slow
def test_the_loop_begins_on_the_set_that_is_verified_for_the_whole_range(tmp_path):
    scenario = load(tmp_path, "[twin]\nhorizon_s = 7.0\nsilence_s = 90.0\n")
    verified = certified_policy(scenario.model, scenario.twin).fallback()
    agent = scenario.agent_settings()
    fallback = agent.supervision.fallback
    assert verified.gap == scenario.twin.uncertainty.gap
    assert fallback.setting.gains == agent.parameters.setting.gains == gains_of(verified.setting.controller)
    assert fallback.setting.band == agent.parameters.setting.band == band_of(verified)
    assert agent.parameters.fallback
    assert scenario.start_law == verified.setting.controller
    assert fallback.silence_s == 90.0
    assert certified_policy(scenario.model, scenario.twin).horizon == 7.0


@pytest.mark.slow
@pytest.mark.parametrize("text", ["[controller]\nki_v_per_m_s = 100.0\n", "[edge]\nwatched = true\n"])
def test_the_loop_begins_on_the_controller_that_the_scenario_gives(tmp_path, text):
    scenario = load(tmp_path, text)
    assert scenario.start_law == scenario.law
    assert not scenario.agent_settings().parameters.fallback
    assert (scenario.agent_settings().supervision.fallback is None) == ("edge" in text)


@pytest.mark.slow
def test_a_sample_rate_says_nothing_of_gains(tmp_path):
    scenario = load(tmp_path, "[controller]\nsample_rate_hz = 5000.0\n[twin.demands]\nvelocity_feedforward = false\n")
    assert scenario.agent_settings().parameters.fallback
    assert scenario.start_law.sample_rate == 5000.0


@pytest.mark.slow
def test_the_limits_admit_every_candidate_and_little_else(tmp_path):
    scenario = load(tmp_path, "")
    agent, policy = scenario.agent_settings(), certified_policy(scenario.model, scenario.twin)
    limits, own = agent.limits, agent.own
    exact = policy.uncertainty.replace(k=0.0, c=0.0, k_B=0.0, m=0.0, learnt=LearntFactors(("k",), (0.0,), ((0.0,),)))
    stated = [s.controller for s in candidates_of(policy.servo, policy.uncertainty, Demands(), True, True)]
    sure = Demands(beyond=Beyond(k_T=0.0))
    laws = stated + [s.controller for s in candidates_of(policy.servo, exact, sure, True, True)]
    for law in laws:
        for fed in (-0.1, 0.1):
            assert limits.allows_gains(gains_of(law.replace(feedforward=fed)), own)
    first = laws[0]
    # Slower laws, down to 0.4 of the own Kp, are those of machines that are learnt in part (test_edge_box.py).
    for change in (
        {"Kd": 1.01 * min(law.Kd for law in laws)},
        {"Kd": 0.8 * max(law.Kd for law in laws)},
        {"Kp": 1.01 * max(law.Kp for law in laws)},
        {"Kp": 0.6 * min(law.Kp for law in laws)},
        {"Tf": 1.01 * max(law.Tf for law in laws)},
        {"Tf": 0.99 * min(law.Tf for law in laws)},
        {"velocity_feedforward": 1.01 * own.Kp * first.velocity_time},
        {"Ki": 1.01 * max(law.Ki for law in laws)},
        {"Ki": -1.0},
        {"feedforward": 0.101},
        {"leave": 2.01},
    ):
        assert not limits.allows_gains(gains_of(first.replace(**change)), own)
    assert limits.maximum * 1.5 == pytest.approx(agent.supervision.fallback.setting.band.error)


def test_limits_that_are_given_go_first(tmp_path):
    agent = load(tmp_path, "[recording.limits]\nmaximum_mm = 0.05\n").agent_settings()
    assert agent.limits == Limits(maximum=0.05e-3)
    assert agent.own == gains_of(PAPER.controller)


def test_hysteresis_may_send_its_thresholds_and_no_other_gains(tmp_path):
    scenario = load(tmp_path, "[twin]\npolicy = 'hysteresis'\ninitial_gap_deg = 2.0\n")
    agent = scenario.agent_settings()
    assert scenario.start_law == scenario.law
    assert agent.parameters.setting.tolerance == PAPER.tolerance_for(math.radians(2.0))
    own = PAPER.controller
    sent = gains_of(own.replace(enter=0.5, leave=1.5))
    assert agent.limits.allows_gains(sent, agent.own)
    for wrong in (own.replace(Kp=1.1 * own.Kp), own.replace(Ki=1.1 * own.Ki), own.replace(leave=1.6)):
        assert not agent.limits.allows_gains(gains_of(wrong), agent.own)
    assert isinstance(agent.supervision.fallback.setting.gains, Gains)


def test_verified_settings_of_an_axis_whose_loop_has_no_gap_are_refused_at_configuration():
    axis = Axis.preset("emps")
    with pytest.raises(InvalidInput, match="its loop does not depend on the gap and there is nothing to verify"):
        policy_of(axis, TwinSettings())


@pytest.mark.parametrize("name", ["paper", "hysteresis", "margin"])
def test_a_stepper_is_not_sent_home_by_a_dead_zone(name: str):
    """A command of zero is its angle zero: such a dead zone makes a loop hunt that rests without one."""
    stage = Axis.preset("stepper-stage")
    policy_of(stage, TwinSettings(policy=name))
    with pytest.raises(InvalidInput, match="would go to the angle zero; give its controller integral_only = true"):
        policy_of(stage.replace(integral_only=False), TwinSettings(policy=name))
    gap = 2e-6 / stage.p
    ends = {}
    for only in (True, False):
        axis = stage.replace(integral_only=only)
        run = simulate(axis, 10.0, reference=1e-4, gap=gap, tolerance=2e-6, sample_rate=1000.0)
        ends[only] = float(np.abs(run.reference - run.position)[5000:].max())
    assert ends[True] <= 2e-6
    assert ends[False] > 1e-5
