"""Recording of a simulated machine's state on disk while it runs, between two samples."""

from __future__ import annotations

import math
import time
from contextlib import suppress

from servotwin.drives.simulated.machine_state import MachineState, read_speed, write_state
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.settings import MachineSettings

PERIOD_S = 0.5
"""Time from one update to the next, by the clock."""


class StateRecorder:
    """Writes a machine's state and reads its speed while it runs; a disk that fails does not stop the machine.

    Parameters
    ----------
    settings : MachineSettings
        Paced by the clock.
    pace : Pace
    now : float
        By the clock, s.
    """

    def __init__(self, settings: MachineSettings, pace: Pace, now: float) -> None:
        self._settings, self._pace = settings, pace
        self._speed = settings.speed
        self._due = now

    def update(self, sample: int, now: float) -> None:
        """Write the state and read the speed, when that is due."""
        if now < self._due:
            return
        self._due = now + PERIOD_S
        self._change_speed(now)
        self.write(sample)

    def write(self, sample: int) -> None:
        """Write the state, where there is a file for it."""
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
        speed = None if path is None else read_speed(path)
        if speed is not None and speed != self._speed:
            self._speed = speed
            self._pace.change(speed, now)
