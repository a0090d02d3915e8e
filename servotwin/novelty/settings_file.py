"""Novelty in TOML: rules as a person writes them, the model as a program does; both are read back bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from math import pi
from typing import Any

from servotwin.config.table import Reader, Table, given, part
from servotwin.novelty.settings import NoveltyModel, NoveltyRules, NoveltySettings, ResponseMode

DEG = pi / 180.0
_ANGLES = ("resolution", "worth", "margin", "travel", "settle", "outlier")


def _degrees(table: Table, key: str) -> float:
    return table.number(key, infinite=True) * DEG


def _number(table: Table, key: str) -> float:
    return table.number(key, infinite=True)


RULES: Mapping[str, Reader] = {
    **{f"{name}_deg": (name, _degrees) for name in _ANGLES},
    **{f"{name}_rad": (name, _number) for name in _ANGLES},
    **{name: (name, _number) for name in ("score_limit", "allowance", "cusum_limit", "period_s", "look_s")},
    **{name: (name, Table.integer) for name in ("relearn", "learn", "confirm", "patience")},
}


def rules(table: Table) -> NoveltyRules:
    """When a window is worth sending."""
    return NoveltyRules(**given(table, RULES))


def settings(table: Table) -> NoveltySettings:
    """Rules, with the model in an inner table `model`."""
    gap = table.number("gap_rad", table.number("gap_deg", 0.0, minimum=0.0) * DEG, minimum=0.0)
    return NoveltySettings(part(table, "model", model), rules(table), gap)


def model(table: Table) -> NoveltyModel:
    """The structure, mode by mode."""
    decay, gain = (_complex(table, name) for name in ("decay", "gain"))
    if len(decay) != len(gain):
        raise table.invalid("decay_real", f"as many numbers as gain_real has, {len(gain)}")
    return NoveltyModel(
        table.number("sample_rate_hz", positive=True),
        tuple(ResponseMode(*pair) for pair in zip(decay, gain, strict=True)),
        table.number("direct_m_per_rad"),
        table.number("static_gain_m_per_rad"),
        table.number("unseen_s", minimum=0.0),
        table.integer("decimation", minimum=1),
    )


def _complex(table: Table, name: str) -> list[complex]:
    real, imaginary = (table.numbers(f"{name}_{half}") for half in ("real", "imag"))
    halves = [half if isinstance(half, tuple) else (half,) for half in (real, imaginary)]
    if len(halves[0]) != len(halves[1]):
        raise table.invalid(f"{name}_imag", f"as many numbers as {name}_real has, {len(halves[0])}")
    return [complex(*pair) for pair in zip(*halves, strict=True)]


def written(described: NoveltySettings) -> dict[str, Any]:
    """The values of a table, with an inner one, that `settings` reads back equal."""
    known = described.rules
    names = {name: f"{name}_rad" for name in _ANGLES}
    values = {names.get(field.name, field.name): getattr(known, field.name) for field in fields(known)}
    return {**values, "gap_rad": described.gap, "model": _model(described.model)}


def _model(known: NoveltyModel) -> dict[str, Any]:
    decay, gain = ([mode.decay for mode in known.modes], [mode.gain for mode in known.modes])
    return {
        "sample_rate_hz": known.rate,
        "decay_real": [each.real for each in decay],
        "decay_imag": [each.imag for each in decay],
        "gain_real": [each.real for each in gain],
        "gain_imag": [each.imag for each in gain],
        "direct_m_per_rad": known.direct,
        "static_gain_m_per_rad": known.static_gain,
        "unseen_s": known.unseen,
        "decimation": known.factor,
    }
