"""A twin's settings in TOML: which key, in which unit, sets what."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from servotwin.config.table import Reader, Table, given, part
from servotwin.estimation import settings_file as settingsfile
from servotwin.estimation.gap import METHODS
from servotwin.estimation.trend import TrendSettings
from servotwin.redesign.certified.certificate import Demands
from servotwin.redesign.certified.uncertainty import Range
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.settings import POLICIES, TwinSettings
from servotwin.twin.triage_settings import TriageSettings

DEG, MM = math.pi / 180.0, 1e-3


def _share(table: Table, key: str) -> float:
    """A percentage as a share."""
    return table.number(key, minimum=0.0) / 100.0


def _range(table: Table, key: str, unit: float) -> Range:
    ends = table.numbers(key)
    if not isinstance(ends, tuple) or len(ends) != 2:
        raise table.invalid(key, "two numbers, the least and the largest")
    return ends[0] * unit, ends[1] * unit


UNCERTAINTY: Mapping[str, Reader] = {
    "k_percent": ("k", _share),
    "c_percent": ("c", _share),
    "k_b_percent": ("k_B", _share),
    "m_percent": ("m", _share),
    "gap_deg": ("gap", lambda table, key: _range(table, key, DEG)),
    "step_mm": ("step", lambda table, key: _range(table, key, MM)),
    "input_bias_v": ("input_bias", lambda table, key: _range(table, key, 1.0)),
    "friction_n_m": ("friction", lambda table, key: _range(table, key, 1.0)),
}
DEMANDS: Mapping[str, Reader] = {
    "Ms": ("Ms", lambda table, key: table.number(key, minimum=1.0)),
    "settled_percent": ("settled", lambda table, key: table.number(key, minimum=0.0, maximum=100.0) / 100.0),
    "overshoot_percent": ("overshoot", _share),
}


EXCITATION: Mapping[str, Reader] = {
    "after": ("after", Table.integer),
    "window_s": ("window", Table.number),
    "pre_trigger_s": ("pre_trigger", Table.number),
    "probe_mm": ("probe", lambda table, key: table.number(key, minimum=0.0) * MM),
    "interval_s": ("interval", Table.number),
    "hold_s": ("hold", Table.number),
    "strokes": ("strokes", Table.integer),
    "margin_deg": ("margin", lambda table, key: table.number(key) * DEG),
}


TRIAGE: Mapping[str, Reader] = {
    "gap_deg": ("gap", lambda table, key: table.number(key) * DEG),
    "deviations": ("deviations", Table.number),
    "widest_deg": ("widest", lambda table, key: table.number(key) * DEG),
    "misfit": ("misfit", Table.number),
    "least_misfit_um": ("least_misfit", lambda table, key: table.number(key) * 1e-6),
    "bias_mv": ("bias", lambda table, key: table.number(key) * 1e-3),
    "every": ("every", Table.integer),
    "longest_s": ("longest", Table.number),
}


def _triage(table: Table) -> TriageSettings:
    return TriageSettings(**given(table, TRIAGE))


def _excitation(table: Table) -> ExcitationSettings:
    return ExcitationSettings(**given(table, EXCITATION))


def twin(table: Table, folder: Path = Path()) -> TwinSettings:
    """[twin] with its tables `estimator`, `trend`, `excitation`, `triage`, `uncertainty` and `demands`."""
    default = TwinSettings()
    method = table.text("method", default.method, choices=tuple(METHODS))
    limit = table.number("gap_limit_deg", None, minimum=0.0)
    return TwinSettings(
        enabled=table.boolean("enabled", True),
        method=method,
        estimator=part(table, "estimator", lambda inner: settingsfile.read(inner, method)),
        policy=table.text("policy", default.policy, choices=POLICIES),
        uncertainty=part(table, "uncertainty", lambda inner: default.uncertainty.replace(**given(inner, UNCERTAINTY))),
        demands=part(table, "demands", lambda inner: Demands(**given(inner, DEMANDS))),
        table=_path(table, "table", folder),
        k_dz=table.number("k_dz", None, minimum=0.0),
        smoothing=table.number("smoothing", None, minimum=0.0, maximum=1.0),
        k_noise=table.number("k_noise", None, minimum=0.0),
        excitation=part(table, "excitation", _excitation) if "excitation" in table.values else None,
        triage=part(table, "triage", _triage) if "triage" in table.values else None,
        initial_gap=table.number("initial_gap_deg", 0.0, minimum=0.0) * DEG,
        trend=part(table, "trend", _trend),
        gap_limit=None if limit is None else limit * DEG,
        processing=table.number("processing_s", default.processing, minimum=0.0),
        validity=table.number("validity_s", default.validity, positive=True),
        retry=table.number("retry_s", default.retry, positive=True),
        attempts=table.integer("attempts", default.attempts, minimum=1),
    )


def _path(table: Table, key: str, folder: Path) -> str | None:
    """A file's path, relative to `folder`."""
    return str(folder / table.text(key)) if key in table.values else None


def _trend(table: Table) -> TrendSettings:
    """How far (`wear_deg`) the gap may grow within how long (`over_s`)."""
    if not table.values:
        table.number("wear_deg", None)
        table.number("over_s", None)
        return TrendSettings()
    gap, over = table.number("wear_deg", positive=True), table.number("over_s", positive=True)
    return TrendSettings.for_wear(gap * DEG, over)
