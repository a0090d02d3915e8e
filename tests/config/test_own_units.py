"""Keys in the units of a machine, in tables that are read and written."""

import dataclasses
import math
from typing import Annotated

import pytest

from servotwin.config.keys import check, key, settings
from servotwin.config.own_units import COMMANDS, POSITIONS, VOLTS_METRES, OwnUnits
from servotwin.config.table import Table
from servotwin.config.toml import read, values_of
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput

JOINT = OwnUnits("N m", "rad")
DRIVE = OwnUnits("rad/s", "m")


@pytest.mark.parametrize(
    ("units", "declared", "own"),
    [
        (JOINT, "kp_v_per_m", "kp_n_m_per_rad"),
        (JOINT, "ki_v_per_m_s", "ki_n_m_per_rad_s"),
        (JOINT, "rate_limit_v_per_s", "rate_limit_n_m_per_s"),
        (JOINT, "voltage_limit_v", "torque_limit_n_m"),
        (JOINT, "error_mm", "error_deg"),
        (JOINT, "least_misfit_um", "least_misfit_mdeg"),
        (JOINT, "bias_mv", "bias_mn_m"),
        (DRIVE, "bias_mv", "bias_mrad_per_s"),
        (JOINT, "max_rate_mm_per_s", "max_rate_deg_per_s"),
        (JOINT, "static_gain_m_per_rad", "static_gain_rad_per_rad"),
        (DRIVE, "kd_v_s_per_m", "kd_rad_per_s_s_per_m"),
        (DRIVE, "voltage_limit_v", "speed_limit_rad_per_s"),
        (DRIVE, "error_mm", "error_mm"),
        # No position: a torque, a stiffness, an inertia, an angle, a signal's name, a share.
        *(
            (JOINT, name, name)
            for name in (
                "bias_n_m",
                "k_n_per_m",
                "mass_kg_m2",
                "gap_deg",
                "theta_m_rad",
                "k_m_percent",
                "model_version",
            )
        ),
    ],
)
def test_a_key_has_the_units_of_its_machine(units: OwnUnits, declared: str, own: str) -> None:
    assert units.key(declared) == own
    assert VOLTS_METRES.key(declared) == declared


@pytest.mark.parametrize("position", POSITIONS)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_key_of_a_controller_says_its_unit(command: str, position: str) -> None:
    units = OwnUnits(command, position)
    declared = ("kp_v_per_m", "ki_v_per_m_s", "kd_v_s_per_m", "x_v", "x_mv", "x_m", "x_um", "x_v_per_s")
    names = [units.key(name) for name in declared]
    said = [unit_of(name).name for name in names]
    assert all(said)
    assert "V" not in "".join(said) or command == "V"


@settings("guard")
@dataclasses.dataclass(frozen=True)
class Guard:
    error: Annotated[float, key("error_mm", "error_m", minimum=0.0, help="Error.")]
    effort: Annotated[float, key("effort_v", help="Effort.")] = 1.0
    move: Annotated[float, key("move_mm", "move_m", "move_deg", "move_rad", help="Move.")] = 0.0
    bias: Annotated[float, key("bias_v", "bias_n_m", "bias_rad_per_s", "bias_rad", help="Bias.")] = 0.0

    def __post_init__(self) -> None:
        check(self)


def read_guard(values: dict[str, object], units: OwnUnits | None) -> Guard:
    table = Table("edge.toml", values, "guard", units)
    guard: Guard = read(table, Guard)
    table.done()
    return guard


def test_degrees_are_read_as_radians() -> None:
    guard = read_guard({"error_deg": 90.0, "effort_n_m": 2.0, "move_deg": 180.0, "bias_n_m": 0.5}, JOINT)
    assert guard == Guard(0.5 * math.pi, 2.0, math.pi, 0.5)


@pytest.mark.parametrize("units", [None, VOLTS_METRES, JOINT, DRIVE, OwnUnits("rad", "rad")])
def test_what_is_written_reads_back_bit_for_bit(units: OwnUnits | None) -> None:
    guard = Guard(0.1 + 0.2, 1.0 / 3.0)
    written = values_of(guard, only=("error", "effort"))
    assert read_guard(written if units is None else units.named(written), units) == guard


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"error_mm": 1.0}, "'guard.error_mm': this machine counts it in rad; here its name is 'guard.error_deg'"),
        ({"error_m": 1.0}, "here its name is 'guard.error_rad'"),
        ({"error_rad": 1.0, "effort_v": 1.0}, "counts it in N m; here its name is 'guard.effort_n_m'"),
        ({"error_rad": 1.0, "move_mm": 1.0}, "here its name is 'guard.move_deg'"),
        ({"error_rad": 1.0, "bias_v": 1.0}, "here its name is 'guard.bias_n_m'"),
        ({"error_deg": -1.0}, "guard.error_deg = -1.0 is not allowed; give a number, at least 0"),
        ({}, "key 'guard.error_deg' or 'guard.error_rad' is missing"),
        ({"error_rad": 1.0, "eror_rad": 1.0}, "unknown key 'guard.eror_rad'"),
    ],
)
def test_a_key_in_another_unit_is_refused_by_its_right_name(given: dict[str, object], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        read_guard(given, JOINT)


def test_what_one_view_of_a_table_has_read_the_other_has_too() -> None:
    table = Table("twin.toml", {"servo": "x", "error_rad": 1.0})
    table.text("servo")
    assert read(table.in_units(JOINT), Guard) == Guard(1.0)
    table.done()
