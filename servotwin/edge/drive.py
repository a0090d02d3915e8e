"""Drive: the interface between the edge and its machine, in one of two roles.

*Control*: the edge ticks the law. The drive paces: `read` waits for the next sample instant, `write` gives the voltage
that is held until the one after it. *Supervise*: the drive has a controller of its own. `read` gives the samples since
the last one, `write` the parameters it is to run on.

Samples are numbered by the machine, from 0 when it starts. Whoever reads them compares: a number other than the one
that is due means that samples are missing (the edge was too slow, or away for too long), another `machine` after
`connect` that the count began anew. Windows are uniform in time: a few missing samples cost the windows they were in;
where more than a second is missing, or the count began anew, the agent begins a new boot.

A drive that cannot be reached raises `DriveLost`, and `connect` is to be tried again, at intervals of the caller's
choice; a run that is over gives None. Nothing else ends a reading loop. All numbers are SI.
"""

from array import array
from typing import NamedTuple, Protocol

from servotwin.edge.parameters import Parameters


class DriveLost(Exception):
    """The drive cannot be reached, or went silent; `connect` may bring it back."""


class DriveRefused(Exception):
    """The drive does not take these parameters; it runs on with those it had."""


class DriveSample(NamedTuple):
    """One sample instant, before its tick.

    Attributes
    ----------
    number : int
        Its number since the machine's start.
    reference, theta_m, position : float
        m (wanted by the machine, without any probing move), rad, m.
    """

    number: int
    reference: float
    theta_m: float
    position: float


class Block(NamedTuple):
    """Successive samples of a drive that controls by itself, all under the same parameters.

    Attributes
    ----------
    first : int
        Number of its first sample since the machine's start.
    version : int
        Of the parameters that these samples ran under: the first block with a version says at which sample it began.
    reference, theta_m, position, voltage : array of float
        m (a probing move included), rad, m, V; equally long, perhaps empty.
    """

    first: int
    version: int
    reference: "array[float]"
    theta_m: "array[float]"
    position: "array[float]"
    voltage: "array[float]"

    @property
    def last(self) -> int:
        """Number of the sample after it."""
        return self.first + len(self.reference)


class Drive(Protocol):
    """Interface that both roles have in common."""

    @property
    def rate(self) -> float:
        """Samples per second of machine time, Hz; known once connected."""

    @property
    def machine(self) -> str:
        """Name of the machine's present run: another one means that samples are counted from 0 again."""

    @property
    def lag(self) -> float:
        """s by which the machine is behind its pace, as last reported; 0 for a real one."""

    def connect(self) -> None:
        """Reach the machine, at first or again; raises `DriveLost` when it is not there, `InvalidInput` when it never
        will be: another role, another protocol, no access."""

    def close(self) -> None:
        """Let go of it; the machine runs on. Closing twice is harmless."""


class ControlDrive(Drive, Protocol):
    """A machine whose voltage the edge sets, tick by tick."""

    def read(self) -> DriveSample | None:
        """Wait for the next sample instant; None: the run is over. Raises `DriveLost`."""

    def write(self, voltage: float) -> None:
        """The voltage (V) from the last sample on; where none is written the last one holds. Raises `DriveLost`."""


class SupervisedDrive(Drive, Protocol):
    """A machine with its own controller."""

    @property
    def can_move(self) -> bool:
        """It adds probing moves to its reference; where not, the agent's settings must allow none."""

    @property
    def patient(self) -> bool:
        """Samples wait until they are read, however long that takes."""

    def read(self, most: int = 0) -> Block | None:
        """The next samples, at least one of them unless nothing came for a while; None: the run is over.

        Parameters
        ----------
        most : int
            Samples at most; 0: as many as suits the drive. A machine in lock-step goes on by no more than these, so
            that what is written next holds from `Block.last` on.

        Raises
        ------
        DriveLost
        """

    def write(self, parameters: Parameters) -> None:
        """Run on these: version, tolerance and gains, all at once; the blocks to come say from which sample on. Gains
        come without a jump of the voltage; None leaves them as they are, and sets the dead zone as it is.

        Raises
        ------
        DriveLost
            Whether they were taken is not known: the next block's version tells.
        DriveRefused
            They are not in force, and why.
        """

    def move(self, offset: float) -> None:
        """Add this (m) to the reference from the next sample on, until told otherwise. Raises `DriveLost`."""
