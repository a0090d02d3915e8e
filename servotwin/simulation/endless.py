"""A sampled simulation without an end: inputs are laid out stretch by stretch, and only recent samples remembered.

Sample by sample it is the `Simulation` with an end, bit for bit.
"""

from __future__ import annotations

import numpy as np

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.signals import PiecewiseCubic, SignalLike, SquareWave, as_pieces
from servotwin.simulation.sampled import SampledEngine
from servotwin.simulation.simulate import Simulation
from servotwin.simulation.splice import recent, spliced

FOREVER = 1e9
"""s, some thirty years: the horizon of a simulation that is to be endless."""

STRETCH, MARGIN = 3600.0, 1.0  # s of the reference that are laid out at a time, and beyond what is then asked for


def first_stretch(reference: SignalLike) -> PiecewiseCubic:
    """What an endless simulation's reference begins with."""
    return _between(reference, 0.0, STRETCH + MARGIN)


class Endless:
    """A machine that runs on.

    Parameters
    ----------
    simulation : Simulation
        Sampled, with `keep`, over `FOREVER`; its reference begins as `first_stretch` of `reference`.
    reference : number or signal
        m, what the machine wants by itself.
    """

    def __init__(self, simulation: Simulation, reference: SignalLike) -> None:
        assert isinstance(simulation.engine, SampledEngine)
        self.simulation, self.engine = simulation, simulation.engine
        self.rate = simulation.inputs.sample_rate
        self._wanted, self._offset = reference, 0.0
        self._until = int(STRETCH * self.rate) if isinstance(reference, SquareWave) else None

    @property
    def index(self) -> int:
        """The present sample."""
        return self.engine.index

    def advance(self, index: int) -> None:
        """Go on to a sample."""
        while self._until is not None and self._until < index:
            self.simulation.advance(self._until)
            self.lay_out()
        self.simulation.advance(index)

    @property
    def laid_out(self) -> int | None:
        """The sample up to which the reference is laid out; None: for ever."""
        return self._until

    def lay_out(self) -> None:
        """The reference's next stretch, from the present sample on."""
        time = self.simulation.time
        if self._until is not None:
            self._until = self.index + int(STRETCH * self.rate)
        wanted = _between(self._wanted, time, time + STRETCH + MARGIN)
        self._set_reference(wanted if self._offset == 0.0 else _raised(wanted, self._offset))

    def move(self, offset: float) -> None:
        """Add this (m) to the wanted reference from the present sample on."""
        self._offset = offset
        self.lay_out()

    def set_tolerance(self, tolerance: float) -> None:
        """A new dead zone (m) from the present sample on."""
        self.simulation.set_tolerance(tolerance)
        self._forget()

    def set_controller(self, controller: Controller, tolerance: float) -> None:
        """Another controller and dead zone (m) from the present sample on, without a jump of the voltage."""
        self.simulation.set_controller(controller, tolerance)
        self._forget()

    def measured(self, name: str, first: int, last: int) -> Array:
        """As `Simulation.measured` says, of the samples remembered."""
        return self.simulation.measured(name, first, last)

    @property
    def _oldest(self) -> float:
        """Time of the oldest sample remembered, s."""
        return self.engine.oldest / self.rate

    def _forget(self) -> None:
        """What the dead zone was before the oldest sample remembered."""
        inputs = self.simulation.inputs
        assert inputs.tolerance is not None
        inputs.tolerance = recent(inputs.tolerance, self._oldest)

    def _set_reference(self, reference: PiecewiseCubic) -> None:
        inputs = self.simulation.inputs
        inputs.reference = recent(spliced(inputs.reference, reference, self.simulation.time), self._oldest)


def _between(reference: SignalLike, begin: float, end: float) -> PiecewiseCubic:
    return reference.between(begin, end) if isinstance(reference, SquareWave) else as_pieces(reference, end)


def _raised(pieces: PiecewiseCubic, offset: float) -> PiecewiseCubic:
    return PiecewiseCubic(pieces.times, pieces.coeffs + np.array([offset, 0.0, 0.0, 0.0]))
