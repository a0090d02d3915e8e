"""Options that state a gap may do so at the load."""

import json
import math

import pytest
from typer.testing import CliRunner

from servotwin.analysis.maps.axes import PhysicalAxes
from servotwin.cli.app import app
from servotwin.cli.gap_options import stated_gap
from servotwin.cli.map.options import MapOptions
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo

SCREW, JOINT = "ball-screw", "robot-joint"


@pytest.mark.parametrize(
    ("machine", "at_load", "si"),
    [
        (SCREW, {"gap_at_load_um": 12.0}, 12e-6),
        (JOINT, {"gap_at_load_mdeg": 50.0}, math.radians(0.05)),
        (JOINT, {"gap_at_load_arcmin": 3.0}, math.radians(0.05)),
    ],
)
def test_a_gap_at_the_load_counts_over_the_ratio(machine: str, at_load: dict[str, float], si: float) -> None:
    plant = Axis.preset(machine)
    form, value = stated_gap("gap", None, at_load, machine, plant)
    assert value is not None
    assert form.at_motor(value) == pytest.approx(si / plant.p, rel=1e-14)
    assert form.shown(si / plant.p) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("limit-cycle", SCREW, "--gap-deg", "1", "--gap-at-load-um", "9"),
            "--gap-deg 1 and --gap-at-load-um 9: a gap",
        ),
        (("limit-cycle", SCREW, "--gap-at-load-arcmin", "3"), "counts in m; give --gap-at-load-um"),
        (("limit-cycle", JOINT, "--gap-at-load-um", "3"), "counts in rad; give --gap-at-load-mdeg"),
        (("limit-cycle", SCREW, "--gap-at-load-um", "6000"), "6000 µm at the load: must be from 0 to 5000, one turn"),
        (("map", SCREW, "--gap-deg", "1:2:3", "--gap-at-load-um", "9"), "a gap is stated once"),
        (("map", SCREW, "--gap-at-load-um", "1:9:3", "--estimate-at-load-mdeg", "9"), "give --estimate-at-load-um"),
        (("map", SCREW, "--gap-at-load-um", "1:9"), "--gap-at-load-um '1:9': is no list of values"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(arguments: tuple[str, ...], sentence: str) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert sentence in " ".join(result.output.split())


@pytest.mark.slow
def test_a_limit_cycle_is_that_of_the_same_gap_at_the_motor() -> None:
    pitch = Servo.preset("paper").p
    at_load, at_motor = (
        json.loads(CliRunner().invoke(app, ["limit-cycle", "paper", *given, "--json"]).output)["describing_function"]
        for given in (("--gap-at-load-um", "100"), ("--gap-deg", repr(math.degrees(1e-4 / pitch))))
    )
    amplitudes = [[one["amplitude_mm"] for one in each] for each in (at_load, at_motor)]
    assert amplitudes[0]
    assert amplitudes[0] == pytest.approx(amplitudes[1], rel=1e-9)


def test_maps_take_gaps_and_estimates_at_the_load() -> None:
    pitch = Axis.preset(SCREW).p
    at_load = {"gap_at_load_um": "5,10", "estimate_at_load_um": "8"}
    axes = MapOptions(SCREW, at_load=at_load, amplitude_mm="0.1").settings().axes
    assert isinstance(axes, PhysicalAxes)
    assert axes.gap == pytest.approx((5e-6 / pitch, 10e-6 / pitch), rel=1e-14)
    assert axes.estimate == pytest.approx((8e-6 / pitch,), rel=1e-14)
