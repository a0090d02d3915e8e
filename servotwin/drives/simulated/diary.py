"""What a machine keeps on disk while it runs, and reads there: how long it has run, its gap, and its speed.

It is looked after about twice a second between two samples. A disk that fails is no reason to stop a machine.
"""

from __future__ import annotations

import math
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from servotwin.errors import InvalidInput
from servotwin.runtime.files import replace_file

if TYPE_CHECKING:
    from servotwin.drives.simulated.pace import Pace
    from servotwin.drives.simulated.settings import MachineSettings

LOOK_S = 0.5
"""s by the clock from one look to the next."""
MOST_SPEED = 1e4
_LONGEST = 64


class MachineState(msgspec.Struct, frozen=True, tag="servotwin-machine/1", tag_field="schema", kw_only=True):
    """Where a machine is.

    Attributes
    ----------
    time_s : float
        Machine time since it was new, all its runs together.
    gap_deg : float
        Total gap.
    speed : float
        Seconds of machine time per second that it is told to keep.
    begun_s : float
        Machine time at the beginning of this run: its sample 0.
    written : float
        s since the epoch.
    """

    time_s: float
    gap_deg: float
    speed: float
    begun_s: float
    written: float


class Diary:
    """A machine's files, looked after while it runs.

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

    def look(self, sample: int, now: float) -> None:
        """Write the state and read the speed, if it is time."""
        if now < self._due:
            return
        self._due = now + LOOK_S
        self._follow(now)
        self.write(sample)

    def write(self, sample: int) -> None:
        """Write the state, where one is kept."""
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

    def _follow(self, now: float) -> None:
        path = self._settings.speed_file
        asked = None if path is None else read_speed(path)
        if asked is not None and asked != self._speed:
            self._speed = asked
            self._pace.change(asked, now)


def read_state(path: str | os.PathLike[str]) -> MachineState | None:
    """What is kept there; None: nothing.

    Raises
    ------
    InvalidInput
        There is a file, and it is no machine's.
    """
    try:
        state = msgspec.json.decode(Path(path).read_bytes(), type=MachineState)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.MsgspecError) as error:
        raise InvalidInput(f"{path}: is no state of a machine ({error}); without this file it begins anew") from None
    if not (0.0 <= state.time_s < math.inf):
        raise InvalidInput(f"{path}: time_s = {state.time_s!r} s: must be finite and 0 or more")
    return state


def write_state(path: Path, state: MachineState) -> None:
    """Replace what is kept, whole or not at all; raises OSError."""
    replace_file(path, msgspec.json.format(msgspec.json.encode(state)) + b"\n")


def read_speed(path: Path) -> float | None:
    """The speed that is asked for; None: there is none to be understood, so that the present one stays."""
    try:
        speed = float(path.read_bytes()[:_LONGEST])
    except (OSError, ValueError):
        return None
    return speed if 0.0 < speed <= MOST_SPEED else None


def write_speed(path: Path, speed: float) -> None:
    """Ask a machine for a speed; raises OSError."""
    replace_file(path, f"{speed!r}\n".encode())
