"""Drive: the interface between the edge and its machine, in one of two roles.

*Control*: the edge ticks the law, and the drive sets the pace: `read` waits for the next sample instant, `write` sets
the voltage that is held until the one after it. *Supervise*: the drive has a controller of its own: `read` returns the
samples since the last call, `write` sets the parameters of that controller.

The machine numbers its samples from 0 when it starts. The reader compares the numbers: a number other than the one that
is due means that samples are missing (the edge was too slow, or away for too long); another `machine` after `connect`
means that the count began anew. Windows are uniform in time, so a few missing samples cost the windows they were in;
where more than a second is missing, or the count began anew, the agent begins a new boot.

A drive that cannot be reached raises `DriveLost`; the caller tries `connect` again, at intervals of its choice. `read`
returns None when the run is over. Nothing else ends a reading loop. All numbers are SI.
"""

from array import array
from typing import NamedTuple, Protocol

from servotwin.edge.agent import Agent
from servotwin.edge.parameters import Parameters


class DriveLost(Exception):
    """The drive cannot be reached, or went silent; `connect` may reach it again."""


class DriveRefused(Exception):
    """The drive refuses the parameters; it runs on with those it had."""


class DriveSample(NamedTuple):
    """One sample instant, before its tick.

    Attributes
    ----------
    number : int
        Number of the sample since the machine's start.
    reference, theta_m, position : float
        m (the machine's own reference, without a probing move), rad, m.
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
        Version of the parameters in these samples; it begins with the first block that carries it.
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
    """Interface common to both roles."""

    @property
    def rate(self) -> float:
        """Samples per second of machine time, Hz; known once connected."""

    @property
    def machine(self) -> str:
        """Name of the machine's present run; with another name the samples are counted from 0 again."""

    @property
    def lag(self) -> float:
        """Time by which a simulated machine is behind its pace, as last reported, s; 0 for a real one."""

    def connect(self) -> None:
        """Connect to the machine, at first or again.

        Raises
        ------
        DriveLost
            The machine cannot be reached now.
        InvalidInput
            Another try is useless: the machine has another role or protocol, or refuses access.
        """

    def close(self) -> None:
        """Close the connection; the machine runs on. Closing twice is harmless."""


class ControlDrive(Drive, Protocol):
    """A machine whose voltage the edge sets, tick by tick."""

    def read(self) -> DriveSample | None:
        """Wait for the next sample instant; None: the run is over. Raises `DriveLost`."""

    def write(self, voltage: float) -> None:
        """Set the voltage (V) from the last sample on; without a call the last one holds. Raises `DriveLost`."""


class SupervisedDrive(Drive, Protocol):
    """A machine with its own controller."""

    @property
    def can_move(self) -> bool:
        """True where it adds probing moves to its reference; otherwise the agent's settings must allow none."""

    @property
    def patient(self) -> bool:
        """True where samples wait until they are read, however long that takes."""

    def read(self, most: int = 0) -> Block | None:
        """Return the next samples; the block is empty where nothing came for a while; None: the run is over.

        Parameters
        ----------
        most : int
            Largest number of samples; 0: as many as suits the drive. A machine in lock-step advances by no more than
            these, so that the parameters written next hold from `Block.last` on.

        Raises
        ------
        DriveLost
        """

    def write(self, parameters: Parameters) -> None:
        """Put version, tolerance and gains in force, all at once; the next blocks tell the sample at which they began.

        New gains do not make the voltage jump. Where `parameters.setting.gains` is None the gains stay as they are.

        Raises
        ------
        DriveLost
            It is not known whether they are in force: the version of the next block tells.
        DriveRefused
            They are not in force; the message has the reason.
        """

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference from the next sample on, until the next call. Raises `DriveLost`."""


class Adjustable(Protocol):
    """The part of a supervised drive, or of a simulated machine, that takes parameters and probing moves."""

    def write(self, parameters: Parameters) -> None:
        """Put parameters in force; see `SupervisedDrive`."""

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference; see `SupervisedDrive`."""


class SettingWriter:
    """Writes an agent's parameters and probing offset to a machine with its own controller, where they have changed.

    Parameters
    ----------
    machine : Adjustable
    written : Parameters, optional
        Parameters that the machine has; None: not known, so that the first are written.

    Attributes
    ----------
    accepted : Parameters or None
        Last parameters that the machine accepted.
    """

    def __init__(self, machine: Adjustable, written: Parameters | None = None) -> None:
        self._machine, self._written, self._offset = machine, written, 0.0
        self.accepted = written

    @property
    def moving(self) -> bool:
        """True during a probing move."""
        return self._offset != 0.0

    def write(self, agent: Agent) -> None:
        """Write what has changed; raises `DriveLost`, and `DriveRefused` for parameters, before the offset."""
        if agent.parameters is not self._written:
            self._machine.write(agent.parameters)
            self._written = self.accepted = agent.parameters
        if agent.offset != self._offset:
            self._machine.move(agent.offset)
            self._offset = agent.offset

    def skip(self, parameters: Parameters) -> None:
        """Do not write these parameters: the machine has refused them, or has them already."""
        self._written = parameters

    def forget(self) -> None:
        """Write everything again: the machine was lost."""
        self._written, self._offset = None, 0.0
