"""The drive that an edge's configuration names."""

from __future__ import annotations

from pathlib import Path

from servotwin.drives import table
from servotwin.edge.drive import Drive
from servotwin.edge_process.config import EdgeConfig
from servotwin.errors import InvalidInput


def drive_of(config: EdgeConfig, path: Path) -> Drive:
    """Make the drive of the edge's file, not connected yet; refuse probing moves that it cannot make."""
    if config.role == "control":
        return table.control_drive(config.drive_table, config.folder)
    drive = table.supervised_drive(config.drive_table, config.folder, config.agent.motor_encoder)
    if config.agent.probe is not None and not drive.can_move:
        raise InvalidInput(f"{path}: edge.probe: this drive cannot move its reference; leave the table out")
    return drive


def check_drive(config: EdgeConfig) -> None:
    """Check the table of a drive before its edge exists, and the log that it names.

    Certificates and secrets of OPC UA may be on the edge's computer only: of such a drive the role alone is checked.

    Raises
    ------
    InvalidInput
        The role has no such drive, a key is not allowed, or the log cannot be read.
    """
    given = config.drive_table
    kinds = table.CONTROLLED if config.role == "control" else table.SUPERVISED
    if given.text("kind", choices=tuple(kinds)) != "opcua":
        drive_of(config, Path(config.source)).close()
