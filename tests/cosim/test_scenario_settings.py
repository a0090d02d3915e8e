"""Scenarios: keys of estimators, recording and edge."""

import dataclasses
import math

import pytest
from scenario_files import PAPER, SHORT, load, refusal

from servotwin.config.keys import items_of
from servotwin.control.gains import gains_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.settings import Supervision
from servotwin.edge.watch import WatchSettings
from servotwin.estimation import paper, whitened
from servotwin.estimation.gap import settings_of
from servotwin.messages import Band, Gains, Setting
from servotwin.plant.servo import Servo


@pytest.mark.parametrize(("module", "without"), [(paper, set()), (whitened, {"combine"})])
def test_every_setting_has_its_key(module, without):
    keys = {item.name for item in items_of(type(settings_of(module.METHOD))) if item.key.in_file}
    assert keys == {f.name for f in dataclasses.fields(settings_of(module.METHOD))} - without


def estimator(tmp_path, method, lines):
    text = "\n".join([f"[twin]\nmethod = '{method}'", "[twin.estimator]", *lines, "[gap]"])
    return load(tmp_path, SHORT.replace("[gap]", text)).twin.estimator


@pytest.mark.slow
def test_every_key_of_the_papers_estimator_is_read(tmp_path):
    lines = ["padding = 'even'", "origin = 'first'", "lowpass_order = 4", "padding_samples = 9", "iterations = 7"]
    lines += ["reversals = 2", "rest_speed_rad_per_s = 0.2", "contact_travel_deg = 1", "method_error_deg = 2"]
    lines += ["largest_std_deg = 3", "unexplained = 0.3", "alpha_rad_per_s = 80", "settle_s = 0.1", "lowpass_hz = 30"]
    one, two, three = (math.radians(x) for x in (1.0, 2.0, 3.0))
    assert estimator(tmp_path, "paper", lines) == paper.PaperSettings(
        80.0, 0.1, 30.0, 4, "even", 9, 7, "first", 2, 0.2, one, two, three, 0.3
    )


@pytest.mark.slow
def test_every_key_of_the_default_estimator_is_read(tmp_path):
    lines = ["passes = 3", "order = 40", "starts = 9", "kept = 2", "skew = false", "largest_skew_s = 0.001"]
    lines += ["gap_rate_deg_per_s = 1", "offset_deg = [-2, 3]", "prefilter_hz = 80", "contact_travel_deg = 1"]
    lines += ["largest_std_deg = 3", "largest_shift_deg = 2", "model_error_deg = 3", "calibration = 1.3"]
    one, two, three = (math.radians(x) for x in (1.0, 2.0, 3.0))
    assert estimator(tmp_path, "whitened", lines) == whitened.WhitenedSettings(
        passes=3,
        order=40,
        starts=9,
        refined=2,
        skew=False,
        largest_skew=1e-3,
        gap_rate=one,
        offset=(-two, three),
        prefilter_hz=80.0,
        contact_travel=one,
        largest_std=three,
        largest_shift=two,
        model_error=three,
        calibration=1.3,
    )


def test_windows_have_the_rate_of_a_sampled_controller_unless_the_file_says_otherwise(tmp_path):
    short = SHORT + PAPER
    sampled = short + "[controller]\nsample_rate_hz = 2000\n"
    assert load(tmp_path, short).recording.sample_rate == 5000.0
    assert load(tmp_path, sampled).recording.sample_rate == 2000.0
    assert load(tmp_path, sampled + "[recording]\nsample_rate_hz = 4000\n").recording.sample_rate == 4000.0


def test_the_default_twin_is_the_default_estimators(tmp_path):
    assert load(tmp_path, SHORT).twin.method == Scenario(Servo.preset("paper"), 1.0).twin.method == "whitened"
    assert {Scenario.preset(name).twin.method for name in ("fig15", "fig15-sampled", "fig16")} == {"paper"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recording", "window", "pre_trigger"),
    [("", 2.0, 0.3), ("window_s = 1.5", 1.5, 0.3), ("pre_trigger_s = 0", 2.0, 0.0)],
)
def test_a_calm_loop_is_recorded_for_longer_and_from_before_the_change(tmp_path, recording, window, pre_trigger):
    """Explicit keys go first, each by itself."""
    calm = SHORT.replace("[gap]", f"[recording]\n{recording}\n[controller]\nki_v_per_m_s = 0\n[gap]")
    agent = load(tmp_path, calm).agent_settings()
    assert (agent.window_s, agent.pre_trigger_s) == (window, pre_trigger)
    certified = load(tmp_path, SHORT.replace("[gap]", f"[recording]\n{recording}\n[gap]")).agent_settings()
    assert (certified.window_s, certified.pre_trigger_s) == (window, pre_trigger)
    usual = load(tmp_path, SHORT + PAPER).agent_settings()
    assert (usual.window_s, usual.pre_trigger_s) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        ("kp_v_per_m = 13777", "unstable"),
        ("ki_v_per_m_s = -100", "unstable"),
        ("sample_rate_hz = 10\n[recording]\nsample_rate_hz = 5000", "at 10 Hz is unstable"),
        ("sample_rate_hz = 5000\nloop_filter_hz = 0.5", "unstable"),
        ("rate_limit_v_per_s = 100", "sample rate in Hz"),
    ],
)
def test_a_controller_that_cannot_run_is_refused(tmp_path, controller, message):
    assert message in refusal(tmp_path, f"{SHORT}[controller]\n{controller}\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SHORT.replace("duration_s = 5.0", "duration_s = 1e9"), "duration = 1000000000.0 s: has 5e+12 samples"),
        (f"{SHORT}[controller]\nsample_rate_hz = 1e12\n", "at most 1e+08"),
        (f"{SHORT}[recording]\nwindow_s = 1e6\n", "window = 1000000.0 s: has 5e+09 samples"),
        (
            SHORT.replace('kind = "step"\nsize_mm = 1.0', 'kind = "square"\namplitude_mm = 1.0\nperiod_s = 1e-9'),
            "period = 1e-09 s: gives 1e+10 half periods",
        ),
    ],
)
def test_what_would_not_fit_into_memory_is_refused(tmp_path, text, message):
    assert message in refusal(tmp_path, text)


EDGE = (
    SHORT
    + """
[recording.limits]
patience_s = 2.0
gain_factor = 2.5
kp_v_per_m = [700.0, 2800.0]
integral_factor = 0.05
feedforward_v = 0.1
maximum_mm = 0.2
[edge]
period_s = 0.1
[edge.watch]
margin = 1.5
error_floor_mm = 0.02
[edge.fallback]
ki_v_per_m_s = 0.0
feedforward_v = 0.01
silence_s = 60.0
[edge.fallback.band]
error_mm = 0.1
error_rms_mm = 0.08
effort_v = 0.2
settling_s = 2.0
[disturbances]
input_bias_v = -0.1
friction_n_m = 0.002
"""
)


def test_the_edge_looks_after_itself_as_a_scenario_says(tmp_path):
    scenario = load(tmp_path, EDGE)
    agent, own = scenario.agent_settings(), gains_of(Servo.preset("paper").controller)
    assert agent.controller == scenario.law
    assert agent.own == own
    assert agent.limits == Limits(
        maximum=0.2e-3, patience_s=2.0, gain_factor=2.5, Kp=(700.0, 2800.0), integral_factor=0.05, feedforward=0.1
    )
    calm = Gains(own.Kp, 0.0, own.Kd, own.Tf, feedforward=0.01)
    fallback = FallbackSet(Setting(0.0, calm, Band(1e-4, 8e-5, 0.2, 2.0)), silence_s=60.0)
    assert agent.supervision == Supervision(fallback, WatchSettings(margin=1.5, error_floor=2e-5), 0.1)
    assert (scenario.input_bias, scenario.friction) == (-0.1, 0.002)


def test_without_an_edge_table_updates_set_the_tolerance_only(tmp_path):
    for policy in ("paper", "margin"):
        scenario = load(tmp_path, SHORT + f"[twin]\npolicy = '{policy}'\n")
        assert scenario.supervision is None
        assert scenario.agent_settings().controller is None
    watchful = load(tmp_path, SHORT + "[edge]\nwatched = false\n")
    assert watchful.agent_settings().supervision == Supervision(watch=None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[edge]\nperiod_s = 0.0\n", "period_s"),
        ("[edge.watch]\nmargin = 0.5\n", "margin"),
        ("[edge.watch]\nmargins = 2.0\n", "margins"),
        ("[edge.fallback]\nki = 0.0\n", "ki"),
        ("[edge.fallback]\nsilence_s = -1.0\n", "silence_s"),
        ("[edge.fallback.band]\nerror_mm = 0.1\n", "error_rms_mm"),
        ("[recording.limits]\ngain_factor = 0.5\n", "gain_factor"),
        ("[recording.limits]\nkp_v_per_m = 2800.0\n", "recording.limits.kp_v_per_m = 2800.0 is not allowed; give two"),
        ("[edge]\n[recording.limits]\nkd_v_s_per_m = [20.0, 300.0]\n", "limits Kd = (20.0, 300.0)"),
        ("[disturbances]\nfriction_n_m = -1.0\n", "friction_n_m"),
    ],
)
def test_bad_supervision_is_named(tmp_path, text, words):
    assert words in refusal(tmp_path, SHORT + text)
