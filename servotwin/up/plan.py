"""Plan of a folder of `servotwin up`: its servos, and the files of their first start."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import msgspec

from servotwin.runtime.retry import Retry

TWIN, OPERATOR, LOCK = "twin.toml", "operator.token", "lock"
EDGE, MACHINE, DRIVE = "edge.toml", "machine.toml", "drive.sock"
PLACEHOLDER = "http://127.0.0.1:1"
"""URL of the twin in the edges' files until its port is known."""
RETRY = Retry(0.5, 2.0, 2.0)


class ServoPlan(msgspec.Struct, frozen=True):
    """One servo and its machine.

    Attributes
    ----------
    name : str
    trait : str
        What distinguishes it, for the display.
    role : str
        "control": the edge runs the law at every sample. "supervise": the machine has its own controller, and its
        samples come in blocks.
    policy : str
        Of its twin.
    outages : bool
        Its link has outages.
    """

    name: str
    trait: str
    role: str
    policy: str
    outages: bool = False


class Plan(Protocol):
    """Source of a new folder: its servos and their files."""

    @property
    def servos(self) -> tuple[ServoPlan, ...]:
        """The servos."""

    @property
    def speed(self) -> float | None:
        """Machine time per time; None: as fast as the processor's share allows."""

    @property
    def digest(self) -> str:
        """Digest of everything that the folder is made from."""

    def write_twin(self, path: Path) -> None:
        """Write the twin's file into the folder."""

    def write_servo(self, servo: ServoPlan, path: Path) -> None:
        """Write the files of a servo's machine and edge into its folder in this one, and enrol it."""
