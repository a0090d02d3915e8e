"""`servotwin identify` on logs of axes whose motor has no encoder, and axis files that contradict themselves."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

import servotwin as st
from servotwin.cli.app import app
from servotwin.cli.identify import IdentifyOptions, identify
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import write_log
from servotwin.plant.axis import Axis

GAP = math.radians(8.0)


def without_encoder(axis: Axis) -> Axis:
    return axis.replace(sensors=replace(axis.sensors, encoder_resolution=0.0, motor_encoder=False))


def log_of(folder: Path, axis: Axis, amplitude: float) -> Path:
    """The log of an axis, as `servotwin simulate` writes it."""
    run = st.simulate(axis, 4.0, reference=st.SquareWave(amplitude, 4.0), gap=GAP, sample_rate=1000.0)
    path = folder / "log.npz"
    write_log(SignalTable(run.columns, {"servo": axis.dumps()}), path)
    return path


def test_the_log_of_a_stepper_without_encoder_shows_its_gap(tmp_path: Path) -> None:
    path = log_of(tmp_path, without_encoder(Axis.preset("stepper-stage")), 40e-6)
    (estimate,) = identify(IdentifyOptions(path, None, start=0.0, duration=4.0)).estimates
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] <= GAP <= estimate.interval[1]
    assert estimate.gap == pytest.approx(GAP, rel=0.01)


def test_the_log_of_a_torque_drive_without_encoder_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = log_of(tmp_path, without_encoder(Axis.preset("ball-screw").replace(sample_rate=1000.0)), 1e-3)
    shown = CliRunner().invoke(app, ["identify", str(path)])
    assert shown.exit_code == 2
    assert "motor_encoder = false" in shown.output
    assert "Traceback" not in shown.output


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ("encoder_counts_per_rev = 4096", "encoder_counts_per_rev = 4096.0 counts per turn is of one"),
        ('feedback = "motor"', 'feedback = "motor" reads it'),
    ],
)
def test_a_file_that_contradicts_itself_is_refused_with_its_name(tmp_path: Path, changed: str, words: str) -> None:
    text = without_encoder(Axis.preset("telescope")).dumps()
    path = tmp_path / "axis.toml"
    kept = "\n".join(each for each in text.splitlines() if not each.startswith(("encoder_", "feedback")))
    path.write_text(kept.replace("[sensors]", f"[sensors]\n{changed}"), encoding="utf-8")
    shown = CliRunner().invoke(app, ["tune", "4", "60", "--servo", str(path)])
    assert shown.exit_code == 2
    assert "axis.toml: [sensors]: sensors motor_encoder = false" in shown.output
    assert words in shown.output
