"""`edge.toml`: reader and writer of an `EdgeConfig`; a written one reads back equal, bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from servotwin.config.keys import Maker, key
from servotwin.config.own_units import VOLTS_METRES, OwnUnits
from servotwin.config.table import Table, check_complete, named, read_toml, with_end
from servotwin.config.toml import Values, attribute, dumps, kind_of, part, read, values_of
from servotwin.control.controller import Controller
from servotwin.control.gains import has_gains, read_gains, written_gains
from servotwin.control.laws import CONTROLLERS, FILTERED_PID, LINEAR_LAW, AnyController
from servotwin.control.laws import kind_of as kind_of_law
from servotwin.control.linear_law_file import matrices_law
from servotwin.edge.settings import AgentSettings
from servotwin.edge.settings_file import (
    gains_stay_table,
    read_start,
    read_supervision,
    start_values,
    supervision_values,
)
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.errors import InvalidInput
from servotwin.messages import AnyGains
from servotwin.novelty.settings import NoveltySettings

LAWS: Mapping[str, Maker] = {**CONTROLLERS, LINEAR_LAW: matrices_law}
"""Controllers of an edge's file, by their key `kind`."""


def load(path: str | os.PathLike[str]) -> EdgeConfig:
    """Read the configuration in a file.

    Raises
    ------
    InvalidInput
        The file is missing or not TOML, a key is unknown or missing, or its value is not allowed.
    """
    check_complete(Path(path), "copy the edge's folder again")
    config = read_config(read_toml(path))
    return replace(config, folder=Path(path).resolve().parent)


def read_config(table: Table) -> EdgeConfig:
    """Read the configuration in a table."""
    table = table.in_units(_units(table))
    with named(table):
        controller = _controller(table) if "controller" in table.values else None
        drive = dict(table.table("drive", required=True).values)
        agent = _agent(table, controller)
        config: EdgeConfig = read(
            table, EdgeConfig, agent=agent, controller=controller, drive=drive, source=table.source
        )
    table.known("controller", "own", "start", "novelty")
    table.done()
    return config


def _units(table: Table) -> OwnUnits | None:
    """Units of the keys; None: as they are declared, but a probing move may then be in degrees."""
    units = OwnUnits(*(attribute(table, EdgeConfig, name) for name in ("command_unit", "position_unit")))
    return None if units == VOLTS_METRES else units


def update_gains_table(
    update_gains: Annotated[bool, key(help="Updates may set gains too, not only the dead zone.")] = False,
) -> bool:
    """Return True where updates may set gains."""
    return update_gains


def _controller(table: Table) -> AnyController:
    """Read the controller, a filtered PID or what its `kind` says; its sample rate is the recording's by default."""
    inner = table.table("controller")
    inner.known("kind")
    controller: AnyController = read(inner, LAWS[kind_of(inner, LAWS, FILTERED_PID)])
    inner.done()
    if controller.sample_rate is not None:
        return controller
    return controller.replace(sample_rate=attribute(table, AgentSettings, "sample_rate"))


def _agent(table: Table, controller: AnyController | None) -> AgentSettings:
    settable = controller if read(table, update_gains_table) else None

    def gains(inner: Table) -> AnyGains | None:
        stay, _ = read(inner, gains_stay_table), given(inner)
        return None if stay or settable is None else read_gains(inner, settable)

    def start_gains(inner: Table) -> AnyGains | None:
        return read_gains(inner, settable) if given(inner) and settable is not None else None

    def given(inner: Table) -> bool:
        found = controller is not None and has_gains(inner, type(controller))
        if found and settable is None:
            raise InvalidInput(f"[{inner.name}] has gains, which need update_gains = true; set that, or leave them out")
        return found

    start, supervision = table.table("start"), table.table("supervision")
    agent: AgentSettings = read(
        table,
        AgentSettings,
        boot=UNBOOTED,
        controller=settable,
        own=_own(table.table("own"), gains) if "own" in table.values else None,
        parameters=read_start(start, start_gains),
        supervision=read_supervision(supervision, gains),
        window_filter=part(table, "novelty", NoveltySettings) if "novelty" in table.values else None,
        units=table.units or VOLTS_METRES,
    )
    start.done()
    supervision.done()
    return agent


def _own(table: Table, gains: Callable[[Table], AnyGains | None]) -> AnyGains | None:
    own = gains(table)
    table.done()
    return own


def edge_toml(config: EdgeConfig) -> str:
    """Write the text of `edge.toml`.

    Parameters
    ----------
    config : EdgeConfig
        Its folder is not written; paths stay relative to it.
    """
    agent = config.agent
    values: Values = {
        **values_of(config, only=("command_unit", "position_unit")),
        **values_of(agent),
        **values_of(config),
        "update_gains": agent.controller is not None,
        "drive": {},
        "start": start_values(agent.parameters, agent.controller),
        "supervision": supervision_values(agent.supervision, agent.controller),
    }
    if config.controller is not None:
        kind = kind_of_law(config.controller)
        named: Values = {} if isinstance(config.controller, Controller) else {"kind": kind}
        values["controller"] = {**named, **values_of(config.controller, LAWS[kind])}
    if agent.own is not None:
        values["own"] = written_gains(agent.own, agent.controller)
    if isinstance(agent.window_filter, NoveltySettings):
        values["novelty"] = values_of(agent.window_filter)
    # The keys of a drive are its own.
    shown = config.units.named(values) | {"drive": dict(config.drive)}
    return with_end(dumps(shown))
