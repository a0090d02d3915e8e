"""Scenarios: the packaged ones, TOML with units, and one sentence for every kind of bad input."""

import math

import pytest
from scenario_files import PAPER, SHORT, load, refusal

from servotwin.cosim.scenario import PRESETS, Scenario
from servotwin.errors import InvalidInput
from servotwin.estimation import paper
from servotwin.estimation.learning.trend import TrendSettings
from servotwin.link.simulated import LinkSettings
from servotwin.plant.axis import Axis
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Samples, SCurve, SquareWave, Step


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
    assert noisy.twin.estimator == paper.PaperSettings(lowpass_hz=20.0)


@pytest.mark.slow
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
    assert agent.parameters.setting.tolerance == scenario.servo.tolerance_for(math.radians(4.0), 1.5)
    assert scenario.uplink == LinkSettings(0.5, 0.0, 0.1, outages=((1.0, 2.0),))
    assert scenario.downlink == LinkSettings(0.5, 0.3, 0.2, outages=((1.0, 2.0),))
    assert scenario.twin.estimator == paper.PaperSettings(alpha=80.0, contact_travel=math.radians(2.0))
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
    assert load(tmp_path, SHORT.replace('"paper"', '"mine.toml"') + PAPER).servo == servo


def test_another_servo_keeps_what_the_scenario_says_of_the_controller():
    scenario = Scenario.preset("fig16").with_servo(Servo.preset("paper-gain2"))
    assert scenario.law == Servo.preset("paper-gain2").controller.replace(sample_rate=5000.0, loop_filter_hz=20.0)
    assert (
        Scenario.preset("fig15").with_servo(Servo.preset("paper-gain2")).law == Servo.preset("paper-gain2").controller
    )


def test_steps_of_1_mm_are_a_replacement_away():
    scenario = Scenario.preset("fig15").replace(reference=SquareWave(0.5e-3, 40.0, 0.5e-3))
    assert scenario.reference.pieces(200.0).value([0.0, 20.0]).tolist() == [1e-3, 0.0]


@pytest.mark.parametrize("machine", [Servo.preset("paper"), Axis.preset("ball-screw")])
def test_a_servo_or_an_axis_in_place_of_a_scenario_is_called_one(tmp_path, machine):
    (tmp_path / "machine.toml").write_text(machine.dumps(), encoding="utf-8")
    with pytest.raises(InvalidInput, match=r"machine.toml: is a servo or an axis, not a scenario"):
        Scenario.load(tmp_path / "machine.toml")


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
        (
            "total_deg = 10.0",
            "total_mm = 0.1",
            "'gap.total_at_load_um' or 'gap.total_at_load_mm' is missing",
        ),
        ("[gap]", "[gab]", "table [gap] is missing (found 'gab' instead)"),
        (
            "total_deg = 10.0",
            "total_deg = 2000",
            "gap.total_deg = 2000 is not allowed; give a number, at least 0, at most",
        ),
        ("total_deg = 10.0", "total_deg = -1", "gap.total_deg = -1 is not allowed; give a number, at least 0"),
        ("total_deg = 10.0", "from_deg = 1\nto_deg = -1\nover_s = 3", "gap.to_deg = -1 is not allowed"),
        (
            "total_deg = 10.0",
            "from_rad = 0.1\nto_rad = 0.2\nover_s = 3",
            "'gap.from_at_load_mm' is missing (found 'gap.from_rad' instead)",
        ),
        ("total_deg = 10.0", "total_deg = 1\nto_deg = 3", "unknown key 'gap.to_deg'"),
        (
            "[gap]",
            "[recording]\nsample_rate_hz = 5000\n[controller]\nsample_rate_hz = 3000\n[gap]",
            "5000.0 Hz: it and",
        ),
        ("[gap]", "[controller]\nsample_rate = 5000\n[gap]", "unknown key 'controller.sample_rate'"),
        ("[gap]", "[controller]\nleave_tolerances = 0.1\n[gap]", "controller.leave_tolerances = 0.1: must be at least"),
        ("[gap]", "[noise]\nstd_mm = 0.2\n[gap]", "noise needs a sampled controller"),
        (
            "[gap]",
            "[noise]\nstd_mm = 0.2\nband_hz = [50, 10]\n[gap]",
            "noise.band_hz = [50, 10] is not allowed; give two numbers, the lower",
        ),
        ("[gap]", "[noise]\nstd_mm = 0.2\nband_hz = 50\n[gap]", "noise.band_hz = 50 is not allowed; give two numbers"),
        (
            "[gap]",
            "[recording]\nwindow_s = 0.07\n[gap]",
            "which needs 400 samples: must be at least 0.08 s at 5000 Hz",
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
        (
            "[gap]",
            f"{PAPER}[twin.estimator]\nalpha_rad_per_s = -2\n[gap]",
            "twin.estimator.alpha_rad_per_s = -2 is not allowed; give a positive number",
        ),
        ("[gap]", f"{PAPER}[twin.estimator]\nsettle_s = 2\n[gap]", "too short for the observer, which takes 2"),
        ("[gap]", f"{PAPER}[twin.estimator]\nskew = true\n[gap]", "unknown key 'twin.estimator.skew'"),
        ("[gap]", "[twin.estimator]\nalpha_rad_per_s = 2\n[gap]", "unknown key 'twin.estimator.alpha_rad_per_s'"),
        ("[gap]", "[twin.estimator]\ncombine = true\n[gap]", "unknown key 'twin.estimator.combine'"),
        ("[gap]", "[twin.estimator]\nlargest_std = 1\n[gap]", "(did you mean 'largest_std_deg'?)"),
        (
            "[gap]",
            "[twin.estimator]\nlargest_std_deg = 0\n[gap]",
            "twin.estimator.largest_std_deg = 0 is not allowed; give a positive number",
        ),
        ("[gap]", "[twin.estimator]\noffset_deg = 3\n[gap]", "offset_deg = 3 is not allowed; give two numbers"),
        ("[gap]", "[twin]\ngap_limit_deg = -1\n[gap]", "twin.gap_limit_deg = -1 is not allowed"),
        ("[gap]", "[twin.trend]\nwear_deg = 1\n[gap]", "'twin.trend.over_s' is missing"),
        ("[gap]", "[twin.trend]\nrate_deg = 1\n[gap]", "'twin.trend.wear_deg' or 'twin.trend.wear_at_load_um' or"),
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
