"""The edge's supervision in TOML tables: which key, in which unit, sets what."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf

from servotwin.config.table import Reader, Table, given
from servotwin.edge.limits import Limits
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import Supervision
from servotwin.edge.watch import WatchSettings
from servotwin.messages import Band, Gains, Setting

MM = 1e-3
GainsReader = Callable[[Table], Gains | None]
"""Reads the gains that a table gives, with those of the running controller for the others; None: gains stay."""


def _millimetres(table: Table, key: str) -> float:
    return table.number(key, minimum=0.0, infinite=True) * MM


def length(table: Table, name: str, default: float | None = None) -> float:
    """A length in m, at least 0: `name_mm`, or `name_m` where a program wrote it to the last bit."""
    exact, key = f"{name}_m", f"{name}_mm"
    table.known(exact, key)
    if exact in table.values:
        return table.number(exact, minimum=0.0, infinite=True)
    if key not in table.values and default is not None:
        return default
    return _millimetres(table, key)


def _number(table: Table, key: str) -> float:
    return table.number(key, infinite=True)


def _metres(table: Table, key: str) -> float:
    return table.number(key, minimum=0.0, infinite=True)


LIMITS: Mapping[str, Reader] = {
    "minimum_m": ("minimum", _metres),
    "maximum_m": ("maximum", _metres),
    "max_step_m": ("max_step", _metres),
    "max_rate_m_per_s": ("max_rate", _metres),
    "minimum_mm": ("minimum", _millimetres),
    "maximum_mm": ("maximum", _millimetres),
    "max_step_mm": ("max_step", _millimetres),
    "max_rate_mm_per_s": ("max_rate", _millimetres),
    "lifetime_s": ("lifetime_s", _number),
    "interval_s": ("interval_s", _number),
    "patience_s": ("patience_s", _number),
    "gain_factor": ("gain_factor", _number),
    "integral_factor": ("integral_factor", _number),
    "gain_step_factor": ("gain_step", _number),
    "gain_factor_per_s": ("gain_rate", _number),
    "feedforward_v": ("feedforward", _number),
}
PROBE: Mapping[str, Reader] = {
    "interval_s": ("interval_s", Table.number),
    "rest_s": ("rest_s", Table.number),
}
WATCH: Mapping[str, Reader] = {
    "slot_s": ("slot_s", Table.number),
    "window_s": ("window_s", Table.number),
    "settling_s": ("settling_s", Table.number),
    "margin": ("margin", Table.number),
    "overshoot": ("overshoot", Table.number),
    "persist_s": ("persist_s", Table.number),
    "error_floor_m": ("error_floor", _metres),
    "error_floor_mm": ("error_floor", _millimetres),
    "effort_floor_v": ("effort_floor", Table.number),
    "swings": ("swings", Table.integer),
    "similarity": ("similarity", Table.number),
}


def probe(table: Table) -> ProbeLimits:
    """Which probing moves the twin may request."""
    return ProbeLimits(**{"size": length(table, "size"), **given(table, PROBE)})


def limits(table: Table) -> Limits:
    """What updates must respect."""
    return Limits(**given(table, LIMITS))


def supervision(table: Table, gains: GainsReader) -> Supervision:
    """How the edge looks after itself: to a table `fallback` it falls back, with `watched = false` on silence only."""
    fallback = _fallback(table.table("fallback"), gains) if "fallback" in table.values else None
    watched = table.boolean("watched", True)
    return Supervision(fallback, _watch(table.table("watch")) if watched else None, table.number("period_s", 0.05))


def _fallback(table: Table, gains: GainsReader) -> FallbackSet:
    tolerance = length(table, "tolerance", 0.0)
    found_band = band(table.table("band")) if "band" in table.values else None
    found = FallbackSet(
        Setting(tolerance, gains(table), found_band),
        table.number("silence_s", inf, positive=True, infinite=True),
        table.number("refuse_s", FallbackSet(Setting(0.0)).refuse_s, minimum=0.0),
    )
    table.done()
    return found


def band(table: Table) -> Band:
    """What a loop is predicted to stay within."""
    error, error_rms = (length(table, name) for name in ("error", "error_rms"))
    found = Band(error, error_rms, table.number("effort_v", minimum=0.0), table.number("settling_s", minimum=0.0))
    table.done()
    return found


def _watch(table: Table) -> WatchSettings:
    found = WatchSettings(**given(table, WATCH))
    table.done()
    return found
