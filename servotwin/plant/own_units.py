"""Keys that a file gives in the units of its machine: mm or degrees, V or the unit of another actuator's command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from servotwin.config.keys import Maker, items_of
from servotwin.config.table import Table
from servotwin.config.units import unit_of
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.axis_file import controller_keys
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.plants import Plant

INPUT_BIAS_KEYS = ("input_bias_v", "input_bias_n_m", "input_bias_rad_per_s", "input_bias_rad")
"""Keys of an input bias, in the unit of each actuator's command."""


def check_own_units(table: Table, plant: Plant, declared: Mapping[str, Sequence[Maker]]) -> None:
    """Refuse keys in a unit that is not the machine's, where another name of them has the machine's.

    Parameters
    ----------
    table : Table
    plant : Servo or Axis
    declared : mapping
        Dotted path of an inner table to what declares its keys.

    Raises
    ------
    InvalidInput
        With the right name of the key.
    """
    for path, makers in declared.items():
        values = _inner(table.values, path)
        for item in (item for maker in makers for item in items_of(maker)):
            kinds = {unit_of(name).si for name in item.names}
            if len(kinds) < 2:
                continue
            own = command_unit(plant) if "V" in kinds else position_unit(plant).si
            fitting = [name for name in item.names if unit_of(name).si == own]
            for name in values:
                if name in item.names and name not in fitting:
                    raise InvalidInput(
                        f"{table.source}: unknown key '{table.path(path)}.{name}': this machine counts it in {own}; "
                        f"here its name is '{table.path(path)}.{fitting[0]}'"
                    )


def own_controller(table: Table, name: str, plant: Plant) -> Table:
    """Inner table of a controller, whose keys have the units of the machine's own file; end it with `done()`.

    Raises
    ------
    InvalidInput
        A key has another unit.
    """
    inner = table.table(name)
    if not isinstance(plant, Axis) or isinstance(plant.controller, LinearLaw):
        return inner
    return inner.renamed(controller_keys(plant.actuator.unit, plant.load.motion, type(plant.controller)))


def _inner(values: Mapping[str, Any], path: str) -> Mapping[str, Any]:
    """Values of an inner table, as the file gives them; none where it has none."""
    for name in path.split("."):
        inner = values.get(name, {})
        values = inner if isinstance(inner, Mapping) else {}
    return values
