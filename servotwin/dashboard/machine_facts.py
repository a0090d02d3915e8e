"""Facts of a machine's model, read from the stored text of a context; the models themselves take long to import."""

from __future__ import annotations

import ast
import math
import tomllib
from dataclasses import dataclass, replace
from functools import lru_cache

import msgspec

_AXIS = "model.axis"
_COMMANDS = {"torque": "N m", "velocity": "rad/s", "stepper": "rad"}
"""Unit of the command of each kind of actuator that does not take volts."""


@dataclass(frozen=True)
class MachineFacts:
    """Facts of a machine's model.

    Attributes
    ----------
    policy : str
        The twin's; empty: unknown.
    gap_limit : float or None
        rad, largest acceptable gap; None: the twin's file states none.
    travel : float or None
        Travel of the load per radian of the gap, m/rad or rad/rad; None: unknown.
    travel_unit, command_unit : str
        Units of the load's travel, "m" or "rad", and of the command to the actuator; empty: unknown, as before the
        first estimate.
    """

    policy: str = ""
    gap_limit: float | None = None
    travel: float | None = None
    travel_unit: str = ""
    command_unit: str = ""


UNKNOWN = MachineFacts()


@lru_cache(maxsize=1024)
def machine_facts(context: str) -> MachineFacts:
    """Read the facts from the text of a context; what cannot be read is unknown."""
    try:
        parts = msgspec.json.decode(context, type=dict[str, str])
    except (msgspec.MsgspecError, ValueError):
        return UNKNOWN
    policy, limit = (_literal(parts.get(f"settings.{name}")) for name in ("policy", "gap_limit"))
    known = MachineFacts(policy if isinstance(policy, str) else "", _number(limit))
    if _AXIS in parts:
        return _of_axis(known, str(_literal(parts[_AXIS])))
    if "model.p" not in parts:
        return known
    return replace(known, travel=_number(_literal(parts["model.p"])), travel_unit="m", command_unit="V")


def _of_axis(known: MachineFacts, file: str) -> MachineFacts:
    """Add the facts in the file of an axis."""
    try:
        table = tomllib.loads(file)
        kind, rotary, transmission = table["actuator"]["kind"], table["load"]["kind"] == "rotary", table["transmission"]
        stated = (_number(transmission.get(name)) for name in ("pitch_m_per_rad", "travel_rad_per_rad"))
        travel, ratio = next(filter(None, stated), None), _number(transmission.get("ratio"))
    except (tomllib.TOMLDecodeError, KeyError, TypeError, AttributeError):
        return known
    return replace(
        known,
        travel=travel or (1.0 / ratio if ratio else None),
        travel_unit="rad" if rotary else "m",
        command_unit=_COMMANDS.get(kind, "V"),
    )


def _literal(text: str | None) -> object:
    try:
        return None if text is None else ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)
