"""Which drive a configuration asks for."""

from servotwin.drives import table
from servotwin.edge.drive import ControlDrive, SupervisedDrive
from servotwin.edge_process.config import EdgeConfig


def control_drive(config: EdgeConfig) -> ControlDrive:
    """For the role control, not connected yet; raises InvalidInput."""
    return table.control_drive(config.drive_table, config.folder)


def supervised_drive(config: EdgeConfig) -> SupervisedDrive:
    """For the role supervise, not connected yet; raises InvalidInput."""
    return table.supervised_drive(config.drive_table, config.folder)
