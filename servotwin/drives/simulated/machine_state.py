"""Files of a simulated machine: its state (time and gap) and the speed that it is set to."""

from __future__ import annotations

import math
import os
from pathlib import Path

import msgspec

from servotwin.config.named_file import check_named
from servotwin.errors import InvalidInput
from servotwin.runtime.files import replace_file

MAX_SPEED = 1e4
_MAX_BYTES = 64
"""Of a speed file: a longer one holds no number, and is not read whole."""


class MachineState(msgspec.Struct, frozen=True, tag="servotwin-machine/1", tag_field="schema", kw_only=True):
    """State of a machine.

    Attributes
    ----------
    time_s : float
        Machine time since it was new, all its runs together.
    gap_deg : float
        Total gap.
    speed : float
        Seconds of machine time per second that it is set to.
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


def read_state(path: str | os.PathLike[str]) -> MachineState | None:
    """Read the state file; None where it does not exist.

    Raises
    ------
    InvalidInput
        The file cannot be read, or holds no state of a machine.
    """
    check_named(path)
    try:
        state = msgspec.json.decode(Path(path).read_bytes(), type=MachineState)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.MsgspecError) as error:
        raise InvalidInput(f"{path}: holds no machine state ({error}); delete it to begin anew") from None
    if not (0.0 <= state.time_s < math.inf):
        raise InvalidInput(f"{path}: time_s = {state.time_s!r} s: must be finite and 0 or more")
    return state


def write_state(path: Path, state: MachineState) -> None:
    """Replace the state file atomically; raises OSError."""
    replace_file(path, msgspec.json.format(msgspec.json.encode(state)) + b"\n")


def read_speed(path: Path) -> float | None:
    """Read the speed file; None: there is none.

    Raises
    ------
    InvalidInput
        It cannot be read, or holds no allowed speed.
    """
    check_named(path)
    try:
        text = path.read_bytes()[:_MAX_BYTES]
        speed = float(text)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError:
        speed = math.nan
    if not 0.0 < speed <= MAX_SPEED:
        shown = text.decode(errors="replace").strip()
        raise InvalidInput(f"{path}: holds {shown!r}; give one number above 0 and at most {MAX_SPEED:g}, in s per s")
    return speed


def write_speed(path: Path, speed: float) -> None:
    """Set the speed of a machine through its speed file; raises OSError."""
    replace_file(path, f"{speed!r}\n".encode())
