"""The estimators' settings in a TOML table: which key, in which unit, sets what."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from servotwin.config.table import Reader, Table, given
from servotwin.estimation import paper, whitened
from servotwin.estimation.gap import METHODS

DEG = math.pi / 180.0


def read(table: Table, method: str) -> Any:
    """The `Settings` of a method, from the keys that a table gives; its defaults for the others."""
    return METHODS[method].settings(**given(table, KEYS[method]))


def _degrees(table: Table, key: str) -> float:
    return table.number(key) * DEG


def _two_degrees(table: Table, key: str) -> tuple[float, float]:
    numbers = table.numbers(key)
    if not isinstance(numbers, tuple) or len(numbers) != 2:
        raise table.invalid(key, "two numbers, the offset and its standard deviation")
    return numbers[0] * DEG, numbers[1] * DEG


PAPER: Mapping[str, Reader] = {
    "alpha_rad_per_s": ("alpha", Table.number),
    "settle_s": ("settle_s", Table.number),
    "lowpass_hz": ("lowpass_hz", Table.number),
    "lowpass_order": ("lowpass_order", Table.integer),
    "padding": ("padding", Table.text),
    "padding_samples": ("padding_samples", Table.integer),
    "iterations": ("iterations", Table.integer),
    "origin": ("origin", Table.text),
    "reversals": ("reversals", Table.integer),
    "rest_speed_rad_per_s": ("rest_speed", Table.number),
    "contact_travel_deg": ("contact_travel", _degrees),
    "method_error_deg": ("method_error", _degrees),
    "largest_std_deg": ("largest_std", _degrees),
    "unexplained": ("unexplained", Table.number),
}
WHITENED: Mapping[str, Reader] = {
    "passes": ("passes", Table.integer),
    "order": ("order", Table.integer),
    "starts": ("starts", Table.integer),
    "kept": ("kept", Table.integer),
    "skew": ("skew", Table.boolean),
    "largest_skew_s": ("largest_skew", Table.number),
    "gap_rate_deg_per_s": ("gap_rate", _degrees),
    "offset_deg": ("offset", _two_degrees),
    "prefilter_hz": ("prefilter_hz", Table.number),
    "contact_travel_deg": ("contact_travel", _degrees),
    "largest_std_deg": ("largest_std", _degrees),
    "largest_shift_deg": ("largest_shift", _degrees),
    "model_error_deg": ("model_error", _degrees),
    "calibration": ("calibration", Table.number),
}
KEYS: Mapping[str, Mapping[str, Reader]] = {paper.METHOD: PAPER, whitened.METHOD: WHITENED}
