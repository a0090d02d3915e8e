"""Recorder of a simulated machine's state: between two samples it writes the state file and reads the speed file."""

from __future__ import annotations

import math
import sys
import time
from contextlib import suppress

from servotwin.drives.simulated.machine_state import MachineState, read_speed, write_state
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.errors import InvalidInput

PERIOD_S = 0.5
"""Interval between updates, s by the clock."""


class StateRecorder:
    """Writes a machine's state and reads its speed while it runs; a failing disk does not stop the machine.

    Parameters
    ----------
    settings : MachineSettings
        Of a machine with speed > 0.
    pace : Pace
    now : float
        Present time by the clock, s.
    """

    def __init__(self, settings: MachineSettings, pace: Pace, now: float) -> None:
        self._settings, self._pace = settings, pace
        self._speed = settings.speed
        self._due = now
        self._fault = self._said = ""

    def update(self, sample: int, now: float) -> None:
        """Write the state and read the speed if `PERIOD_S` has passed since the last time."""
        if now < self._due:
            return
        self._due = now + PERIOD_S
        self._change_speed(now)
        self.write(sample)

    def write(self, sample: int) -> None:
        """Write the state if a state file is configured."""
        settings = self._settings
        if settings.state_file is None:
            return
        state = MachineState(
            time_s=settings.begin + sample / settings.rate,
            gap_deg=math.degrees(settings.gap_at(sample)),
            speed=self._speed,
            begun_s=settings.begin,
            written=time.time(),
        )
        with suppress(OSError):
            write_state(settings.state_file, state)

    def _change_speed(self, now: float) -> None:
        path = self._settings.speed_file
        try:
            speed = None if path is None else read_speed(path)
        except InvalidInput as error:
            self._say(str(error))
            return
        self._fault = self._said = ""
        if speed is not None and speed != self._speed:
            self._speed = speed
            self._pace.change(speed, now)

    def _say(self, fault: str) -> None:
        """Say a fault once, found for the second time: a file that is being written is empty for a moment."""
        if fault == self._fault != self._said:
            self._said = fault
            print(f"{fault}; the speed stays {self._speed:g}", file=sys.stderr, flush=True)
        self._fault = fault
