"""Which drive a configuration asks for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import cast

from servotwin.edge.drive import ControlDrive, Drive, SupervisedDrive
from servotwin.gateway.config import EdgeConfig
from servotwin.tomltable import Table

Reader = Callable[[Table, str, Path], Drive]
"""Makes a drive of a table, for a role, with paths relative to a folder; does not connect it."""


def _simulated(table: Table, role: str, folder: Path) -> Drive:
    from servotwin.drives.simulated import client

    address = table.text("address")
    silence = table.number("silence_s", 5.0, minimum=0.0)
    kind, _, path = address.partition(":")
    placed = f"unix:{folder / path}" if kind == "unix" else address
    made = client.SimulatedControl if role == "control" else client.SimulatedSupervised
    return made(placed, silence)


KINDS: Mapping[str, Reader] = {"simulated": _simulated}


def control_drive(config: EdgeConfig) -> ControlDrive:
    """For the role control; raises InvalidInput."""
    return cast(ControlDrive, _drive(config))


def supervised_drive(config: EdgeConfig) -> SupervisedDrive:
    """For the role supervise; raises InvalidInput."""
    return cast(SupervisedDrive, _drive(config))


def _drive(config: EdgeConfig) -> Drive:
    table = config.drive_table
    kind = table.text("kind", choices=tuple(KINDS))
    drive = KINDS[kind](table, config.role, config.folder)
    table.done()
    return drive
