"""Plants of a simulated machine, one for each role, without sockets and clocks."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from itertools import islice
from math import isfinite
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.cosim import machine
from servotwin.drives.simulated import wire
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.messages import AnyGains, Setting
from servotwin.simulation.endless import OpenLoopPlant

_HISTORY = 1024
"""Samples that the plant in the role control remembers; no reader needs older ones."""

CHANNELS = ("reference", "theta_m", "position", "voltage")


def law_of_machine(settings: MachineSettings) -> AnyController:
    """The law that the machine itself runs: in the role control one without gains, as the voltage is the client's."""
    own = settings.scenario.law
    return own if settings.role == "supervise" else Controller(0.0, 0.0, 0.0, 1.0, sample_rate=own.sample_rate)


class ControlledPlant:
    """A plant whose voltage a client sets, sample by sample.

    Parameters
    ----------
    settings : MachineSettings
    """

    def __init__(self, settings: MachineSettings) -> None:
        self._plant = OpenLoopPlant(machine.endless(settings.present, _HISTORY, law_of_machine(settings)))
        self._end, self._watchdog = settings.end, settings.watchdog * settings.rate  # both in samples
        self._voltage, self._without_voltage = 0.0, 0
        self.sample: Callable[[], tuple[float, float, float]] = self._plant.sample

    @property
    def index(self) -> int:
        """Number of the present sample."""
        return self._plant.index

    @property
    def over(self) -> bool:
        """True once the run has ended."""
        return self._end is not None and self._plant.index >= self._end

    def tick(self, voltage: float) -> None:
        """Advance to the next sample under a voltage (V); where it is not finite the last one holds."""
        if isfinite(voltage):
            self._voltage = voltage
        self._without_voltage = 0
        self._plant.hold(self._voltage)

    def run_alone(self) -> None:
        """Advance to the next sample without the edge: the last voltage holds until the watchdog sets 0 V."""
        self._without_voltage += 1
        if self._without_voltage > self._watchdog:
            self._voltage = 0.0
        self._plant.hold(self._voltage)


class SampleBlock(NamedTuple):
    """Samples from number `first` on, shape (4, n), all under one version of the parameters."""

    first: int
    version: int
    values: Array

    @property
    def last(self) -> int:
        """Number of the sample after the block."""
        return self.first + self.values.shape[1]

    def part(self, first: int, most: int) -> SampleBlock:
        """Return at most `most` samples from number `first` on, which is in the block."""
        begin = first - self.first
        return SampleBlock(first, self.version, self.values[:, begin : begin + most])


class SupervisedPlant:
    """A plant with its own controller; its samples stay readable until they are older than `retention`.

    Parameters
    ----------
    settings : MachineSettings
    """

    def __init__(self, settings: MachineSettings) -> None:
        self._machine = machine.endless(settings.present, wire.MAX_SAMPLES)
        self._law, self._end = settings.scenario.law, settings.end
        self._retained = round(settings.retention * settings.rate)
        self._blocks: deque[SampleBlock] = deque()
        self.block, self.version = settings.block_samples, 0

    @property
    def index(self) -> int:
        """Number of the present sample."""
        return self._machine.index

    @property
    def over(self) -> bool:
        """True once the run has ended."""
        return self._end is not None and self.index >= self._end

    def advance(self, samples: int) -> None:
        """Advance by `samples`, at most `wire.MAX_SAMPLES`, or to the end of the run."""
        first = self.index
        stop = first + samples if self._end is None else min(first + samples, self._end)
        self._machine.advance(stop)
        values = np.array([self._machine.measured(name, first, stop) for name in CHANNELS])
        self._blocks.append(SampleBlock(first, self.version, values))
        while self._blocks and self._blocks[0].last <= self.index - self._retained:
            self._blocks.popleft()

    def read(self, first: int, most: int) -> SampleBlock | None:
        """At most `most` samples from number `first` on, or from the oldest one retained; None where none is there yet.

        A reader that is behind catches up: it receives the samples of many blocks at once.
        """
        place = bisect_right(self._blocks, first, key=attrgetter("last"))
        if place == len(self._blocks):
            return None
        block = self._blocks[place]
        values = [block.part(max(first, block.first), most).values]
        count = values[0].shape[1]
        for later in islice(self._blocks, place + 1, None):
            if count >= most or later.version != block.version:
                break
            values.append(later.part(later.first, most - count).values)
            count += values[-1].shape[1]
        return SampleBlock(max(first, block.first), block.version, np.hstack(values))

    def write(self, version: int, tolerance: float, gains: AnyGains | None) -> None:
        """Put parameters in force from the present sample on.

        Raises
        ------
        InvalidInput
            The controller does not allow them.
        """
        machine.put_in_force(self._machine, self._law, Setting.of(tolerance, gains))
        self.version = version

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference from the present sample on."""
        if not isfinite(offset):
            raise InvalidInput(f"offset = {offset!r} m: must be finite")
        self._machine.move(offset)
