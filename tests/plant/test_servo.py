"""The servo's description: presets, round trip through TOML, validation, and loops that cannot be stable."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.loop import sampled_poles
from servotwin.plant.servo import PRESETS, Servo

GOOD = Servo.preset("paper").dumps()


def load(tmp_path: Path, text: str) -> Servo:
    path = tmp_path / "servo.toml"
    path.write_text(text, encoding="utf-8")
    return Servo.load(path)


def test_presets_hold_the_paper_s_numbers() -> None:
    table1, paper, gain2 = Servo.preset("table1"), Servo.preset("paper"), Servo.preset("paper-gain2")
    assert (table1.m, table1.k, table1.c, table1.n) == (5.2, 1e4, 36.9, 3)
    assert (table1.J, table1.L, table1.R, table1.k_T, table1.k_B) == (5e-6, 1e-3, 12.0, 0.8, 0.1)
    assert table1.p == 1e-3 / (2.0 * math.pi)
    assert table1.controller == Controller(Kp=1377.7, Ki=18907.6, Kd=-135.1, Tf=0.1, release_time=0.5)
    assert paper == table1.replace(p=1e-3 / math.pi)
    assert gain2 == table1.replace(Kp=2755.4, Ki=37815.2, Kd=-270.2)
    assert Servo.preset() == paper
    assert math.isinf(paper.k_d)


@pytest.mark.parametrize("preset", PRESETS)
def test_round_trip_of_presets(tmp_path: Path, preset: str) -> None:
    servo = Servo.preset(preset)
    assert load(tmp_path, servo.dumps()) == servo


@given(data=st.data(), n=st.sampled_from([2, 3, 5]))
def test_round_trip_of_random_servos(data: st.DataObject, n: int) -> None:
    positive = st.floats(1e-9, 1e9)
    servo = Servo.preset("paper").replace(
        n=n,
        m=tuple(data.draw(positive) for _ in range(n)),
        J=data.draw(positive),
        k_d=data.draw(st.sampled_from([math.inf, 1e5])),
        encoder_resolution=data.draw(st.floats(0.0, 1.0)),
        Kp=data.draw(st.floats(-1e6, 1e6)),
        voltage_limit=data.draw(st.none() | positive),
        sample_rate=data.draw(st.none() | positive),
    )
    from servotwin.config.table import parse_toml
    from servotwin.config.toml import read

    assert read(parse_toml(servo.dumps(), "x"), Servo) == servo  # load would refuse the unstable ones


def test_replace_reaches_plant_and_controller() -> None:
    servo = Servo.preset("paper").replace(k=9e3, Ki=500.0, voltage_limit=24.0)
    assert servo.k == 9e3
    assert (servo.controller.Ki, servo.controller.voltage_limit, servo.controller.Kp) == (500.0, 24.0, 1377.7)
    own = Controller(Kp=1.0, Ki=2.0, Kd=3.0, Tf=4.0, release_time=5.0)
    assert servo.replace(controller=own, Ki=9.0).controller == own.replace(Ki=9.0)


def test_servos_are_values() -> None:
    assert len({Servo.preset("paper"), Servo.preset("paper"), Servo.preset("table1")}) == 2
    assert Servo.preset().replace(m=[1, 2, 3]).m == (1.0, 2.0, 3.0)
    assert Servo.preset().replace(m=np.array([1.0, 2.0, 3.0])).m == (1.0, 2.0, 3.0)
    hash(Servo.preset().replace(m=np.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(Servo.preset().masses, [5.2, 5.2, 5.2])
    np.testing.assert_array_equal(Servo.preset().replace(k=(1.0, 2.0, 3.0)).stiffnesses, [1.0, 2.0, 3.0])


def test_version_names_the_plant_only() -> None:
    servo = Servo.preset("paper")
    assert servo.version == servo.replace(Kp=1.0).version
    assert servo.version != servo.replace(k=1e4 + 1e-9).version
    assert len(servo.version) == 12


def test_tolerance_for_is_eq_21() -> None:
    servo = Servo.preset("paper")
    assert servo.tolerance_for(math.radians(10.0)) == servo.p * math.radians(10.0)
    assert servo.tolerance_for(0.1, k_dz=1.5) == pytest.approx(1.5 * servo.p * 0.1)
    for gap, k_dz in ((-0.1, 1.0), (math.nan, 1.0), (0.1, -1.0)):
        with pytest.raises(InvalidInput):
            servo.tolerance_for(gap, k_dz)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"m": -1.0}, r"servo m = -1.0 kg: must be a positive number, finite"),
        ({"m": 0.0}, r"servo m = 0.0 kg"),
        ({"k": math.nan}, r"servo k = nan N/m"),
        ({"c": -1e-9}, r"servo c = -1e-09 N s/m: must be a number, at least 0, finite"),
        ({"J": math.inf}, r"servo J = inf kg m\^2: must be a positive number, finite"),
        ({"p": 0.0}, r"servo p = 0.0 m/rad"),
        ({"L": "1 mH"}, r"servo L = '1 mH' H"),
        ({"R": True}, r"servo R = True ohm"),
        ({"k_d": 0.0}, r"servo k_d = 0.0 N/m: must be a positive number, inf allowed"),
        ({"k_d": math.nan}, r"servo k_d = nan N/m"),
        ({"encoder_resolution": -1.0}, r"servo encoder_resolution = -1.0 rad: must be a number, at least 0"),
        ({"n": 1}, r"servo n = 1: must be an integer, at least 2"),
        ({"n": 2.0}, r"servo n = 2.0"),
        ({"m": (1.0, 2.0)}, r"servo m \(mass_kg\) = \(1.0, 2.0\): has 2 values for 3 masses; give one or 3"),
        ({"m": (1.0, 2.0, -3.0)}, r"servo m\[2\] = -3.0 kg"),
        ({"m": None}, r"servo m = None kg: must be a positive number, finite or a tuple of such"),
        ({"controller": 3}, r"servo controller = 3: must be a Controller"),
        ({"Tf": 0.0}, r"controller Tf = 0.0"),
        ({"stiffness": 1.0}, r"servo has no value named 'stiffness'; allowed are m, k, c"),
        ({"kB": 1.0}, r"servo has no value named 'kB' \(did you mean 'k_B'\?\)"),
        ({"kp": 1.0}, r"servo has no value named 'kp' \(did you mean 'Kp'\?\)"),
    ],
)
def test_values_out_of_range_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        Servo.preset("paper").replace(**changes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass_kg = 5.2", "", "key 'structure.mass_kg' is missing"),
        ("mass_kg = 5.2", "mass_g = 5.2", "key 'structure.mass_kg' is missing (found 'structure.mass_g' instead)"),
        ("mass_kg = 5.2", "mass_kg = -5.2", "structure.mass_kg = -5.2 is not allowed; give a positive number, finite"),
        ("mass_kg = 5.2", "mass_kg = [5.2, 1]", "servo m (mass_kg) = (5.2, 1.0): has 2 values for 3 masses"),
        ("mass_kg = 5.2", "mass_kg = 1e-300", "the loop cannot be computed; farthest from 1 is structure.mass"),
        ("mass_kg = 5.2", "mass_kg = nan", "structure.mass_kg = nan is not allowed; give a positive number, finite"),
        ("masses = 3", "masses = 1", "structure.masses = 1 is not allowed; give an integer, at least 2"),
        ("masses = 3", "masses = 1_000_000_000_000", "structure.masses = 1000000000000 is not allowed; give"),
        ("filter_time_s = 0.1", "filter_time_s = 0", "controller.filter_time_s = 0 is not allowed; give a positive"),
        (
            "enter_tolerances = 1.0",
            "enter_tolerances = 2",
            "controller.leave_tolerances = 1.0: must be at least",
        ),
        ("kp_v_per_m", "kp_v_per_mm", "key 'controller.kp_v_per_m' is missing (found 'controller.kp_v_per_mm'"),
        ("[sensors]", "[sensor]", "unknown key 'sensor' (did you mean 'sensors'?); the top level allows"),
        ("[motor]", "[motr]", "table [motor] is missing (found 'motr' instead)"),
        ("[sensors]", "[sensors]\ncolour = 1", "unknown key 'sensors.colour'; table [sensors] allows encoder"),
        ("kp_v_per_m = 1377.7", "kp_v_per_m = -5.0", "the controller with Kp = -5 V/m, Ki = 18907.6 V/(m s)"),
        ("kp_v_per_m = 1377.7", "sample_rate_hz = 20\nkp_v_per_m = 1377.7", "the controller with Kp = 1377.7 V/m, Ki"),
    ],
)
def test_bad_servo_files_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    with pytest.raises(InvalidInput) as caught:
        load(tmp_path, GOOD.replace(old, new, 1))
    assert str(caught.value).startswith(f"{tmp_path / 'servo.toml'}: {message}")
    assert "\n" not in str(caught.value)


def test_an_unknown_preset_is_refused_with_a_hint() -> None:
    with pytest.raises(
        InvalidInput, match=r"preset 'papr' does not exist \(did you mean 'paper'\?\); give one of paper"
    ):
        Servo.preset("papr")


def test_resolve_a_preset_or_a_file(tmp_path: Path) -> None:
    own = Servo.preset("paper").replace(k=9e3)
    (tmp_path / "own.toml").write_text(own.dumps(), encoding="utf-8")
    assert Servo.resolve("table1") == Servo.preset("table1")
    assert Servo.resolve("own.toml", tmp_path) == own
    with pytest.raises(InvalidInput, match=r"absent\.toml: cannot be read"):
        Servo.resolve("absent.toml", tmp_path)
    with pytest.raises(InvalidInput, match="did you mean 'paper'"):
        Servo.resolve("papr", tmp_path)


def test_replace_allows_unstable_loops_for_studies_and_check_loop_refuses_them() -> None:
    servo = Servo.preset("paper")
    servo.check_loop()
    unstable = servo.replace(Kp=-1377.7)
    assert not unstable.closed_loop().is_stable()
    with pytest.raises(InvalidInput, match=r"unstable on this servo even without a gap: its closed loop has a pole at"):
        unstable.check_loop()
    with pytest.raises(InvalidInput, match="unstable"):
        servo.check_loop(servo.controller.replace(Ki=1e6))


def test_sampled_poles_tend_to_the_continuous_ones() -> None:
    servo = Servo.preset("paper")
    continuous = np.sort_complex(servo.closed_loop().poles())[-6:]
    errors = []
    for rate in (20e3, 40e3):
        z = sampled_poles(servo.plant(), servo.controller.replace(sample_rate=rate, voltage_limit=1.0, rate_limit=1.0))
        errors.append(np.max(np.abs(np.sort_complex(np.log(z) * rate)[-6:] - continuous)))
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.05)  # a hold delays by half a sample: first order


def test_sampled_loop_without_integral_and_with_filter() -> None:
    servo = Servo.preset("paper")
    for changes in ({"Ki": 0.0}, {"loop_filter_hz": 20.0}, {"Kd": 0.0, "Kp": 100.0, "Ki": 10.0}):
        servo.check_loop(servo.controller.replace(sample_rate=5000.0, **changes))
    with pytest.raises(InvalidInput, match="needs a rate"):
        sampled_poles(servo.plant(), servo.controller)


def test_to_control_and_its_absence(monkeypatch: pytest.MonkeyPatch) -> None:
    servo = Servo.preset("paper")
    systems = servo.to_control()
    s = 10j
    assert systems.C(s) * systems.G1(s) * systems.G2(s) == pytest.approx(systems.loop(s), rel=1e-9)
    assert systems.closed_loop(s) == pytest.approx(systems.loop(s) / (1.0 + systems.loop(s)), rel=1e-9)
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(InvalidInput, match=r"needs control, which is not installed.*servotwin\[interop\]"):
        servo.to_control()


def test_a_scaled_servo_is_the_one_with_those_numbers() -> None:
    servo = Servo.preset("paper").replace(k=(1e4, 2e4, 3e4))
    expected = servo.replace(k=(1.1 * 1e4, 1.1 * 2e4, 1.1 * 3e4), k_T=0.9 * servo.k_T)
    assert servo.scaled({"k": 1.1, "k_T": 0.9}) == expected
    with pytest.raises(InvalidInput, match="k: factor"):
        servo.scaled({"k": 0.0})
