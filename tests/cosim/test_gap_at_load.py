"""Gaps may be stated at the load: um of a screw, arc minutes of a gear."""

import math
from pathlib import Path

import pytest

from servotwin.config.table import parse_toml
from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve
from servotwin.twin.model_registry import models_of
from servotwin.twin.settings import TwinSettings, read_twin_settings

TEXT = """servo = "{servo}"
duration_s = 4.0
reference = {{kind = "square", amplitude_{unit} = 0.1, period_s = 2.0}}
gap = {{{gap}}}
[twin]
enabled = false
"""
SCREW, JOINT = ("ball-screw", "mm"), ("robot-joint", "deg")


def load(folder: Path, machine: tuple[str, str], gap: str) -> Scenario:
    path = folder / "own.toml"
    path.write_text(TEXT.format(servo=machine[0], unit=machine[1], gap=gap))
    return Scenario.load(path)


@pytest.mark.parametrize(
    ("machine", "key", "at_load"),
    [
        (SCREW, "total_at_load_um = 12.0", 12e-6),
        (SCREW, "total_at_load_mm = 0.012", 12e-6),
        (JOINT, "total_at_load_arcmin = 3.0", math.radians(0.05)),
        (JOINT, "total_at_load_mdeg = 50.0", math.radians(0.05)),
        (JOINT, "total_at_load_deg = 0.05", math.radians(0.05)),
    ],
)
def test_a_gap_at_the_load_is_turned_into_that_of_the_motor(
    tmp_path: Path, machine: tuple[str, str], key: str, at_load: float
) -> None:
    assert load(tmp_path, machine, key).gap == pytest.approx(at_load / Axis.preset(machine[0]).p, rel=1e-14)


def test_a_gap_that_grows_at_the_load_grows_at_the_motor(tmp_path: Path) -> None:
    gap = load(tmp_path, SCREW, "from_at_load_um = 5.0, to_at_load_um = 50.0, over_s = 3.0, begin_s = 1.0").gap
    p = Axis.preset("ball-screw").p
    assert isinstance(gap, SCurve)
    assert (gap.begin_value, gap.end_value) == pytest.approx((5e-6 / p, 50e-6 / p), rel=1e-14)
    assert (gap.duration, gap.begin) == (3.0, 1.0)


def test_the_papers_servo_may_state_the_travel_of_its_screw(tmp_path: Path) -> None:
    gap = load(tmp_path, ("paper", "mm"), "total_at_load_um = 100.0").gap
    assert gap == pytest.approx(1e-4 / Servo.preset("paper").p, rel=1e-14)


@pytest.mark.parametrize(
    ("machine", "gap", "sentence"),
    [
        (JOINT, "total_at_load_um = 3.0", r"counts it in rad; here its name is 'gap.total_at_load_mdeg'"),
        (SCREW, "total_at_load_arcmin = 3.0", r"counts it in m; here its name is 'gap.total_at_load_um'"),
        (SCREW, "from_at_load_mdeg = 3.0, to_at_load_um = 9.0, over_s = 1.0", r"its name is 'gap.from_at_load_um'"),
        (
            SCREW,
            "total_deg = 1.0, total_at_load_um = 3.0",
            r"gap.total_deg = 1.0 and gap.total_at_load_um = 3.0: .*give only one",
        ),
        (
            SCREW,
            "from_at_load_um = 3.0, to_deg = 1.0, over_s = 1.0",
            r"gap.to_deg = 1.0 is not allowed; give both ends .* at the load",
        ),
        (SCREW, "from_at_load_um = 3.0, over_s = 1.0", r"key 'gap.to_deg' or 'gap.to_at_load_um' or .* is missing"),
        (
            JOINT,
            "total_arcmin = 3.0",
            r"'gap.total_at_load_mdeg' or .* is missing",
        ),
        (SCREW, "total_at_load_um = -3.0", r"gap.total_at_load_um = -3.0 is not allowed; give a number, at least 0"),
        (SCREW, "total_at_load_mm = 50.0", r"total_at_load_mm = 50.0 is not allowed; give .* at most 5 mm, one turn"),
        (
            JOINT,
            "to_at_load_deg = 400.0, from_at_load_deg = 0.0, over_s = 1.0",
            r"at most 360 deg, one turn of the load",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(
    tmp_path: Path, machine: tuple[str, str], gap: str, sentence: str
) -> None:
    with pytest.raises(InvalidInput, match=f"own.toml: .*{sentence}") as caught:
        load(tmp_path, machine, gap)
    assert "\n" not in str(caught.value)


STATED = """policy = "paper"
initial_gap_{first}
gap_limit_{limit}
uncertainty = {{gap_{pair}}}
trend = {{wear_{wear}, over_s = 1e6}}
triage = {{gap_{first}, widest_{first}}}
"""
AT_MOTOR = STATED.format(first="deg = 0.72", limit="deg = 3.6", pair="deg = [0.36, 3.6]", wear="deg = 1.8")
AT_LOAD = STATED.format(
    first="at_load_um = 10.0", limit="at_load_mm = 0.05", pair="at_load_um = [5, 50]", wear="at_load_um = 25.0"
)  # 5 mm per turn


def twin_of(text: str, plant: Axis | None) -> TwinSettings:
    """[twin] of a model's table."""
    if plant is None:
        return read_twin_settings(parse_toml(text, "twin.toml"))
    lines = "\n".join(["[models.one]", 'servo = "ball-screw"', "[models.one.twin]", text])
    return models_of(parse_toml(lines, "twin.toml"), Path())[0].settings


def test_a_twin_may_state_every_gap_at_the_load() -> None:
    screw = Axis.preset("ball-screw")
    motor, load_side = twin_of(AT_MOTOR, screw), twin_of(AT_LOAD, screw)
    assert load_side.uncertainty.gap == pytest.approx(motor.uncertainty.gap, rel=1e-14)
    assert load_side.initial_gap == pytest.approx(motor.initial_gap, rel=1e-14)
    assert load_side.gap_limit == pytest.approx(motor.gap_limit, rel=1e-14)
    assert load_side.trend.rate_std_rad_per_s == pytest.approx(motor.trend.rate_std_rad_per_s, rel=1e-14)
    assert load_side.triage is not None
    assert motor.triage is not None
    assert load_side.triage.gap == pytest.approx(motor.triage.gap, rel=1e-14)
    assert load_side.triage.widest == pytest.approx(motor.triage.widest, rel=1e-14)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            "gap_deg = [0, 1], gap_at_load_um = [0, 9]",
            r"gap_deg = \[0, 1\] and .*gap_at_load_um = \[0, 9\]: .* only one",
        ),
        ("gap_at_load_um = [0, 9], gap_at_load_mm = [0, 1]", "give only one"),
        ("gap_at_load_arcmin = [0, 9]", r"counts it in m; here its name is '.*uncertainty.gap_at_load_um'"),
        ("gap_at_load_um = [9, 0]", "give two numbers, the lower one first"),
        ("gap_at_load_um = [-1, 9]", "give a number, at least 0"),
        ("gap_at_load_mm = [0, 6]", "at most 5 mm, one turn"),
    ],
)
def test_what_a_twin_cannot_mean_is_refused_in_one_sentence(given: str, sentence: str) -> None:
    with pytest.raises(InvalidInput, match=f"twin.toml: .*uncertainty.*{sentence}") as caught:
        twin_of(f"uncertainty = {{{given}}}", Axis.preset("ball-screw"))
    assert "\n" not in str(caught.value)


def test_without_a_machine_gaps_count_at_the_motor() -> None:
    with pytest.raises(InvalidInput, match=r"gap_limit_at_load_um = 5.0: no machine is known here; give gap_limit_deg"):
        twin_of("gap_limit_at_load_um = 5.0", None)
