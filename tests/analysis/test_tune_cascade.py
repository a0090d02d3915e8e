"""A cascade tuned from inside outwards has the crossovers and margins that were asked for."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servotwin as st
from servotwin.analysis.tuning.cascade import tune_cascade, under_cascade
from servotwin.cli.tune import TuneOptions, print_tuning
from servotwin.plant.linear import Complex
from servotwin.plant.signals import Array

SCREW = st.Axis.preset("ball-screw")
OWN = st.Cascade(1.0, SCREW.p, velocity_gain=1e-2, integral_time=0.1, notch_hz=250.0, low_pass_hz=600.0)
AXIS = SCREW.replace(controller=OWN)


def velocity_loop(law: st.Cascade, omega: Array) -> Complex:
    """PI, filter of the speed, notch and low-pass in closed form, on the motor."""
    s = 1j * omega
    assert law.velocity_gain is not None
    pi = law.velocity_gain * (1.0 + (1.0 / (law.integral_time * s) if law.integral_time else 0.0))
    notch = 2.0 * math.pi * 250.0
    band = 2.0 * 0.5 * s / notch
    shaped = (1.0 + (s / notch) ** 2 + 0.1 * band) / (1.0 + (s / notch) ** 2 + band)
    shaped = shaped / (1.0 + s / (2.0 * math.pi * 600.0))
    return np.asarray(pi * shaped * s / (law.speed_filter * s + 1.0) * AXIS.plants()[0].response(omega))


@pytest.mark.parametrize("integral", [True, False])
def test_both_loops_have_their_crossovers(integral: bool) -> None:
    """The position loop in closed form too: the load's position per angle behind the closed velocity loop."""
    margin = math.radians(40.0 if integral else 20.0)
    tuned = tune_cascade(AXIS, 300.0, margin, position_crossover=40.0, integral=integral)
    law = tuned.controller
    inner = complex(velocity_loop(law, np.array([300.0]))[0])
    assert abs(inner) == pytest.approx(1.0, rel=1e-9)
    if integral:
        assert math.pi + math.atan2(inner.imag, inner.real) == pytest.approx(margin, rel=1e-9)
    else:
        assert law.integral_time is None
    omega = np.array([40.0])
    motor, load = (plant.response(omega) for plant in AXIS.plants())
    loop = velocity_loop(law, omega)
    # Without the filter of the speed in the way forward.
    ahead = loop * (law.speed_filter * 1j * omega + 1.0) / (1j * omega)
    outer = complex((law.position_gain / law.ratio * ahead * load / motor / (1.0 + loop))[0])
    assert abs(outer) == pytest.approx(1.0, rel=1e-9)
    assert math.pi + math.atan2(outer.imag, outer.real) == pytest.approx(tuned.position_margin, rel=1e-9)
    assert tuned.margins.stable


def test_a_margin_that_no_pi_reaches_is_refused_with_what_can_be() -> None:
    with pytest.raises(st.InvalidInput, match=r"phase margin = 120 deg: a PI velocity loop reaches .* at 300 rad/s"):
        tune_cascade(AXIS, 300.0, math.radians(120.0))


def test_other_controllers_are_refused() -> None:
    with pytest.raises(st.InvalidInput, match="must be a cascade to be tuned as one"):
        tune_cascade(SCREW, 300.0, 1.0)


STAGE = st.Axis(
    st.VelocityDrive(2e-3), st.Transmission(1e-3), st.Load(m=(1.0,), k=(0.0,), c=(1.0,)), st.Cascade(0.0, ratio=1e-3)
)


def test_a_drive_that_closes_the_velocity_loop_leaves_the_position_loop() -> None:
    """Position gain over s (1 + 2 ms s)."""
    tuned = tune_cascade(STAGE, 100.0, math.radians(70.0))
    assert tuned.controller.position_gain == pytest.approx(100.0 * math.hypot(1.0, 0.2))
    assert tuned.controller.replace(position_gain=0.0) == STAGE.controller
    assert tuned.position_margin == pytest.approx(0.5 * math.pi - math.atan(0.2))
    assert tuned.position_crossover == 100.0
    with pytest.raises(st.InvalidInput, match=r"phase margin = 80 deg: the position loop has 78\.7 deg at 100 rad/s"):
        tune_cascade(STAGE, 100.0, math.radians(80.0))


def test_its_file_needs_no_gain_to_be_tuned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(without(STAGE.dumps(), *GAINS))
    print_tuning(TuneOptions(str(path), "PIDF", 100.0, 70.0, math.inf, "Ms", 0.0, 1.0, None), as_json=False)
    shown = capsys.readouterr().out
    assert "position_gain_per_s  101.98" in shown
    assert "velocity loop" not in shown


def test_an_unstable_result_names_the_gains_as_the_file_does() -> None:
    with pytest.raises(
        st.InvalidInput, match=r"cascade \(position_gain_per_s = .*velocity_gain_n_m_s_per_rad = .*unst"
    ):
        tune_cascade(AXIS, 200.0, math.radians(60.0), position_crossover=1500.0)


def test_the_command_shows_the_keys_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(AXIS.dumps())
    options = TuneOptions(str(path), "PIDF", 300.0, 40.0, math.inf, "Ms", 0.0, 1.0, None)
    print_tuning(options, as_json=True)
    shown = json.loads(capsys.readouterr().out)["gains"]
    law = tune_cascade(AXIS, 300.0, math.radians(40.0)).controller
    assert shown == {
        "position_gain_per_s": law.position_gain,
        "velocity_gain_n_m_s_per_rad": law.velocity_gain,
        "integral_time_s": law.integral_time,
    }
    print_tuning(options, as_json=False)
    assert "position_gain_per_s" in capsys.readouterr().out


def without(text: str, *keys: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith(keys))


GAINS = ("position_gain", "velocity_gain_n", "integral_time")


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(without(AXIS.dumps(), *GAINS), id="without gains"),
        pytest.param(AXIS.replace(velocity_gain=10.0).dumps(), id="unstable"),
    ],
)
def test_an_axis_that_cannot_run_yet_is_tuned_and_written(text: str, tmp_path: Path) -> None:
    path, tuned = tmp_path / "axis.toml", tmp_path / "tuned.toml"
    path.write_text(text)
    with pytest.raises(st.InvalidInput, match=r"is missing|unstable on this axis"):
        st.Axis.from_file(path)
    print_tuning(TuneOptions(str(path), "PIDF", 300.0, 40.0, math.inf, "Ms", 0.0, 1.0, None, tuned), as_json=True)
    assert st.Axis.from_file(tuned) == AXIS.replace(controller=tune_cascade(AXIS, 300.0, math.radians(40.0)).controller)


def test_a_result_is_written_only_where_it_is_stable_at_its_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In continuous time the loop has the margin; held for 20 ms it has none."""
    path, tuned = tmp_path / "axis.toml", tmp_path / "tuned.toml"
    text = without(SCREW.dumps(), "kp_", "ki_", "kd_", "filter_time")
    path.write_text(text.replace("sample_rate_hz = 2000.0", "sample_rate_hz = 50.0"))
    options = TuneOptions(str(path), "PIDF", 100.0, 50.0, math.inf, "Ms", 0.0, 1.0, None, tuned)
    with pytest.raises(st.InvalidInput, match="unstable"):
        print_tuning(options, as_json=False)
    assert not tuned.exists()
    assert not capsys.readouterr().out
    path.write_text(text)
    print_tuning(options, as_json=False)
    shown = capsys.readouterr().out
    assert "present" not in shown
    assert "written: " in shown
    found = st.Axis.from_file(tuned)
    assert found.replace(controller=SCREW.controller) == SCREW
    assert found.replace(sample_rate=None).margins().gain_crossovers[0].omega == pytest.approx(100.0, rel=1e-9)


def test_an_axis_file_without_a_controller_is_tuned_in_continuous_time(tmp_path: Path) -> None:
    path, tuned = tmp_path / "axis.toml", tmp_path / "tuned.toml"
    path.write_text(SCREW.dumps().split("[controller]")[0])
    print_tuning(TuneOptions(str(path), "PIDF", 100.0, 50.0, math.inf, "Ms", 0.0, 1.0, None, tuned), as_json=True)
    assert st.Axis.from_file(tuned).controller.sample_rate is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "PI"}, "--type PI: is for a filtered PID"),
        ({"prefer": "Ki"}, "--prefer Ki: is"),
        ({"b": 0.5}, "--b 0.5: is"),
        ({"c": 0.0}, "--c 0.0: is"),
        ({"Ms_max": 1.01}, r"--ms-max 1.01: the cascade .* has Ms = 2\.\d+; lower the crossover"),
    ],
)
def test_the_command_takes_no_option_that_it_would_ignore(
    tmp_path: Path, changes: dict[str, Any], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(AXIS.dumps())
    options = TuneOptions(str(path), "PIDF", 300.0, 40.0, math.inf, "Ms", 0.0, 1.0, None)
    with pytest.raises(st.InvalidInput, match=words):
        print_tuning(replace(options, **changes), as_json=True)
    assert not capsys.readouterr().out


def test_the_command_refuses_a_linear_law_by_the_key_of_its_file(tmp_path: Path) -> None:
    law = st.LinearLaw(A=((-50.0,),), B=((1.0, 0.0, -1.0),), C=(-47000.0,), D=(1060.0, 0.0, -1060.0))
    path = tmp_path / "axis.toml"
    path.write_text(SCREW.replace(controller=law).dumps())
    options = TuneOptions(str(path), "PIDF", 300.0, 40.0, math.inf, "Ms", 0.0, 1.0, None)
    with pytest.raises(st.InvalidInput, match=r'axis\.toml: controller\.kind = "linear": tune finds') as error:
        print_tuning(options, as_json=True)
    assert "<" not in str(error.value)


PID = SCREW.replace(controller=st.Controller(1.0, 0.0, 0.0, 1.0, sample_rate=4000.0, voltage_limit=3.0))


def test_an_axis_under_a_filtered_pid_gets_a_cascade_with_its_rate_and_limits() -> None:
    """A filter of the speed that is ten times as fast as the velocity loop leaves it the margin that is asked for."""
    axis = under_cascade(PID, 300.0)
    law = tune_cascade(axis, 300.0, math.radians(60.0)).controller
    assert (law.sample_rate, law.voltage_limit, law.ratio, law.speed_filter) == (4000.0, 3.0, SCREW.p, 0.1 / 300.0)
    s, loop = 300j, complex(SCREW.plants()[0].response(np.array([300.0]))[0])
    assert law.velocity_gain is not None
    assert law.integral_time is not None
    loop *= law.velocity_gain * (1.0 + 1.0 / (law.integral_time * s)) * s / (law.speed_filter * s + 1.0)
    assert abs(loop) == pytest.approx(1.0, rel=1e-9)
    assert math.pi + math.atan2(loop.imag, loop.real) == pytest.approx(math.radians(60.0), rel=1e-9)


def test_a_cascade_on_the_motor_needs_its_encoder() -> None:
    with pytest.raises(st.InvalidInput, match="the controller reads y_motor, the motor's encoder"):
        under_cascade(PID.replace(sensors=st.Sensors(motor_encoder=False)), 300.0)


def test_the_command_makes_it_a_cascade(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, tuned = tmp_path / "axis.toml", tmp_path / "tuned.toml"
    path.write_text(PID.dumps())
    print_tuning(TuneOptions(str(path), "cascade", 300.0, 60.0, math.inf, "Ms", 0.0, 1.0, None, tuned), as_json=False)
    assert "velocity_gain_n_m_s_per_rad" in capsys.readouterr().out
    law = st.Axis.from_file(tuned).controller
    expected = tune_cascade(under_cascade(PID, 300.0), 300.0, math.radians(60.0)).controller
    assert law.replace(release_time=None) == expected.replace(release_time=None)
    again = TuneOptions(str(tuned), "cascade", 200.0, 60.0, math.inf, "Ms", 0.0, 1.0, None)
    print_tuning(again, as_json=True)
    assert json.loads(capsys.readouterr().out)["gains"].keys() == {
        "position_gain_per_s", "velocity_gain_n_m_s_per_rad", "integral_time_s",
    }  # fmt: skip


def test_the_paper_s_servo_has_no_cascade() -> None:
    options = TuneOptions("paper", "cascade", 4.0, 60.0, math.inf, "Ms", 0.0, 1.0, None)
    with pytest.raises(st.InvalidInput, match=r"--type cascade: paper is a servo, .* that of an axis"):
        print_tuning(options, as_json=False)


def test_a_type_that_does_not_exist_names_those_that_do() -> None:
    options = TuneOptions("paper", "Cascade", 4.0, 60.0, math.inf, "Ms", 0.0, 1.0, None)
    with pytest.raises(st.InvalidInput, match="--type Cascade: must be one of P, PI, PD, PDF, PID, PIDF, cascade"):
        print_tuning(options, as_json=False)
