"""Linear law in a file: its matrices, row by row, and what the dead zone and the limits do to it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from servotwin.config.keys import Form, key
from servotwin.config.table import Table
from servotwin.control.law_keys import RateLimit, ReleaseTime, SampleRate, VoltageLimit
from servotwin.control.linear_law import LOAD, MOTOR, LinearLaw
from servotwin.control.matrices import Rows
from servotwin.errors import InvalidInput


def _rows(table: Table, name: str, given: Any, _folder: Path) -> Rows:
    """A matrix, row by row."""
    if not (isinstance(given, list) and all(isinstance(row, list) for row in given)):
        raise table.invalid(name, "a list of rows, each a list of numbers")
    numbers = [value for row in given for value in row]
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in numbers):
        raise table.invalid(name, "a list of rows, each a list of numbers")
    return tuple(tuple(float(value) for value in row) for row in given)


def _names(table: Table, name: str, given: Any, _folder: Path) -> tuple[str, ...]:
    if not (isinstance(given, list) and all(isinstance(each, str) for each in given)):
        raise table.invalid(name, "a list of texts")
    return tuple(given)


StateRows = Annotated[
    Rows, key(form=Form.OTHER, parse=_rows, help="States to their derivatives, n rows of n; discrete: to the next.")
]
InputRows = Annotated[
    Rows, key(form=Form.OTHER, parse=_rows, help="Reference, y_motor (rad) and y_load to the same: n rows of 3.")
]
StateGains = Annotated[tuple[float, ...], key(help="States to the command, n numbers.")]
InputGains = Annotated[tuple[float, ...], key(help="Reference, y_motor (rad) and y_load to the command: 3 numbers.")]
Discrete = Annotated[bool, key(help="The matrices belong to that rate.")]
StateNames = Annotated[
    tuple[str, ...], key(form=Form.OTHER, parse=_names, help="Names of the states; x1, x2 and so on where absent.")
]
Measured = Annotated[str, key(choices=(LOAD, MOTOR), help="Measurement of the error that the dead zone looks at.")]
Travel = Annotated[
    float | None,
    key("travel_m_per_rad", above=0.0, help="Travel of the load per angle of the motor; the transmission's."),
]
Enter = Annotated[float, key("enter_tolerances", minimum=0.0, help="Error at or below which the dead zone is entered.")]
Leave = Annotated[
    float, key("leave_tolerances", minimum=0.0, help="Error above which it is left; at least enter_tolerances.")
]
Holds = Annotated[tuple[str, ...], key(form=Form.OTHER, parse=_names, help="States that the dead zone stops.")]
IntegralOnly = Annotated[bool, key(help="Inside the dead zone nothing else stops; otherwise the loop opens there.")]
Windup = Annotated[
    tuple[float, ...],
    key(help="Back-calculation: added to the states' derivatives per command that the limits cut off; n numbers."),
]
Feedforward = Annotated[float, key("feedforward_v", help="Command added at all times.")]
Gain = Annotated[float, key(above=0.0, unit="1", help="Factor on the whole law.")]
IntegralShare = Annotated[float, key(minimum=0.0, unit="1", help="Factor on what the states in `holds` take in.")]
InsideRows = Annotated[
    Rows,
    key(form=Form.OTHER, parse=_rows, help="B inside the dead zone without integral_only; nothing where absent."),
]
InsideGains = Annotated[tuple[float, ...], key(help="D inside the dead zone without integral_only, likewise.")]


def matrices_law(
    A: StateRows = (),
    B: InputRows = (),
    C: StateGains = (),
    D: InputGains = (),
    sample_rate: SampleRate = None,
    discrete: Discrete = False,
    names: StateNames = (),
    on: Measured = LOAD,
    ratio: Travel = None,
    enter: Enter = 1.0,
    leave: Leave = 1.0,
    holds: Holds = (),
    integral_only: IntegralOnly = True,
    voltage_limit: VoltageLimit = None,
    rate_limit: RateLimit = None,
    windup: Windup = (),
    feedforward: Feedforward = 0.0,
    release_time: ReleaseTime = None,
    gain: Gain = 1.0,
    integral_share: IntegralShare = 1.0,
    B_inside: InsideRows = (),
    D_inside: InsideGains = (),
) -> LinearLaw:
    """Any linear law of reference, y_motor and y_load."""
    if not D:
        raise InvalidInput("law D: is missing; give A, B, C and D")
    return LinearLaw(
        A, B, C, D, sample_rate, discrete, names=names, on=on, ratio=1.0 if ratio is None else ratio, enter=enter,
        leave=leave, holds=holds, integral_only=integral_only, voltage_limit=voltage_limit, rate_limit=rate_limit,
        windup=windup, feedforward=feedforward, release_time=release_time, gain=gain, integral_share=integral_share,
        B_inside=B_inside, D_inside=D_inside,
    )  # fmt: skip
