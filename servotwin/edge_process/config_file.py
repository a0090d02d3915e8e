"""`edge.toml`: which key, in which unit, sets what of an `EdgeConfig`; for reading and for writing."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from servotwin.config.table import Reader, Table, given, named, part, read_toml
from servotwin.config.toml import read as read_settings
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_given, read_gains
from servotwin.edge import settings_file as edgefile
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge_process.config import MB, ROLES, UNBOOTED, EdgeConfig, Keeping, SensorGuard, TwinLink
from servotwin.edge_process.config_writer import edge_toml
from servotwin.messages import Gains, Setting
from servotwin.novelty import settings_file as noveltyfile
from servotwin.runtime.retry import Retry

__all__ = ["edge_toml", "load", "read"]

_TWIN: Mapping[str, Reader] = {
    "url": ("url", Table.text),
    "token_file": ("token_file", Table.text),
    "token_env": ("token_env", Table.text),
    "ca_file": ("ca_file", Table.text),
    "timeout_s": ("timeout_s", Table.number),
    "wait_s": ("wait_s", Table.number),
    "user": ("user", Table.text),
    "password_file": ("password_file", Table.text),
    "password_env": ("password_env", Table.text),
}
_KEEPING: Mapping[str, Reader] = {
    "outbox": ("outbox", Table.text),
    "parameters": ("parameters", Table.text),
    "status": ("status", Table.text),
    "boots": ("boots", Table.text),
    "windows": ("windows", Table.integer),
    "megabytes": ("bytes", lambda table, key: round(table.number(key) * MB)),
}
_SENSOR: Mapping[str, Reader] = {
    "hold_s": ("hold_s", Table.number),
    "safe_voltage_v": ("safe_voltage", Table.number),
}
_RETRY: Mapping[str, Reader] = {
    "first_s": ("first_s", Table.number),
    "factor": ("factor", Table.number),
    "longest_s": ("longest_s", Table.number),
}
_WINDOW: Mapping[str, Reader] = {
    "window_s": ("window_s", Table.number),
    "pre_trigger_s": ("pre_trigger_s", Table.number),
    "longest_window_s": ("longest_window_s", Table.number),
    "longest_pre_trigger_s": ("longest_pre_trigger_s", Table.number),
    "fine_angle": ("fine_angle", Table.boolean),
}


def load(path: str | os.PathLike[str]) -> EdgeConfig:
    """The configuration in a file.

    Raises
    ------
    InvalidInput
        The file is missing or not TOML, a key is unknown or missing, or its value is not allowed.
    """
    config = read(read_toml(path))
    return replace(config, folder=Path(path).resolve().parent)


def read(table: Table) -> EdgeConfig:
    """The configuration in a table."""
    with named(table):
        rate = table.number("sample_rate_hz", positive=True)
        controller = part(table, "controller", lambda t: _controller(t, rate)) if "controller" in table.values else None
        config = EdgeConfig(
            agent=_agent(table, rate, controller),
            role=table.text("role", choices=ROLES),
            controller=controller,
            drive=dict(table.table("drive", required=True).values),
            twin=part(table, "twin", lambda t: TwinLink(**given(t, _TWIN))) if "twin" in table.values else None,
            keeping=part(table, "keep", lambda t: Keeping(**given(t, _KEEPING))),
            sensor=part(table, "sensor", lambda t: SensorGuard(**given(t, _SENSOR))),
            priority=table.integer("realtime_priority", 0),
            source=table.source,
        )
    table.known("controller", "twin", "own", "start", "probe", "novelty")
    table.done()
    return config


def _controller(table: Table, rate: float) -> Controller:
    """Sampled, as the samples are."""
    controller: Controller = read_settings(table, Controller)
    return controller if controller.sample_rate is not None else controller.replace(sample_rate=rate)


def _agent(table: Table, rate: float, controller: Controller | None) -> AgentSettings:
    """`update_gains` says whether updates may set gains."""
    settable = controller if table.boolean("update_gains", False) else None

    def gains(inner: Table) -> Gains | None:
        stay = inner.boolean("gains_stay", settable is None)
        return None if stay or settable is None else read_gains(inner, settable)

    probe = part(table, "probe", edgefile.probe) if "probe" in table.values else None
    return AgentSettings(
        servo=table.text("servo"),
        boot=UNBOOTED,
        sample_rate=rate,
        reference=_reference(table),
        model_version=table.text("model_version", ""),
        limits=part(table, "limits", edgefile.limits),
        retry=part(table, "retry", lambda t: Retry(**given(t, _RETRY))),
        controller=settable,
        own=part(table, "own", gains) if "own" in table.values else None,
        parameters=part(table, "start", lambda t: _start(t, settable)),
        supervision=part(table, "supervision", lambda t: _supervision(t, gains)),
        probe=probe,
        window_filter=part(table, "novelty", noveltyfile.settings) if "novelty" in table.values else None,
        **part(table, "window", lambda t: given(t, _WINDOW)),
    )


def _reference(table: Table) -> float:
    """Before the first sample, m; any sign."""
    table.known("reference_mm", "reference_m")
    return table.number("reference_m", table.number("reference_mm", 0.0) * edgefile.MM)


def _supervision(table: Table, gains: edgefile.GainsReader) -> Supervision:
    table.known("fallback", "watch")
    return edgefile.supervision(table, gains)


def _start(table: Table, controller: Controller | None) -> Parameters:
    """In force before the first update."""
    some = gains_given(table)
    return Parameters(
        setting=Setting(
            edgefile.length(table, "tolerance", 0.0),
            gains=read_gains(table, controller) if some and controller is not None else None,
            band=part(table, "band", edgefile.band) if "band" in table.values else None,
        ),
        fallback=table.boolean("fallback", False),
    )
