"""The machine behind the drive, without its sockets and clocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import isfinite
from typing import NamedTuple

import numpy as np

from servotwin.control.gains import with_gains
from servotwin.cosim import machine
from servotwin.drives.simulated import wire
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.messages import Gains
from servotwin.simulation.endless import OpenLoopPlant

KEPT = 1024
"""Samples that a machine without a controller remembers: nobody asks for them."""

CHANNELS = ("reference", "theta_m", "position", "voltage")


class ControlledPlant:
    """A plant that waits for its voltage, sample by sample.

    Parameters
    ----------
    settings : MachineSettings
    """

    def __init__(self, settings: MachineSettings) -> None:
        self._held = OpenLoopPlant(machine.endless(settings.present, KEPT))
        self._end, self._patience = settings.end, settings.watchdog * settings.rate
        self._voltage, self._unattended = 0.0, 0
        self.sample: Callable[[], tuple[float, float, float]] = self._held.sample

    @property
    def index(self) -> int:
        """The present sample."""
        return self._held.index

    @property
    def over(self) -> bool:
        """The run has ended."""
        return self._end is not None and self._held.index >= self._end

    def tick(self, voltage: float) -> None:
        """To the next sample under a voltage (V); one that is not finite lets the last one hold."""
        if isfinite(voltage):
            self._voltage = voltage
        self._unattended = 0
        self._held.hold(self._voltage)

    def run_alone(self) -> None:
        """To the next sample without the edge: the voltage holds until the watchdog takes it away."""
        self._unattended += 1
        if self._unattended > self._patience:
            self._voltage = 0.0
        self._held.hold(self._voltage)


class SampleBlock(NamedTuple):
    """Samples from `first` on, (4, n), under one version of the parameters."""

    first: int
    version: int
    values: Array

    @property
    def last(self) -> int:
        """The sample after it."""
        return self.first + self.values.shape[1]

    def part(self, first: int, most: int) -> SampleBlock:
        """At most so many samples from one of its own on."""
        begin = first - self.first
        return SampleBlock(first, self.version, self.values[:, begin : begin + most])


class SupervisedPlant:
    """A plant with its own controller, which keeps its samples until they are read or too old.

    Parameters
    ----------
    settings : MachineSettings
    """

    def __init__(self, settings: MachineSettings) -> None:
        self._machine = machine.endless(settings.present, wire.MOST)
        self._law, self._end = settings.scenario.law, settings.end
        self._kept = round(settings.kept * settings.rate)
        self._blocks: deque[SampleBlock] = deque()
        self.block, self.version = settings.block_samples, 0

    @property
    def index(self) -> int:
        """The present sample."""
        return self._machine.index

    @property
    def over(self) -> bool:
        """The run has ended."""
        return self._end is not None and self.index >= self._end

    def advance(self, samples: int) -> None:
        """So many samples on, at most `wire.MOST`, as far as there are any."""
        first = self.index
        stop = first + samples if self._end is None else min(first + samples, self._end)
        self._machine.advance(stop)
        values = np.array([self._machine.measured(name, first, stop) for name in CHANNELS])
        self._blocks.append(SampleBlock(first, self.version, values))
        while self._blocks and self._blocks[0].last <= self.index - self._kept:
            self._blocks.popleft()

    def read(self, first: int, most: int) -> SampleBlock | None:
        """Samples from one on, or from the oldest kept; None: there are none yet."""
        found = None
        for stretch in reversed(self._blocks):
            if stretch.last <= first:
                break
            found = stretch
        return None if found is None else found.part(max(first, found.first), most)

    def write(self, version: int, tolerance: float, gains: Gains | None) -> None:
        """Run on these from the present sample on.

        Raises
        ------
        InvalidInput
            They are no parameters of a controller.
        """
        if gains is None:
            self._machine.set_tolerance(tolerance)
        else:
            self._machine.set_controller(with_gains(self._law, gains), tolerance)
        self.version = version

    def move(self, offset: float) -> None:
        """Add this (m) to the reference from the present sample on."""
        if not isfinite(offset):
            raise InvalidInput(f"offset = {offset!r} m: must be finite")
        self._machine.move(offset)
