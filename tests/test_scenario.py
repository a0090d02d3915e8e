"""Scenarios: the packaged ones, TOML with units, and one sentence for every kind of bad input."""

import dataclasses
import math

import pytest

from servotwin.control.gains import gains_of
from servotwin.edge.limits import Limits
from servotwin.edge.settings import Supervision
from servotwin.edge.verdict import FallbackSet
from servotwin.edge.watch import WatchSettings
from servotwin.errors import InvalidInput
from servotwin.identify import paper, settingsfile, whitened
from servotwin.identify.trend import TrendSettings
from servotwin.link.simulated import LinkSettings
from servotwin.messages import Band, Gains
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Samples, SCurve, SquareWave, Step
from servotwin.scenario import PRESETS, Scenario

SHORT = """
servo = "paper"
duration_s = 5.0
[reference]
kind = "step"
size_mm = 1.0
[gap]
total_deg = 10.0
"""
PAPER = "[twin]\npolicy = 'paper'\nmethod = 'paper'\n"


def load(tmp_path, text):
    path = tmp_path / "wear.toml"
    path.write_text(text, encoding="utf-8")
    return Scenario.load(path)


def refusal(tmp_path, text):
    with pytest.raises(InvalidInput) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert "wear.toml" in message
    assert "\n" not in message
    return message


def test_fig15_is_the_papers_section_4_2():
    scenario = Scenario.preset("fig15")
    assert scenario.servo == Servo.preset("paper")
    assert scenario.law == scenario.servo.controller
    assert scenario.law.sample_rate is None
    assert scenario.duration == 200.0
    assert scenario.reference == SquareWave(1e-3, 40.0)
    assert scenario.gap == SCurve(0.0, math.radians(20.0), 200.0)
    assert scenario.uplink == scenario.downlink == LinkSettings(delay_s=1.0)
    assert (scenario.start_tolerance, scenario.twin.k_dz, scenario.samples) == (0.0, 1.0, 1_000_001)
    assert scenario.agent_settings().window_samples == 5000


def test_fig16_adds_noise_and_filters_to_the_sampled_loop():
    plain, noisy = Scenario.preset("fig15-sampled"), Scenario.preset("fig16")
    assert noisy.law == plain.law.replace(loop_filter_hz=20.0)
    assert plain.law.sample_rate == 5000.0
    assert noisy.noise == Noise(0.22e-3, (10.0, 50.0))
    assert noisy.twin.method == "paper"
    assert noisy.twin.estimator == paper.Settings(lowpass_hz=20.0)


def test_an_unknown_preset_is_named():
    with pytest.raises(InvalidInput, match=r"'fig51'.*fig15, fig15-sampled, fig16, calm, certified"):
        Scenario.preset("fig51")
    assert all(Scenario.preset(name).name == name for name in PRESETS)


EVERY_KEY = """
servo = "table1"
name = "axis-7"
duration_s = 30
seed = 4
theta_d0_deg = 1.0
[reference]
kind = "square"
amplitude_mm = 0.5
offset_mm = 0.5
period_s = 10
[gap]
from_deg = 2
to_deg = 8
over_s = 20
begin_s = 3
[controller]
sample_rate_hz = 1000
enter_tolerances = 0.5
leave_tolerances = 1.5
voltage_limit_v = 24
ki_v_per_m_s = 500
[noise]
std_mm = 0.1
kind = "white"
[recording]
sample_rate_hz = 2000
window_s = 0.8
pre_trigger_s = 0.2
retry_first_s = 3
[recording.limits]
maximum_mm = 0.3
[link]
delay_s = 0.5
loss = 0.1
[[link.outages]]
from_s = 1
to_s = 2
[link.down]
loss = 0.2
jitter_s = 0.3
[twin]
policy = "paper"
method = "paper"
k_dz = 1.5
initial_gap_deg = 4
gap_limit_deg = 12
processing_s = 0.1
[twin.trend]
wear_deg = 10
over_s = 1000
[twin.estimator]
alpha_rad_per_s = 80
contact_travel_deg = 2
"""


def test_every_key_in_its_unit(tmp_path):
    scenario = load(tmp_path, EVERY_KEY)
    assert (scenario.name, scenario.seed, scenario.theta_d0) == ("axis-7", 4, math.radians(1.0))
    assert scenario.reference == SquareWave(0.5e-3, 10.0, 0.5e-3)
    assert scenario.gap == SCurve(math.radians(2.0), math.radians(8.0), 20.0, begin=3.0)
    assert scenario.law == scenario.servo.controller.replace(
        sample_rate=1000.0, enter=0.5, leave=1.5, voltage_limit=24.0, Ki=500.0
    )
    assert scenario.noise == Noise(0.1e-3, kind="white")
    agent = scenario.agent_settings()
    assert (agent.window_samples, agent.pre_trigger_samples, agent.retry.first_s) == (1600, 400, 3.0)
    assert agent.limits.maximum == pytest.approx(0.3e-3)
    assert agent.parameters.tolerance == scenario.servo.tolerance_for(math.radians(4.0), 1.5)
    assert scenario.uplink == LinkSettings(0.5, 0.0, 0.1, outages=((1.0, 2.0),))
    assert scenario.downlink == LinkSettings(0.5, 0.3, 0.2, outages=((1.0, 2.0),))
    assert scenario.twin.estimator == paper.Settings(alpha=80.0, contact_travel=math.radians(2.0))
    assert scenario.twin.gap_limit == pytest.approx(math.radians(12.0))
    assert scenario.twin.trend == TrendSettings.for_wear(math.radians(10.0), 1000.0)


@pytest.mark.parametrize(
    ("text", "signal"),
    [
        ('kind = "step"\nsize_mm = 2\nat_s = 1', Step(2e-3, 1.0)),
        ('kind = "s-curve"\nfrom_mm = 0\nto_mm = 2\nover_s = 3', SCurve(0.0, 2e-3, 3.0)),
        ('kind = "samples"\ntimes_s = [0, 1]\nvalues_mm = [1, -1]', Samples((0.0, 1.0), (1e-3, -1e-3))),
        ('kind = "constant"\nvalue_mm = 1', 1e-3),
    ],
)
def test_kinds_of_reference(tmp_path, text, signal):
    assert load(tmp_path, SHORT.replace('kind = "step"\nsize_mm = 1.0', text)).reference == signal


def test_a_servos_path_is_relative_to_the_scenario(tmp_path):
    servo = Servo.preset("paper").replace(k=9e3)
    (tmp_path / "mine.toml").write_text(servo.dumps(), encoding="utf-8")
    assert load(tmp_path, SHORT.replace('"paper"', '"mine.toml"')).servo == servo


def test_another_servo_keeps_what_the_scenario_says_of_the_controller():
    scenario = Scenario.preset("fig16").with_servo(Servo.preset("paper-gain2"))
    assert scenario.law == Servo.preset("paper-gain2").controller.replace(sample_rate=5000.0, loop_filter_hz=20.0)
    assert (
        Scenario.preset("fig15").with_servo(Servo.preset("paper-gain2")).law == Servo.preset("paper-gain2").controller
    )


def test_steps_of_1_mm_are_a_replacement_away():
    scenario = Scenario.preset("fig15").replace(reference=SquareWave(0.5e-3, 40.0, 0.5e-3))
    assert scenario.reference.pieces(200.0).value([0.0, 20.0]).tolist() == [1e-3, 0.0]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (SHORT, "", "is empty"),
        (SHORT, "servo = ", "is not a TOML file"),
        ("duration_s = 5.0", "duration_ms = 5000", r"'duration_s' is missing (found 'duration_ms' instead)"),
        ("duration_s = 5.0", "duration_s = -5.0", "duration_s = -5.0 is not allowed; give a positive number"),
        ("duration_s = 5.0", 'duration_s = "5"', "duration_s = '5' is not allowed"),
        ("duration_s = 5.0", "duration_s = 5.0\ncolour = 1", "unknown key 'colour'"),
        ("duration_s = 5.0", "duration_s = 5.00001", "must be a whole number of samples at 5000.0 Hz"),
        ("duration_s = 5.0", "duration_s = 5.0\nname = 'a b'", "name = 'a b'"),
        ('servo = "paper"', "", "'servo' is missing"),
        ('servo = "paper"', 'servo = "papr"', "servo = 'papr' is not allowed; give one of paper, table1"),
        ('kind = "step"', "", "'reference.kind' is missing"),
        ('kind = "step"', 'kind = "stp"', "did you mean 'step'"),
        ("size_mm = 1.0", "size_m = 1.0", "'reference.size_mm' is missing (found 'reference.size_m' instead)"),
        ("size_mm = 1.0", "size_mm = nan", "reference.size_mm = nan is not allowed"),
        ("[gap]", "[gab]", "'gap.total_deg' is missing"),
        ("total_deg = 10.0", "total_deg = -1", "gap.total_deg = -1 is not allowed; give a number, at least 0"),
        ("total_deg = 10.0", "from_deg = 1\nto_deg = -1\nover_s = 3", "gap.to_deg = -1 is not allowed"),
        ("total_deg = 10.0", "total_deg = 1\nto_deg = 3", "unknown key 'gap.to_deg'"),
        ("[gap]", "[controller]\nsample_rate_hz = 3000\n[gap]", "3000.0 Hz does not divide"),
        ("[gap]", "[controller]\nsample_rate = 5000\n[gap]", "unknown key 'controller.sample_rate'"),
        ("[gap]", "[controller]\nleave_tolerances = 0.1\n[gap]", "[controller]: controller leave = 0.1"),
        ("[gap]", "[noise]\nstd_mm = 0.2\n[gap]", "noise needs a sampled controller"),
        ("[gap]", "[noise]\nstd_mm = 0.2\nband_hz = [50, 10]\n[gap]", "[noise]: noise band = (50.0, 10.0) Hz"),
        ("[gap]", "[noise]\nstd_mm = 0.2\nband_hz = 50\n[gap]", "noise.band_hz = 50 is not allowed; give two numbers"),
        (
            "[gap]",
            "[recording]\nwindow_s = 0.07\n[gap]",
            "window = 0.07 s is too short for method 'whitened', which needs 400",
        ),
        ("[gap]", f"[recording]\nwindow_s = 0.25\n{PAPER}[gap]", "window = 0.25 s is too short for the observer"),
        ("[gap]", "[recording]\nwindow_s = 0.90001\n[gap]", "must be a whole number of samples"),
        ("[gap]", "[recording]\npre_trigger_s = 2.0\n[gap]", "pre_trigger_s = 2.0 s"),
        ("[gap]", "[link]\nloss = 1.5\n[gap]", "link.loss = 1.5 is not allowed"),
        ("[gap]", "[link]\ndelay_ms = 5\n[gap]", "unknown key 'link.delay_ms' (did you mean 'delay_s'?)"),
        ("[gap]", "[link.up]\nloss = 'no'\n[gap]", "link.up.loss = 'no' is not allowed"),
        ("[gap]", "[[link.outages]]\nfrom_s = 3\nto_s = 2\n[gap]", "link outage from 3.0 s to 2.0 s"),
        ("[gap]", "[twin]\nmethod = 'best'\n[gap]", "twin.method = 'best' is not allowed; give one of whitened, paper"),
        ("[gap]", "[twin]\nattempts = 0\n[gap]", "twin.attempts = 0 is not allowed"),
        ("[gap]", f"{PAPER}[twin.estimator]\nalpha = 2\n[gap]", "unknown key 'twin.estimator.alpha'"),
        ("[gap]", f"{PAPER}[twin.estimator]\nalpha_rad_per_s = -2\n[gap]", "[twin.estimator]: estimator alpha = -2"),
        ("[gap]", f"{PAPER}[twin.estimator]\nsettle_s = 2\n[gap]", "too short for the observer, which takes 2"),
        ("[gap]", f"{PAPER}[twin.estimator]\nskew = true\n[gap]", "unknown key 'twin.estimator.skew'"),
        ("[gap]", "[twin.estimator]\nalpha_rad_per_s = 2\n[gap]", "unknown key 'twin.estimator.alpha_rad_per_s'"),
        ("[gap]", "[twin.estimator]\ncombine = true\n[gap]", "unknown key 'twin.estimator.combine'"),
        ("[gap]", "[twin.estimator]\nlargest_std = 1\n[gap]", "(did you mean 'largest_std_deg'?)"),
        ("[gap]", "[twin.estimator]\nlargest_std_deg = 0\n[gap]", "[twin.estimator]: estimator largest_std = 0.0"),
        ("[gap]", "[twin.estimator]\noffset_deg = 3\n[gap]", "offset_deg = 3 is not allowed; give two numbers"),
        ("[gap]", "[twin]\ngap_limit_deg = -1\n[gap]", "twin.gap_limit_deg = -1 is not allowed"),
        ("[gap]", "[twin.trend]\nwear_deg = 1\n[gap]", "'twin.trend.over_s' is missing"),
        ("[gap]", "[twin.trend]\nrate_deg = 1\n[gap]", "'twin.trend.wear_deg' is missing"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, old, new, expected):
    assert old in SHORT
    assert expected in refusal(tmp_path, SHORT.replace(old, new))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidInput, match=r"nowhere\.toml: cannot be read"):
        Scenario.load(tmp_path / "nowhere.toml")


def test_a_gap_that_goes_negative_is_refused():
    with pytest.raises(InvalidInput, match="negative"):
        Scenario(Servo.preset("paper"), 10.0, gap=SCurve(0.1, -0.1, 5.0))


def test_named_seeds_differ_and_stay():
    scenario = Scenario.preset("fig16")
    seeds = {scenario.seed_of(source) for source in ("noise", "up", "down")}
    seeds |= {scenario.replace(seed=1).seed_of("noise"), scenario.replace(name="other").seed_of("noise")}
    assert len(seeds) == 5
    assert scenario.seed_of("noise") == scenario.replace(duration=100.0).seed_of("noise") == 7790430383776639416


@pytest.mark.parametrize(("module", "without"), [(paper, set()), (whitened, {"combine"})])
def test_every_setting_has_its_key(module, without):
    keys = {name for name, _ in settingsfile.KEYS[module.METHOD].values()}
    assert keys == {f.name for f in dataclasses.fields(module.Settings)} - without


def estimator(tmp_path, method, lines):
    text = "\n".join([f"[twin]\nmethod = '{method}'", "[twin.estimator]", *lines, "[gap]"])
    return load(tmp_path, SHORT.replace("[gap]", text)).twin.estimator


def test_every_key_of_the_papers_estimator_is_read(tmp_path):
    lines = ["padding = 'even'", "origin = 'first'", "lowpass_order = 4", "padding_samples = 9", "iterations = 7"]
    lines += ["reversals = 2", "rest_speed_rad_per_s = 0.2", "contact_travel_deg = 1", "method_error_deg = 2"]
    lines += ["largest_std_deg = 3", "unexplained = 0.3", "alpha_rad_per_s = 80", "settle_s = 0.1", "lowpass_hz = 30"]
    one, two, three = (math.radians(x) for x in (1.0, 2.0, 3.0))
    assert estimator(tmp_path, "paper", lines) == paper.Settings(
        80.0, 0.1, 30.0, 4, "even", 9, 7, "first", 2, 0.2, one, two, three, 0.3
    )


def test_every_key_of_the_default_estimator_is_read(tmp_path):
    lines = ["passes = 3", "order = 40", "starts = 9", "kept = 2", "skew = false", "largest_skew_s = 0.001"]
    lines += ["gap_rate_deg_per_s = 1", "offset_deg = [-2, 3]", "prefilter_hz = 80", "contact_travel_deg = 1"]
    lines += ["largest_std_deg = 3", "largest_shift_deg = 2", "model_error_deg = 3", "calibration = 1.3"]
    one, two, three = (math.radians(x) for x in (1.0, 2.0, 3.0))
    assert estimator(tmp_path, "whitened", lines) == whitened.Settings(
        passes=3,
        order=40,
        starts=9,
        kept=2,
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


def test_the_default_twin_is_the_default_estimators(tmp_path):
    assert load(tmp_path, SHORT).twin.method == Scenario(Servo.preset("paper"), 1.0).twin.method == "whitened"
    assert {Scenario.preset(name).twin.method for name in ("fig15", "fig15-sampled", "fig16")} == {"paper"}


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
    ("controller", "said"),
    [
        ("kp_v_per_m = 13777", "unstable"),
        ("ki_v_per_m_s = -100", "unstable"),
        ("sample_rate_hz = 10", "at 10 Hz is unstable"),
        ("sample_rate_hz = 5000\nloop_filter_hz = 0.5", "unstable"),
        ("rate_limit_v_per_s = 100", "sample rate in Hz"),
    ],
)
def test_a_controller_that_cannot_run_is_refused(tmp_path, controller, said):
    assert said in refusal(tmp_path, f"{SHORT}[controller]\n{controller}\n")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SHORT.replace("duration_s = 5.0", "duration_s = 1e12"), "duration = 1000000000000.0 s: has 5e+15 samples"),
        (f"{SHORT}[controller]\nsample_rate_hz = 1e12\n", "at most 1e+08"),
        (f"{SHORT}[recording]\nwindow_s = 1e6\n", "window = 1000000.0 s: has 5e+09 samples"),
        (
            SHORT.replace('kind = "step"\nsize_mm = 1.0', 'kind = "square"\namplitude_mm = 1.0\nperiod_s = 1e-9'),
            "period = 1e-09 s: gives 1e+10 half periods",
        ),
    ],
)
def test_what_would_not_fit_into_memory_is_refused(tmp_path, text, said):
    assert said in refusal(tmp_path, text)


EDGE = (
    SHORT
    + """
[recording.limits]
patience_s = 2.0
gain_factor = 2.5
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
        maximum=0.2e-3, patience_s=2.0, gain_factor=2.5, integral_factor=0.05, feedforward=0.1
    )
    calm = Gains(own.Kp, 0.0, own.Kd, own.Tf, feedforward=0.01)
    fallback = FallbackSet(0.0, calm, Band(1e-4, 8e-5, 0.2, 2.0), silence_s=60.0)
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
        ("[disturbances]\nfriction_n_m = -1.0\n", "friction_n_m"),
    ],
)
def test_bad_supervision_is_named(tmp_path, text, words):
    assert words in refusal(tmp_path, SHORT + text)
