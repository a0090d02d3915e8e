"""The table [drive] of an edge's file: which drive, and what it is told. Each kind is imported when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from servotwin.config.table import Table, named
from servotwin.edge.drive import ControlDrive, SupervisedDrive

_Drive = TypeVar("_Drive")


def control_drive(table: Table, folder: Path) -> ControlDrive:
    """A drive whose voltage the edge sets; not connected yet. Paths are relative to `folder`.

    Raises
    ------
    InvalidInput
        A key is unknown, missing or not allowed, or the kind has no such role.
    """
    return _read(table, folder, {"simulated": _controlled})


def supervised_drive(table: Table, folder: Path) -> SupervisedDrive:
    """The same of a drive with its own controller."""
    return _read(table, folder, {"simulated": _supervised, "replay": _replay, "opcua": _opcua})


def _read(table: Table, folder: Path, kinds: dict[str, Callable[[Table, Path], _Drive]]) -> _Drive:
    make = kinds[table.text("kind", choices=tuple(kinds))]
    with named(table):
        drive = make(table, folder)
    table.done()
    return drive


def _controlled(table: Table, folder: Path) -> ControlDrive:
    from servotwin.drives.simulated.client import SimulatedControl

    return SimulatedControl(_address(table, folder), _silence(table))


def _supervised(table: Table, folder: Path) -> SupervisedDrive:
    from servotwin.drives.simulated.client import SimulatedSupervised

    return SimulatedSupervised(_address(table, folder), _silence(table))


def _replay(table: Table, folder: Path) -> SupervisedDrive:
    from servotwin.drives.replay import Replay

    return Replay(
        folder / table.text("log"),
        table.number("speed", 1.0, minimum=0.0),
        table.boolean("loop", False),
        table.number("block_s", 0.05, positive=True),
    )


def _opcua(table: Table, folder: Path) -> SupervisedDrive:
    from servotwin.drives.opcua.drive import OpcUaDrive
    from servotwin.drives.opcua.settings import of_table

    return OpcUaDrive(of_table(table, folder))


def _address(table: Table, folder: Path) -> str:
    """Where the machine listens; the path of a socket is relative to the file."""
    address = table.text("address")
    kind, _, path = address.partition(":")
    return f"unix:{folder / path}" if kind == "unix" and path else address


def _silence(table: Table) -> float:
    return table.number("silence_s", 5.0, minimum=0.0)
