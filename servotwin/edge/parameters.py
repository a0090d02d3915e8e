"""What the edge runs on."""

from dataclasses import dataclass
from math import inf

from servotwin.errors import InvalidInput
from servotwin.messages import Band, Gains


@dataclass(frozen=True, slots=True)
class Parameters:
    """What the controller runs on.

    Parameters
    ----------
    version : int
        0: as configured, no update yet.
    tolerance : float
        Dead-zone half-width, m; 0: no dead zone.
    data_time : float
        Sample time of the data they stand on, s; -inf: none of this boot.
    window : (str, int), optional
        (boot, sequence) of the window they stand on.
    sample : int
        First sample under them.
    gains : Gains, optional
        None: those the edge was configured with.
    band : Band, optional
        What the loop is predicted to stay within.
    fallback : bool
        Whether they are the fallback set.
    not_before : int
        First sample at which an update may replace them.
    gap : float, optional
        rad, that the update was made for; None: not known.
    """

    version: int = 0
    tolerance: float = 0.0
    data_time: float = -inf
    window: tuple[str, int] | None = None
    sample: int = 0
    gains: Gains | None = None
    band: Band | None = None
    fallback: bool = False
    not_before: int = 0
    gap: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance < inf:
            raise InvalidInput(f"tolerance in force = {self.tolerance!r} m: must be finite and at least 0")
        if self.version < 0:
            raise InvalidInput(f"version in force = {self.version!r}: must be at least 0")
