"""A servo's TOML: which key holds which symbol in which unit, for reading and for writing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from servotwin.config.table import Table
from servotwin.control import controller_file


@dataclass(frozen=True)
class Key:
    """One key: its table, its name with unit, the symbol that it sets, and how it is read."""

    table: str
    name: str
    symbol: str
    read: Callable[[Table, str], Any]


def _positive(table: Table, key: str) -> Any:
    return table.number(key, positive=True)


def _stiffness(table: Table, key: str) -> Any:
    return table.number(key, float("inf"), positive=True, infinite=True)


def _each_positive(table: Table, key: str) -> Any:
    return table.numbers(key, positive=True)


def _each_nonnegative(table: Table, key: str) -> Any:
    return table.numbers(key, minimum=0.0)


def _resolution(table: Table, key: str) -> Any:
    return table.number(key, 0.0, minimum=0.0)


def _count(table: Table, key: str) -> Any:
    return table.integer(key, minimum=2)


PLANT = (
    Key("motor", "inertia_kg_m2", "J", _positive),
    Key("motor", "inductance_h", "L", _positive),
    Key("motor", "resistance_ohm", "R", _positive),
    Key("motor", "torque_gain_n_m_per_a", "k_T", _positive),
    Key("motor", "back_emf_v_s_per_rad", "k_B", _positive),
    Key("screw", "pitch_m_per_rad", "p", _positive),
    Key("screw", "stiffness_n_per_m", "k_d", _stiffness),
    Key("structure", "masses", "n", _count),
    Key("structure", "mass_kg", "m", _each_positive),
    Key("structure", "stiffness_n_per_m", "k", _each_positive),
    Key("structure", "damping_n_s_per_m", "c", _each_nonnegative),
    Key("sensors", "encoder_resolution_rad", "encoder_resolution", _resolution),
    Key("sensors", "position_resolution_m", "position_resolution", _resolution),
)
CONTROLLER = tuple(Key("controller", name, symbol, read) for name, (symbol, read) in controller_file.KEYS.items())


def read(table: Table) -> tuple[dict[str, Any], dict[str, Any]]:
    """Symbols of the plant and of the controller from a servo's file; refuses what it does not know."""
    names = dict.fromkeys(key.table for key in (*PLANT, *CONTROLLER))
    tables = {name: table.table(name, required=name != "sensors") for name in names}
    table.done()
    plant = {key.symbol: key.read(tables[key.table], key.name) for key in PLANT}
    controller = {key.symbol: key.read(tables[key.table], key.name) for key in CONTROLLER}
    for each in tables.values():
        each.done()
    return plant, controller


def write(plant: Mapping[str, Any], controller: Mapping[str, Any]) -> str:
    """The file's text; absent and None values are left out."""
    values = {**plant, **controller}
    lines: list[str] = []
    table = ""
    for key in (*PLANT, *CONTROLLER):
        if values.get(key.symbol) is None:
            continue
        if key.table != table:
            table = key.table
            lines += ["", f"[{table}]"] if lines else [f"[{table}]"]
        lines.append(f"{key.name} = {_literal(values[key.symbol])}")
    return "\n".join(lines) + "\n"


def _literal(value: float | tuple[float, ...]) -> str:
    """A TOML number or list with every digit that the value has."""
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)
