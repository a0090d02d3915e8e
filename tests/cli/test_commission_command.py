"""`servotwin commission`: an axis file from a log of command and position; one sentence for every invalid log."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from drive_recordings import GAINS, PARAMETERS, elastic, prescribed, simulated
from typer.testing import CliRunner

import servotwin as st
from servotwin.cli import app as cli
from servotwin.cosim.scenario import Scenario

# Not ours to redistribute: beside the checkout where it is there.
EMPS = Path(__file__).parents[3] / "shared" / "data" / "emps" / "DATA_EMPS.mat"
EMPS_OPTIONS = ("--motor-unit", "m", "--command-unit", "V", "--scale", "35.15065", "--lead-mm", "10")


def run(*arguments):
    return CliRunner().invoke(cli.app, ["commission", *map(str, arguments)])


def written(path, recording=None, header="t [s],motor [mm],force [N],reference [mm]", **columns):
    recording = simulated() if recording is None else recording
    time = np.arange(recording.position.size) / recording.rate
    reference = np.zeros(time.size) if recording.reference is None else recording.reference
    values = {"t": time, "motor": 1e3 * recording.position, "force": recording.force, "reference": 1e3 * reference}
    rows = np.column_stack(list((values | columns).values()))
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return written(tmp_path_factory.mktemp("log") / "log.csv")


@pytest.fixture(scope="module")
def files(log):
    """Axis, scenario, page and JSON of one call."""
    folder = log.parent
    names = {name: folder / name for name in ("axis.toml", "scenario.toml", "page.html")}
    twin = ("--scenario", names["scenario.toml"], "--largest-gap", 0.1, "--feedback", "load", "--crossover", 120)
    result = run(log, "-o", names["axis.toml"], "--lead-mm", 10, *twin, "--page", names["page.html"], "--json")
    assert result.exit_code == 0, result.output
    return names | {"json": json.loads(result.stdout)}


@pytest.mark.slow
def test_of_a_voltage_it_is_said_that_resistance_and_torque_constant_are_not_told_apart(tmp_path):
    volts = written(tmp_path / "log.csv", header="t [s],motor [mm],command [V],reference [mm]")
    said = " ".join(run(volts).output.split())
    assert "resistance and torque constant of a motor cannot be told apart here" in said
    assert "cannot be told apart" not in run(volts, "--inertia", 20).output


@pytest.mark.slow
def test_units_at_the_end_of_a_name_are_those_in_brackets(log, tmp_path):
    ends = written(tmp_path / "ends.csv", header="time_s,motor_mm,force_n,reference_mm")
    one, other = (json.loads(run(each, "--json").stdout)["inverse_dynamics"] for each in (log, ends))
    assert one == other
    volts = written(tmp_path / "volts.csv", header="time_s,motor_mm,voltage_v,reference_mm")
    assert "cannot be told apart" in " ".join(run(volts).output.split())
    torque = written(tmp_path / "torque.csv", header="time_s,motor_rad,torque_n_m,reference_rad")
    assert "kg m^2" in run(torque).output


@pytest.mark.slow
def test_times_that_may_be_milliseconds_are_named(tmp_path):
    recording, header = simulated(), "time,motor [mm],force [N],reference [mm]"
    time = np.round(1e3 * np.arange(recording.position.size) / recording.rate)
    path = written(tmp_path / "log.csv", recording, header, t=time)
    remark = "say --time-unit ms where they are milliseconds"
    assert remark in " ".join(run(path).output.split())
    assert remark not in " ".join(run(path, "--time-unit", "ms").output.split())
    noise = np.random.default_rng(1).standard_normal(time.size)
    refused = run(written(tmp_path / "noise.csv", recording, header, t=time, force=noise))
    assert refused.exit_code == 2
    assert remark in " ".join(refused.output.split())


@pytest.mark.slow
def test_counts_are_parts_of_a_turn(log, tmp_path):
    recording = simulated()
    counts = {name: np.round(4096 * 100.0 * values) for name, values in
              (("motor", recording.position), ("reference", recording.reference))}  # fmt: skip
    path = written(tmp_path / "log.csv", recording, "t [s],motor [counts],force [N],reference [counts]", **counts)
    assert "or of counts the part of one, such as rev/4096" in " ".join(run(path, "--lead-mm", 10).output.split())
    said = run(path, "--lead-mm", 10, "--motor-unit", "rev/4096", "--reference-unit", "mm/409.6", "--json")
    fits = (json.loads(each.stdout)["simulated_loop"]["symmetric"]["parameters"] for each in (said, run(log, "--json")))
    seen, known = (fit["inertia"] for fit in fits)
    assert abs(seen["value"] - known["value"]) < seen["half_width_95"]
    assert seen["unit"] == "kg"


def test_a_pid_is_stated_or_a_cascade(log):
    result = run(log, "--kp", 6e4, "--position-gain", 25)
    assert result.exit_code == 2
    assert "state one of the two" in result.output
    said = " ".join(run(log, "--kp", 6e4, "--ki", 0, "--kd", 100, "--derivative-filter", 0.002).output.split())
    assert "the controller with the gains that are given leaves" in said


def test_the_axis_is_the_machine_of_the_log(log, tmp_path):
    result = run(log, "-o", tmp_path / "axis.toml", "--lead-mm", 10)
    assert result.exit_code == 0, result.output
    axis = st.Axis.from_file(tmp_path / "axis.toml")
    p, actuator = axis.p, axis.actuator
    assert p == pytest.approx(0.01 / (2.0 * np.pi))
    assert actuator.J / p**2 == pytest.approx(PARAMETERS["inertia"], rel=1e-3)
    assert actuator.friction == pytest.approx(PARAMETERS["viscous"] * p * p, rel=1e-3)
    assert actuator.coulomb == pytest.approx(PARAMETERS["coulomb"] * p, rel=1e-3)
    assert axis.controller.position_gain == pytest.approx(GAINS["position_gain"], rel=1e-3)
    assert axis.controller.velocity_gain == pytest.approx(GAINS["velocity_gain"] * p * p, rel=1e-3)
    assert axis.at_motor
    assert "next experiment" in result.output
    assert "parameter (± 95 %)" in result.output
    assert "standard deviation" not in result.output


def test_the_twin_of_the_scenario_knows_how_sure_the_parameters_are(files):
    text = files["scenario.toml"].read_text(encoding="utf-8")
    # The policy certified would verify its fallback set, which takes seconds.
    quick = files["scenario.toml"].with_name("quick.toml")
    quick.write_text(text.replace('policy = "certified"', 'policy = "paper"'), encoding="utf-8")
    scenario = Scenario.load(quick)
    known, axis = scenario.twin.uncertainty, scenario.servo
    assert not axis.at_motor
    assert axis.controller.position_gain != pytest.approx(GAINS["position_gain"], rel=0.01)  # tuned to 120 rad/s
    low, high = known.input_bias
    assert low <= -PARAMETERS["offset"] * axis.p <= high
    assert 0.0 < known.k_T < 0.02
    assert scenario.input_bias == pytest.approx(-PARAMETERS["offset"] * axis.p, rel=1e-2)


def test_the_gap_of_the_scenario_hardly_grows_within_a_window(files):
    # It grew by up to twice itself within one, and the twin accepted none of EMPS's five windows.
    found = tomllib.loads(files["scenario.toml"].read_text(encoding="utf-8"))
    gap, window = found["gap"], found["recording"]["window_s"]
    growth = window * (gap["to_deg"] - gap["from_deg"]) / gap["over_s"]
    assert 0.0 < growth < 0.15 * gap["from_deg"]


def test_json_and_page_say_the_same(files):
    fit = files["json"]["simulated_loop"]["symmetric"]["parameters"]
    for name, true in PARAMETERS.items():
        assert fit[name]["value"] == pytest.approx(true, rel=1e-3)
        assert fit[name]["half_width_95"] > fit[name]["std"] > 0.0
    page = files["page.html"].read_text(encoding="utf-8")
    assert f"Inertia {fit['inertia']['value']:.6g}" in page
    assert "Next experiment" in page


@pytest.mark.slow
def test_without_a_scale_a_known_mass_gives_it(tmp_path):
    counts = written(
        tmp_path / "log.csv", header="t [s],motor [mm],current [A],reference [mm]", force=simulated().force / 40.0
    )
    unscaled = run(counts, "--json")
    assert json.loads(unscaled.stdout)["force_per_command"] is None
    assert "no scale of the command" in run(counts).output
    found = st.commission(counts, inertia=PARAMETERS["inertia"])
    # By inverse dynamics of the same log, which sees this mass by a per cent too large.
    assert found.force_per_command == pytest.approx(40.0, rel=0.02)
    assert found.best["viscous"] == pytest.approx(PARAMETERS["viscous"], rel=0.03)


@pytest.mark.parametrize(
    ("change", "options", "says"),
    [
        ({"force": np.zeros(simulated().position.size)}, (), "the command is 0 N throughout"),
        ({"motor": np.zeros(simulated().position.size)}, (), "the position is 0 m throughout"),
        ({"force": -simulated().force}, (), "acts against the motion"),
        ({}, ("--motor", "force", "--motor-unit", "mm", "--command", "motor"), "--motor and --command mixed up"),
        ({}, ("--motor", "reference", "--reference", "motor"), "swapped"),
        ({}, ("--command", "motor"), "named twice"),
        ({}, ("--command", "torque"), "there is no such column"),
        ({}, ("--motor-unit", "furlong"), "give --motor-unit, one of m, mm"),
        ({}, ("--scale", "0"), "must be finite and not 0"),
        ({}, ("--lead-mm", "10", "--ratio", "3"), "give one of the two"),
        ({}, ("--inertia", "-2"), "must be positive"),
        ({}, ("--feedback", "screw"), "must be 'motor' or 'load'"),
        ({}, ("--position-gain", "-1"), "must be positive"),
        ({}, ("--scenario", "s.toml"), "--scenario needs -o"),
        ({}, ("-o", "axis.txt"), "axis.txt"),
    ],
)
def test_a_bad_log_is_refused_in_one_sentence(tmp_path, monkeypatch, change, options, says):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "log.csv", **change)
    outputs = () if {"-o", "--scenario"} & set(options) else ("-o", "axis.toml")
    result = run("log.csv", *outputs, *options)
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "axis.toml").exists()


@pytest.mark.slow
def test_an_axis_file_needs_a_controller(tmp_path):
    lone = written(tmp_path / "log.csv", prescribed(), header="t [s],motor [mm],force [N],nothing")
    result = run(lone, "-o", tmp_path / "axis.toml")
    assert result.exit_code == 2
    assert "give --reference COLUMN, or --position-gain and --velocity-gain" in result.stderr
    assert run(lone, "-o", tmp_path / "axis.toml", "--position-gain", 25, "--velocity-gain", 2400).exit_code == 0


@pytest.mark.slow
def test_two_encoders_give_the_shaft_and_the_gap(tmp_path):
    recording = elastic(gap=0.01)
    table = [
        np.arange(recording.position.size) / recording.rate,
        recording.position,
        recording.force,
        recording.reference,
    ]
    header = "t [s],motor [m],force [N],reference [m],load [m]"
    log = tmp_path / "log.csv"
    np.savetxt(log, np.column_stack([*table, recording.load]), delimiter=",", header=header, comments="", fmt="%.12g")
    twin = ("--scenario", tmp_path / "scenario.toml", "--largest-gap", 0.1, "--feedback", "load")
    result = run(log, "-o", tmp_path / "axis.toml", *twin, "--json")
    assert result.exit_code == 0, result.output
    known = tomllib.loads((tmp_path / "scenario.toml").read_text(encoding="utf-8"))["twin"]["uncertainty"]
    assert 3.0 < known["m_percent"] < known["k_percent"] < known["c_percent"]
    text = (tmp_path / "axis.toml").read_text(encoding="utf-8")
    assert all(f"{name} = {known[name]:.3g}" in text for name in ("m_percent", "k_percent", "c_percent"))
    found = json.loads(result.stdout)
    axis = st.Axis.from_file(tmp_path / "axis.toml")
    assert axis.transmission.in_gap == "free"
    assert axis.load.m[0] == pytest.approx(12.0, rel=0.03)
    # A gap of 10 um makes it seem softer.
    assert axis.transmission.k_d == pytest.approx(2e5, rel=0.15)
    assert found["shaft"]["stiffness"] == pytest.approx(axis.transmission.k_d)
    assert found["gap"]["status"]


def with_load(path, motor=1.0, command=1.0, unit="mm"):
    """A rigid axis with a gap of 0.1 mm, its motor in mm or in rad at 10 mm per turn."""
    recording, gap = simulated(), 1e-4
    load, now = np.empty(recording.position.size), 0.0
    for place, each in enumerate(recording.position):
        now = min(max(now, each - 0.5 * gap), each + 0.5 * gap)
        load[place] = now
    scale = 1.0 if unit == "mm" else 1e-3 * 2.0 * np.pi / 0.01
    columns = {"motor": 1e3 * scale * motor * recording.position, "force": command * recording.force}
    header = f"t [s],motor [{unit}],torque [N m],reference [mm],load [mm]"
    return written(path, header=header, **columns, load=1e3 * load)


@pytest.mark.slow
def test_a_gap_on_a_rigid_shaft_is_no_elasticity(tmp_path):
    found = st.commission(with_load(tmp_path / "log.csv", unit="rad"))
    assert found.drive.split is None
    assert found.axis.transmission == st.Transmission(found.axis.p)


@pytest.mark.slow
def test_the_ratio_of_two_lengths_is_no_travel_per_radian(tmp_path):
    """A torque on a linear axis has no force without a lead."""
    found = st.commission(with_load(tmp_path / "log.csv"))
    assert found.force_per_command is None
    assert found.best["inertia"] == pytest.approx(PARAMETERS["inertia"], rel=0.01)


@pytest.mark.slow
def test_a_motor_that_counts_against_its_load_is_turned(tmp_path):
    found = st.commission(with_load(tmp_path / "log.csv", -1.0, -1.0, "rad"))
    assert found.axis.p == pytest.approx(0.01 / (2.0 * np.pi), rel=1e-3)
    assert found.drive.law.position_gain == pytest.approx(GAINS["position_gain"], rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda r: r + 0.02 * np.random.default_rng(1).standard_normal(r.size), "explains the command"),
        (lambda r: 1.1 * r, "gains would be negative"),
        (lambda r: 0.1 * r, "the reference moves 0.1007 times as far as the position: have both the same unit?"),
    ],
)
def test_a_controller_that_does_not_explain_the_log_is_not_written(tmp_path, change, says):
    log = written(tmp_path / "log.csv", reference=1e3 * change(simulated().reference))
    result = run(log, "-o", tmp_path / "axis.toml")
    assert result.exit_code == 2
    assert says in result.stderr
    assert not (tmp_path / "axis.toml").exists()
    assert st.commission(log).axis is None


def test_a_reference_of_another_kind_or_side_is_told(tmp_path):
    kinds = written(tmp_path / "kinds.csv", header="t [s],motor [m],force [N],reference [deg]")
    assert "'reference [deg]' is an angle (deg) and 'motor [m]' is a length" in run(kinds).stderr
    side = written(tmp_path / "side.csv", header="t [s],motor [deg],torque [N m],reference [deg]")
    assert "moves as far as the motor" in run(side, "--ratio", 17).stderr
    unit = written(tmp_path / "unit.csv", header="t [s],motor [m],force [N],reference [mm]")
    assert (
        "'reference [mm]' moves 0.001007 times as far as the position: one of them has another unit" in run(unit).stderr
    )


@pytest.mark.slow
def test_a_rate_that_contradicts_the_times_of_the_log_is_told(log):
    told = run(log, "--rate", 1000).output
    assert "samples timed by --rate 1000 Hz, though the log's own times say 500 Hz: 3684" in told
    assert "time:" not in told.splitlines()[0]
    assert "--rate" not in run(log, "--rate", 500).output


def rows_of(log):
    head, *rows = log.read_text().splitlines()
    return head, rows


@pytest.mark.slow
def test_a_log_with_the_newest_sample_first_is_turned_round(log, tmp_path):
    head, rows = rows_of(log)
    turned = tmp_path / "turned.csv"
    turned.write_text("\n".join((head, *rows[::-1])) + "\n")
    one, other = st.commission(log), st.commission(turned)
    np.testing.assert_array_equal(other.best.values, one.best.values)
    assert other.logs[0].found == {"samples of a log with the newest first, which was turned round": len(rows)}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: np.random.default_rng(0).permutation(rows), r"samples out of order in time: 3\d{3}"),
        (lambda rows: [re.sub(",[^,]*", ",x", row, count=1) for row in rows], r"column 'motor \[mm\]', line 2: 'x'"),
        (lambda _: [], "holds no row of numbers below the names of its columns"),
    ],
)
def test_why_too_few_samples_can_be_used_is_said(log, tmp_path, change, says):
    head, rows = rows_of(log)
    bad = tmp_path / "bad.csv"
    bad.write_text("\n".join((head, *change(rows))) + "\n")
    result = run(bad)
    assert result.exit_code == 2
    assert re.search(says, result.stderr), result.stderr


def test_counts_are_those_of_the_samples(tmp_path):
    """Not those of values between samples that came at uneven times."""
    recording, random = simulated(), np.random.default_rng(3)
    time = (np.arange(recording.position.size) + random.uniform(-0.2, 0.2, recording.position.size)) / recording.rate
    found = st.commission(written(tmp_path / "log.csv", t=time))
    assert found.logs[0].recording.resolution == pytest.approx(1e-7, rel=0.01)


def test_the_largest_gap_of_a_rotary_axis_is_in_degrees(tmp_path):
    log = written(tmp_path / "log.csv", header="t [s],motor [rad],torque [N m],reference [rad]")
    scenario = tmp_path / "scenario.toml"
    twin = ("--scenario", scenario, "--largest-gap", 0.1, "--feedback", "load", "--crossover", 120)
    assert run(log, "-o", tmp_path / "axis.toml", *twin).exit_code == 0
    assert tomllib.loads(scenario.read_text(encoding="utf-8"))["gap"]["to_deg"] == pytest.approx(0.1)


@pytest.mark.skipif(not EMPS.exists(), reason="the EMPS data set is not beside this checkout (shared/data)")
def test_the_published_benchmark(tmp_path):
    """Janot, Gautier and Brunot 2019; their numbers are of inverse dynamics."""
    result = run(EMPS, *EMPS_OPTIONS, "-o", tmp_path / "axis.toml", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    one, two = (found["inverse_dynamics"][kind]["parameters"] for kind in ("symmetric", "asymmetric"))
    published = {"inertia": 95.1089, "viscous": 203.5034, "coulomb": 20.3935, "offset": -3.1648}
    for name, value in published.items():
        assert one[name]["value"] == pytest.approx(value, rel=5e-3), name
    sided = {
        "viscous_forward": 166.7061,
        "coulomb_forward": 20.1440,
        "viscous_backward": 240.4236,
        "coulomb_backward": 20.6277,
    }
    for name, value in sided.items():
        assert two[name]["value"] == pytest.approx(value, rel=1e-2), name
    assert found["inverse_dynamics"]["symmetric"]["relative_error"] <= 0.041
    assert found["simulated_loop"]["position_error"] <= 2e-4
    assert found["controller"]["position_gain_per_s"] == pytest.approx(160.18, rel=1e-3)
    assert found["late"] is None
    assert found["elastic"] is None
    assert st.Axis.from_file(tmp_path / "axis.toml").controller.sample_rate == 1000.0
