"""Units in which the files of a machine count its commands and positions."""

from __future__ import annotations

from servotwin.config.own_units import OwnUnits
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.plants import Plant

INPUT_BIAS_KEYS = ("input_bias_v", "input_bias_n_m", "input_bias_rad_per_s", "input_bias_rad")
"""Keys of an input bias, in the unit of each actuator's command."""


def own_units(plant: Plant) -> OwnUnits:
    """Units of a machine's command and position: volts and metres of a servo."""
    return OwnUnits(command_unit(plant), position_unit(plant).si)
