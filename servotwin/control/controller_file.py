"""A controller in a TOML table: which key, in which unit, sets what; for reading and for writing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotwin.config.table import Reader, Table, given
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.messages import Gains


def _positive(table: Table, key: str) -> Any:
    return table.number(key, positive=True)


def _positive_or_none(table: Table, key: str) -> Any:
    return table.number(key, None, positive=True)


def _multiple(table: Table, key: str) -> Any:
    return table.number(key, 1.0, minimum=0.0)


def _voltage(table: Table, key: str) -> Any:
    return table.number(key, 0.0)


def _release(table: Table, key: str) -> Any:
    return table.number(key, 0.5, positive=True)


KEYS: Mapping[str, Reader] = {
    "kp_v_per_m": ("Kp", Table.number),
    "ki_v_per_m_s": ("Ki", Table.number),
    "kd_v_s_per_m": ("Kd", Table.number),
    "filter_time_s": ("Tf", _positive),
    "enter_tolerances": ("enter", _multiple),
    "leave_tolerances": ("leave", _multiple),
    "loop_filter_hz": ("loop_filter_hz", _positive_or_none),
    "voltage_limit_v": ("voltage_limit", _positive_or_none),
    "rate_limit_v_per_s": ("rate_limit", _positive_or_none),
    "sample_rate_hz": ("sample_rate", _positive_or_none),
    "tracking_time_s": ("tracking_time", _positive_or_none),
    "feedforward_v": ("feedforward", _voltage),
    "release_time_s": ("release_time", _release),
}
GAINS: Mapping[str, Reader] = {key: reader for key, reader in KEYS.items() if reader[0] in Gains.__struct_fields__}
"""The keys of what an update may set."""


def controller(table: Table) -> Controller:
    """The controller that a table describes."""
    return Controller(**{symbol: read(table, key) for key, (symbol, read) in KEYS.items()})


def gains(table: Table, running: Controller) -> Gains:
    """The gains that a table gives, with those of the running controller for the others."""
    return gains_of(running.replace(**given(table, GAINS)))


def written(described: Controller | Gains) -> dict[str, float]:
    """The keys and values of a table that reads as this; what is None is left out."""
    values = {key: getattr(described, symbol, None) for key, (symbol, _) in KEYS.items()}
    return {key: value for key, value in values.items() if value is not None}
