"""An `EdgeConfig` as the text of `edge.toml`: what is read from it is equal, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from servotwin.config.toml import dumps, values_of
from servotwin.control.gains import written_gains
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge_process.config import MB, EdgeConfig
from servotwin.messages import Band, Gains
from servotwin.novelty import settings_file as noveltyfile
from servotwin.novelty.settings import NoveltySettings

Values = dict[str, Any]
_LENGTHS = {"minimum": "minimum_m", "maximum": "maximum_m", "max_step": "max_step_m", "max_rate": "max_rate_m_per_s"}
_LIMITS = {
    "gain_step": "gain_step_factor",
    "gain_rate": "gain_factor_per_s",
    "feedforward": "feedforward_v",
    **_LENGTHS,
}
_WATCH = {"error_floor": "error_floor_m", "effort_floor": "effort_floor_v"}
_BAND = {"error": "error_m", "error_rms": "error_rms_m", "effort": "effort_v", "settling": "settling_s"}


def edge_toml(config: EdgeConfig) -> str:
    """The text of `edge.toml`.

    Parameters
    ----------
    config : EdgeConfig
        Its folder is not written: paths stay as they are.
    """
    agent = config.agent
    top: Values = {
        "servo": agent.servo,
        "role": config.role,
        "sample_rate_hz": agent.sample_rate,
        "model_version": agent.model_version,
        "reference_m": agent.reference,
        "update_gains": agent.controller is not None,
        "realtime_priority": config.priority,
    }
    return dumps({**top, **_tables(config)})


def _tables(config: EdgeConfig) -> Values:
    """Those that say something; the order is the reader's."""
    agent, novelty = config.agent, config.agent.window_filter
    keep = _all(config.keeping, {"bytes": "megabytes"})
    tables: Values = {
        "drive": dict(config.drive),
        "twin": None if config.twin is None else _all(config.twin),
        "controller": None if config.controller is None else values_of(config.controller),
        "own": None if agent.own is None else written_gains(agent.own),
        "start": _start(agent.parameters),
        "window": _window(agent),
        "limits": _all(agent.limits, _LIMITS),
        "probe": None if agent.probe is None else _all(agent.probe, {"size": "size_m"}),
        "supervision": _supervision(agent.supervision),
        "novelty": noveltyfile.written(novelty) if isinstance(novelty, NoveltySettings) else None,
        "retry": _all(agent.retry),
        "keep": {**keep, "megabytes": config.keeping.bytes / MB},
        "sensor": _all(config.sensor, {"safe_voltage": "safe_voltage_v"}),
    }
    return {name: values for name, values in tables.items() if values is not None}


def _all(described: Any, names: Mapping[str, str] | None = None) -> Values:
    """Every field of a dataclass under its key; what is None is left out."""
    known = names or {}
    pairs = ((known.get(field.name, field.name), getattr(described, field.name)) for field in fields(described))
    return {key: value for key, value in pairs if value is not None}


def _start(parameters: Parameters) -> Values:
    values: Values = {"tolerance_m": parameters.setting.tolerance, "fallback": parameters.fallback}
    values |= {} if parameters.setting.gains is None else written_gains(parameters.setting.gains)
    return values | _band(parameters.setting.band)


def _band(band: Band | None) -> Values:
    return {} if band is None else {"band": {key: getattr(band, name) for name, key in _BAND.items()}}


def _window(agent: AgentSettings) -> Values:
    names = ("window_s", "pre_trigger_s", "longest_window_s", "longest_pre_trigger_s", "fine_angle")
    return {name: getattr(agent, name) for name in names if getattr(agent, name) is not None}


def _supervision(supervision: Supervision) -> Values:
    values: Values = {"period_s": supervision.period_s, "watched": supervision.watch is not None}
    if supervision.fallback is not None:
        values["fallback"] = _fallback(supervision.fallback)
    if supervision.watch is not None:
        values["watch"] = _all(supervision.watch, _WATCH)
    return values


def _fallback(fallback: FallbackSet) -> Values:
    names = ("silence_s", "refuse_s")
    values: Values = {"tolerance_m": fallback.setting.tolerance, **{name: getattr(fallback, name) for name in names}}
    own: Gains | None = fallback.setting.gains
    values |= {"gains_stay": True} if own is None else written_gains(own)
    return values | _band(fallback.setting.band)
