"""`servotwin identify` on logs of axes made of parts."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scaling import AxisUnits, scaled_axis
from typer.testing import CliRunner
from worm_table import WORM_TABLE

import servotwin as st
from servotwin.cli.app import app
from servotwin.cli.identify import Identification, IdentifyOptions, identify
from servotwin.errors import InvalidInput
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import read_log, write_log

DRIVE, GAP = st.Axis.preset("two-mass-drive"), math.radians(1.0)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a rotary axis as it is recorded, and as another maker writes it: degrees, no metadata."""
    folder = tmp_path_factory.mktemp("logs")
    run = st.simulate(DRIVE, 4.0, reference=st.SquareWave(0.2, 4.0), gap=GAP, sample_rate=1000.0)
    write_log(SignalTable(run.columns, {"servo": DRIVE.dumps()}), folder / "own.npz")
    names = {"time_s": "time_s", "position_deg": "measured_position_rad", "theta_m_deg": "measured_theta_m_rad"}
    names |= {"reference_deg": "reference_rad", "command_n_m": "command_n_m"}
    factors = {name: np.degrees(1.0) if name.endswith("deg") else 1.0 for name in names}
    foreign = {name: factors[name] * run.columns[own] for name, own in names.items()}
    write_log(SignalTable(foreign, {}), folder / "foreign.npz")
    write_log(
        SignalTable({"time_s": run.time, "position_m": run.position, "theta_m_rad": run.theta_m}, {}),
        folder / "metres.npz",
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("name", "servo"), [("own", None), ("foreign", "two-mass-drive")])
def test_a_log_of_a_rotary_axis_shows_its_gap(logs: Path, name: str, servo: str | None) -> None:
    found = identify(IdentifyOptions(logs / f"{name}.npz", servo, start=0.0, duration=3.9))
    (estimate,) = found.estimates
    assert estimate.ok
    assert estimate.interval[0] <= GAP <= estimate.interval[1]
    assert estimate.gap == pytest.approx(GAP, rel=0.01)


@pytest.mark.slow
def test_the_wear_of_an_axis_is_that_of_its_gap_and_log(logs: Path) -> None:
    """The gap grows by itself within 40 windows, and not by the 0.4 deg/s that are stated."""
    log = logs / "own.npz"
    found = identify(IdentifyOptions(log, window=1.9))
    widest = max(estimate.interval[1] for estimate in found.estimates)
    assert len(found.estimates) == 2
    assert found.trend is not None
    assert found.trend.settings.rate_std_rad_per_s == pytest.approx(widest / (40.0 * 1.9), rel=0.5)
    stated = identify(IdentifyOptions(log, window=1.9, wear_deg=0.4, wear_over_s=1.0))
    for own, fast in zip(found.estimates, stated.estimates, strict=True):
        assert own.ok
        assert own.interval[0] <= GAP <= own.interval[1]
        assert np.ptp(own.interval) < 0.8 * np.ptp(fast.interval)


@pytest.fixture(scope="module")
def own_report(logs: Path) -> Identification:
    return identify(IdentifyOptions(logs / "own.npz", window=1.9, gap_limit_deg=2.0))


@pytest.mark.slow
@pytest.mark.parametrize(("time", "angle"), [(0.1, 1.0), (10.0, 1.0), (1.0, 1e-3), (1.0, 10.0), (10.0, 1e-3)])
def test_a_log_in_other_times_and_angles_has_the_same_gaps_and_trend(
    logs: Path, own_report: Identification, tmp_path: Path, time: float, angle: float
) -> None:
    """The same motion, slower or faster, in a gap and with encoders that are finer or coarser."""
    axis = scaled_axis(DRIVE, AxisUnits(time=time))
    sensors, law = axis.sensors, axis.controller
    counts, finer = sensors.encoder_resolution, sensors.position_resolution
    axis = axis.replace(
        sensors=replace(sensors, encoder_resolution=angle * counts, position_resolution=angle * finer),
        controller=replace(law, voltage_limit=angle * law.voltage_limit),
    )
    columns = read_log(logs / "own.npz").table().columns
    table = {name: (time if name == "time_s" else angle) * values for name, values in columns.items()}
    write_log(SignalTable(table, {"servo": axis.dumps()}), tmp_path / "log.npz")
    found = identify(IdentifyOptions(tmp_path / "log.npz", window=1.9 * time, gap_limit_deg=2.0 * angle))
    assert [each.status for each in found.estimates] == [each.status for each in own_report.estimates]
    assert [len(each) for each in found.remarks] == [len(each) for each in own_report.remarks]
    now, then = (np.array([each.interval for each in report.estimates]) for report in (found, own_report))
    assert now / angle == pytest.approx(then, rel=1e-3)
    mine, known, pace = found.trend, own_report.trend, angle / time
    assert mine is not None
    assert known is not None
    assert np.array(mine.gap_interval) / angle == pytest.approx(known.gap_interval, rel=1e-3)
    assert np.array(mine.rate_interval) / pace == pytest.approx(known.rate_interval, rel=1e-3)
    assert found.until_limit is not None
    assert own_report.until_limit is not None
    assert found.until_limit.interval[0] / time == pytest.approx(own_report.until_limit.interval[0], rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("channel", ["measured_theta_m_rad", "measured_position_rad"])
def test_lost_counts_between_two_windows_are_said_with_their_size(
    logs: Path, own_report: Identification, tmp_path: Path, channel: str
) -> None:
    """Neither window alone can know, and each shows the gap: the second one's offset is another."""
    columns = dict(read_log(logs / "own.npz").table().columns)
    lost = 0.1 * (columns["time_s"] > 1.95)
    columns[channel] = columns[channel] - lost
    write_log(SignalTable(columns, {"servo": DRIVE.dumps()}), tmp_path / "log.npz")
    found = identify(IdentifyOptions(tmp_path / "log.npz", window=1.9))
    assert own_report.remarks == ((), ())
    assert found.remarks[0] == ()
    (said,) = found.remarks[1]
    size, known = map(float, re.findall(r"by (\S+) ± (\S+) deg of the motor: one has lost counts", said)[0])
    sign = 1.0 if channel == "measured_theta_m_rad" else -1.0
    assert abs(size - sign * math.degrees(0.1)) <= known < math.degrees(0.1)
    assert all(each.interval[0] <= GAP <= each.interval[1] for each in found.estimates)


@pytest.mark.slow
@pytest.mark.parametrize("gains", [1.0, 0.6])
def test_a_controller_that_was_changed_within_a_log_is_said(tmp_path: Path, gains: float) -> None:
    """The same machine, from the fifth of eight windows on with other gains."""
    stated = DRIVE.replace(controller=st.Controller(Kp=60.0, Ki=0.0, Kd=40.0, Tf=0.01, sample_rate=1000.0))
    changed = stated.controller.replace(Kp=60.0 * gains, Kd=40.0 * gains)
    runs = [
        st.simulate(stated, 8.0, controller=law, reference=st.SquareWave(0.2, 4.0), gap=GAP, sample_rate=1000.0)
        for law in (stated.controller, changed)
    ]
    parts = {name: [run.columns[name][:-1] for run in runs] for name in runs[0].columns if name != "time_s"}
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    table = {"time_s": np.arange(16000) / 1000.0, **joined}
    write_log(SignalTable(table, {"servo": stated.dumps()}), tmp_path / "log.npz")
    found = identify(IdentifyOptions(tmp_path / "log.npz", window=1.9, wear_deg=0.4, wear_over_s=16.0))
    said = [i for i, remarks in enumerate(found.remarks) if any("another law" in remark for remark in remarks)]
    assert said == ([] if gains == 1.0 else [4])


@pytest.mark.slow
def test_a_gap_that_grows_tenfold_within_a_log_is_followed(tmp_path: Path) -> None:
    """The trend's wear is what the accepted windows show, six times what the gap grows by itself: it does not lag."""
    gap = st.SCurve(0.01, 0.1, duration=8.0)
    run = st.simulate(DRIVE, 8.0, reference=st.SquareWave(0.2, 4.0), gap=gap, sample_rate=500.0)
    write_log(SignalTable(run.columns, {"servo": DRIVE.dumps()}), tmp_path / "log.npz")
    found = identify(IdentifyOptions(tmp_path / "log.npz", window=1.9))
    accepted = [estimate.gap for estimate in found.estimates if estimate.ok]
    assert len(accepted) >= 3
    assert found.trend is not None
    assert found.trend.settings.rate_std_rad_per_s == pytest.approx(np.ptp(accepted) / 8.0, rel=0.5)
    low, high = found.trend.gap_interval
    assert low <= float(np.interp(found.trend.time, run.time, run.gap)) <= high


def test_a_log_in_degrees_is_the_log_in_radians(logs: Path) -> None:
    own, foreign = (read_log(logs / f"{name}.npz").table().columns for name in ("own", "foreign"))
    assert own.keys() == foreign.keys()
    for name, values in own.items():
        assert foreign[name] == pytest.approx(values, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("name", "servo", "words"),
    [
        ("metres", "two-mass-drive", "column 'position_m' is in m, and the machine counts it in rad"),
        ("own", "ball-screw", "column 'measured_position_rad' is in rad, and the machine counts it in m"),
    ],
)
def test_a_log_of_another_machine_is_refused(logs: Path, name: str, servo: str, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        identify(IdentifyOptions(logs / f"{name}.npz", servo, start=0.0, duration=2.0))


JOINT = st.Axis.preset("robot-joint")
SEMI_CLOSED = JOINT.replace(sensors=replace(JOINT.sensors, feedback="motor"))
JOINT_GAP = math.radians(21.0)


@pytest.fixture(scope="module")
def motor_logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A joint off its model whose controller reads the motor: the motor's columns alone, and with an encoder behind."""
    folder = tmp_path_factory.mktemp("motor")
    machine = SEMI_CLOSED.scaled({"k": 1.03, "c": 0.85, "k_T": 1.05})
    run = st.simulate(machine, 2.0, reference=st.SquareWave(0.05, 16.0), gap=JOINT_GAP, sample_rate=500.0)
    own = {name: run.columns[name] for name in ("time_s", "theta_m_rad", "command_n_m", "reference_rad")}
    for name, columns in {
        "motor": own,
        "written": dict(run.columns),
        "load": {**own, "position_rad": run.position},
        "no-command": {name: values for name, values in own.items() if name != "command_n_m"},
    }.items():
        write_log(SignalTable(columns, {}), folder / f"{name}.csv")
    (folder / "joint.toml").write_text(SEMI_CLOSED.dumps())
    light = SEMI_CLOSED.replace(load=replace(SEMI_CLOSED.load, m=(1.0,)))
    (folder / "light.toml").write_text(light.dumps())
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"), [("motor", "motor_side"), ("written", "motor_side"), ("load", "output_error")]
)
def test_a_log_of_a_controller_that_reads_the_motor_shows_the_gap(motor_logs: Path, name: str, method: str) -> None:
    """With the load's own position both encoders tell it, and more closely. The wear is stated: one pass, not two."""
    joint = str(motor_logs / "joint.toml")
    found = identify(IdentifyOptions(motor_logs / f"{name}.csv", joint, wear_deg=0.1, wear_over_s=100.0))
    (estimate,) = found.estimates
    assert estimate.ok
    assert estimate.method == method
    assert estimate.interval[0] <= JOINT_GAP <= estimate.interval[1]
    assert estimate.gap == pytest.approx(JOINT_GAP, rel=0.05 if method == "motor_side" else 0.001)


@pytest.mark.parametrize(
    ("name", "servo", "words"),
    [
        ("no-command", "joint.toml", "column 'position_m' is missing, and so are theta_m_rad and a command"),
        ("motor", "robot-joint", "the window has no position of the load"),
        ("motor", "light.toml", "the motor's encoder and the command do not show the gap"),
    ],
)
def test_a_log_of_a_motor_that_shows_nothing_is_refused(motor_logs: Path, name: str, servo: str, words: str) -> None:
    named = str(motor_logs / servo) if servo.endswith(".toml") else servo
    with pytest.raises(InvalidInput, match=words):
        identify(IdentifyOptions(motor_logs / f"{name}.csv", named))


@pytest.mark.slow
def test_windows_of_one_flank_each_say_that_two_steps_show_both(tmp_path: Path) -> None:
    """The table goes straight to its place behind a worm that holds the gap: each step leaves it on one flank."""
    gap, path = math.radians(7.5), tmp_path / "log.npz"

    def told(seconds: float, *options: str) -> str:
        run = st.simulate(WORM_TABLE, seconds, reference=st.SquareWave(0.035, 4.0), gap=gap, sample_rate=2000.0)
        write_log(SignalTable(run.columns, {"servo": WORM_TABLE.dumps()}), path)
        return " ".join(CliRunner().invoke(app, ["identify", str(path), *options]).output.split())

    once = told(4.0)
    assert "2 windows, 0 OK" in once
    assert "a window with two steps, to and fro, shows both flanks: give its length with --window" in once
    # The third step confirms what the two before show together.
    assert "4 windows, 2 OK" in told(8.0)
    both = told(8.0, "--window", "3.9")
    assert "2 windows, 2 OK" in both
    assert "--window" not in both


@pytest.mark.slow
def test_the_estimates_of_a_log_are_reported_one_by_one(logs: Path) -> None:
    reported: list[tuple[int, int]] = []
    options = IdentifyOptions(logs / "own.npz", window=1.9, wear_deg=0.1, wear_over_s=10.0, gap_limit_deg=3.0)
    found = identify(options, lambda done, total: reported.append((done, total)))
    travels = {"wear_at_load_mdeg": 100.0 * found.servo.p, "gap_limit_at_load_mdeg": 3000.0 * found.servo.p}
    at_load = identify(IdentifyOptions(logs / "own.npz", window=1.9, wear_over_s=10.0, at_load=travels))
    assert found.trend is not None
    assert at_load.trend is not None
    assert at_load.until_limit is not None
    assert at_load.trend.gap == pytest.approx(found.trend.gap, rel=1e-9)
    assert reported == [(done, len(found.estimates)) for done in range(len(found.estimates))]
