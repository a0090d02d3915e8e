"""What is known of a servo at one moment: of its machine, its edge, its link and its twin."""

from __future__ import annotations

import time
from math import degrees
from pathlib import Path
from typing import Any, NamedTuple

from servotwin.drives.simulated.diary import MachineState, read_state
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.edge_process.monitoring import read_status
from servotwin.errors import InvalidInput
from servotwin.up.folder import MACHINE
from servotwin.up.plan import ServoPlan
from servotwin.up.twin_watch import Estimated


class Judged(NamedTuple):
    """An estimate beside the truth.

    Attributes
    ----------
    told : Estimated
    truth : float or None
        deg, total gap of the machine at the time that the estimate is for; None: that time is not known.
    age : float or None
        s of machine time since then.
    """

    told: Estimated
    truth: float | None
    age: float | None

    @property
    def error(self) -> float | None:
        """deg."""
        return None if self.truth is None else degrees(self.told.gap) - self.truth

    @property
    def inside(self) -> bool | None:
        """Whether the truth is within the interval."""
        low, high = map(degrees, self.told.interval)
        return None if self.truth is None else low <= self.truth <= high


class View(NamedTuple):
    """A servo at one moment.

    Attributes
    ----------
    plan : ServoPlan
    machine : MachineState or None
    edge : dict
        Its status; empty before the first.
    judged : Judged or None
    cut : int
        Windows cut since the start.
    outage : float
        s until its link's present outage is over; 0: there is none.
    restarts : int
        Of its machine and its edge.
    """

    plan: ServoPlan
    machine: MachineState | None
    edge: dict[str, Any]
    judged: Judged | None
    cut: int
    outage: float
    restarts: int


class Reader:
    """Looks at the files of one servo.

    Parameters
    ----------
    plan : ServoPlan
    folder : Path
        The servo's own.
    """

    def __init__(self, plan: ServoPlan, folder: Path) -> None:
        self._plan, self._folder = plan, folder
        self._begun = time.time()
        self._settings = MachineSettings.load(folder / MACHINE)
        self._origins: dict[str, float] = {}
        self._cuts: dict[str, int] = {}

    def view(self, told: Estimated | None, outage: float, restarts: int) -> View:
        """What there is now."""
        machine, edge = self.machine(), self._edge()
        boot = edge.get("boot", "")
        if boot:
            self._cuts[boot] = max(self._cuts.get(boot, 0), edge.get("windows_cut") or 0)
            self._place(boot, machine, edge)
        judged = None if told is None else self._judge(told, machine)
        return View(self._plan, machine, edge, judged, sum(self._cuts.values()), outage, restarts)

    def machine(self) -> MachineState | None:
        """What it says of itself in this run; None: nothing yet."""
        try:
            state = read_state(self._folder / "state.json")
        except InvalidInput:
            return None
        return state if state is not None and state.written >= self._begun else None

    def _edge(self) -> dict[str, Any]:
        status = read_status(self._folder / "status.json") or {}
        return status if status.get("written", 0.0) >= self._begun else {}

    def _place(self, boot: str, machine: MachineState | None, edge: dict[str, Any]) -> None:
        """Remember when, by the machine's time, a boot began: the edge counts its samples, the drive numbers them."""
        drive = edge.get("drive_sample")
        if boot not in self._origins and machine is not None and drive is not None:
            self._origins[boot] = machine.begun_s + (drive - edge["samples"]) / self._settings.rate

    def _judge(self, told: Estimated, machine: MachineState | None) -> Judged:
        origin = self._origins.get(told.boot)
        if origin is None or machine is None:
            return Judged(told, None, None)
        when = origin + told.time
        return Judged(told, degrees(self._settings.gap_when(when)), machine.time_s - when)
