"""Parameters that the edge runs on."""

from dataclasses import dataclass
from math import inf
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.messages import Setting

OFF = Setting(0.0)
"""No dead zone, and the gains that the edge was configured with."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Setting of the edge's controller, and the data from which it was computed.

    Parameters
    ----------
    version : int
        0: as configured, no update yet.
    setting : Setting
        Gains None: those that the edge was configured with.
    data_time : float
        Sample time of the data from which they were computed, s; -inf: none of this boot.
    window : (str, int), optional
        (boot, sequence) of the window from which they were computed.
    sample : int
        First sample under them.
    fallback : bool
        True for the fallback set.
    not_before : int
        First sample at which an update may replace them.
    gap : float, optional
        Total gap for which the update was made, rad; None: not known.

    Raises
    ------
    InvalidInput
        The tolerance or the version is out of its range.
    """

    version: int = 0
    setting: Setting = OFF
    data_time: float = -inf
    window: tuple[str, int] | None = None
    sample: int = 0
    fallback: bool = False
    not_before: int = 0
    gap: float | None = None

    def __post_init__(self) -> None:
        if not self.setting.has_valid_tolerance():
            raise InvalidInput(f"tolerance in force = {self.setting.tolerance!r} m: must be finite and at least 0")
        if self.version < 0:
            raise InvalidInput(f"version in force = {self.version!r}: must be at least 0")

    @property
    def chosen_by_edge(self) -> bool:
        """True where the edge itself put them in force in this boot: its fallback set, or those of before an update."""
        return self.window is None and self.data_time > -inf


@settings("fallback")
@dataclass(frozen=True, slots=True)
class FallbackSet:
    """Setting that serves every gap in the servo's stated range, and when the edge falls back to it.

    Parameters
    ----------
    setting : Setting
        Gains None: the gains stay. The band is certified for the servo: no update may do worse in error and settling,
        whatever it predicts.
    """

    setting: Setting
    silence_s: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Time for which the twin may leave a window unanswered before the edge falls back; inf: for ever.",
        ),
    ] = inf
    refuse_s: Annotated[
        float,
        key(
            minimum=0.0,
            help="Time for which updates are refused after the first fallback, twice as long after each further one.",
        ),
    ] = 10.0

    def __post_init__(self) -> None:
        check(self)
        if not self.setting.has_valid_tolerance():
            raise InvalidInput(f"fallback tolerance = {self.setting.tolerance!r} m: must be finite and at least 0")
