"""A sampled simulation without an end: inputs are laid out stretch by stretch, and only recent samples are stored.

Its samples equal those of a bounded `Simulation` bit for bit.
"""

from __future__ import annotations

from math import inf

import numpy as np

from servotwin.control.law import LawParameters, start
from servotwin.control.laws import AnyController
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.signals import PiecewiseCubic, SignalLike, SquareWave, as_pieces
from servotwin.simulation.inputs import raised, recent, spliced
from servotwin.simulation.sampled import SampledEngine
from servotwin.simulation.simulate import Simulation

FOREVER = 1e9
"""Horizon of a simulation without an end, s: some thirty years."""

STRETCH, MARGIN = 3600.0, 1.0  # s: length of reference laid out at a time, and its overlap with the next


def first_stretch(reference: SignalLike) -> PiecewiseCubic:
    """First stretch of the reference of an unbounded simulation."""
    return _between(reference, 0.0, STRETCH + MARGIN)


class UnboundedSimulation:
    """A simulation without an end.

    Parameters
    ----------
    simulation : Simulation
        Sampled, with `keep`, over `FOREVER`; its reference begins as `first_stretch` of `reference`.
    reference : number or signal
        m, the machine's reference without the offset of `move`.
    """

    def __init__(self, simulation: Simulation, reference: SignalLike) -> None:
        assert isinstance(simulation.engine, SampledEngine)
        self.simulation, self.engine = simulation, simulation.engine
        self.rate = simulation.inputs.sample_rate
        self._reference_signal, self._offset = reference, 0.0
        self._until = int(STRETCH * self.rate) if isinstance(reference, SquareWave) else None

    @property
    def index(self) -> int:
        """The present sample."""
        return self.engine.index

    def advance(self, index: int) -> None:
        """Advance to a sample."""
        while self._until is not None and self._until < index:
            self.simulation.advance(self._until)
            self.lay_out()
        self.simulation.advance(index)

    @property
    def laid_out(self) -> int | None:
        """The sample up to which the reference is laid out; None: for ever."""
        return self._until

    def lay_out(self) -> None:
        """Lay out the next stretch of the reference, from the present sample on."""
        time = self.simulation.time
        if self._until is not None:
            self._until = self.index + int(STRETCH * self.rate)
        stretch = _between(self._reference_signal, time, time + STRETCH + MARGIN)
        # Without an offset the stretch stays as it is, bit for bit.
        self._set_reference(stretch if self._offset == 0.0 else raised(stretch, self._offset))

    def move(self, offset: float) -> None:
        """Offset the reference (m) from the present sample on; replaces an earlier offset."""
        self._offset = offset
        self.lay_out()

    def set_tolerance(self, tolerance: float) -> None:
        """Set the dead-zone half-width (m) from the present sample on."""
        self.simulation.set_tolerance(tolerance)
        self._forget()

    def set_controller(self, controller: AnyController, tolerance: float) -> None:
        """Change controller and dead zone (m) from the present sample on, without a jump of the voltage."""
        self.simulation.set_controller(controller, tolerance)
        self._forget()

    def measured(self, name: str, first: int, last: int) -> Array:
        """Output of a sensor or of the law at stored samples, as `Simulation.measured`."""
        return self.simulation.measured(name, first, last)

    @property
    def _oldest(self) -> float:
        """Time of the oldest stored sample, s."""
        return self.engine.oldest / self.rate

    def _forget(self) -> None:
        """Drop the dead zone before the oldest stored sample."""
        inputs = self.simulation.inputs
        assert inputs.tolerance is not None
        inputs.tolerance = recent(inputs.tolerance, self._oldest)

    def _set_reference(self, reference: PiecewiseCubic) -> None:
        inputs = self.simulation.inputs
        inputs.reference = recent(spliced(inputs.reference, reference, self.simulation.time), self._oldest)


def _between(reference: SignalLike, begin: float, end: float) -> PiecewiseCubic:
    return reference.between(begin, end) if isinstance(reference, SquareWave) else as_pieces(reference, end)


CHUNK = 4096
_VOLTAGE_ONLY = LawParameters(0.0, 0.0, 0.0, 0.0, -1.0, -1.0, inf, inf, 1.0, 0.0, 0.0, 1.0, 0.0)


class OpenLoopPlant:
    """The plant of a sampled simulation with the voltage given from outside, sample by sample.

    It runs the sampled loop's own compiled step with a law that has no gains and whose feedforward is the voltage: the
    plant is the same, bit for bit. Inputs are laid out for many samples at a time.

    Parameters
    ----------
    machine : UnboundedSimulation
        Its samples are its ticks, and it has no dead zone: its own controller never runs.

    Raises
    ------
    InvalidInput
        Samples and ticks are at different rates.
    """

    def __init__(self, machine: UnboundedSimulation) -> None:
        engine = machine.engine
        if engine.tick_every != 1 or engine.record_every != 1:
            raise InvalidInput(
                f"controller sample_rate = {engine.tick_rate} Hz: must be the recording's, {machine.rate} Hz, where "
                "the voltage comes from outside"
            )
        self._machine, self._engine = machine, engine
        engine.law_state = start(0.0)
        engine.parameters = _VOLTAGE_ONLY
        self._theta_m = int(np.argmax(engine.plant.rows["theta_m"][0]))
        self._position = engine.port.position
        self._finest = engine.servo.encoder_resolution, engine.servo.position_resolution
        self._lay_out()

    @property
    def index(self) -> int:
        """The present sample."""
        return self._engine.base

    def sample(self) -> tuple[float, float, float]:
        """Reference (m), motor angle (rad) and measured position (m) of the present sample."""
        here, state = self._engine.base - self._first, self._engine.state
        position, late = float(state[self._position]) + self._noise[here], self._engine.port.late
        shown = float(late[self._engine.base % late.size]) if late.size else _rounded(position, self._finest[1])
        return self._reference[here], self._angle(float(state[self._theta_m])), shown

    def _angle(self, angle: float) -> float:
        """Reading of the motor's encoder at the present sample, where the motor has an angle."""
        if self._machine.simulation.readings is None and self._engine.servo.sensors.motor_encoder:
            return _rounded(angle, self._finest[0])
        return float(self._machine.measured("theta_m", self.index, self.index + 1)[0])

    def hold(self, voltage: float) -> None:
        """Advance the plant to the next sample under a voltage (V)."""
        engine = self._engine
        base = engine.base
        engine.parameters = _VOLTAGE_ONLY._replace(feedforward=voltage)
        engine.make_room(base + 1)
        if base in self._changes:
            # The gap's cubic changes within this sample: the engine takes that step, and draws the same noise again.
            engine.draws.put_back(self._tick_inputs.noise[base - self._first :])
            engine.advance(base + 1)
            self._lay_out()
            return
        engine.flow(base + 1, self._tick_inputs)
        if engine.base == self._last:
            self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the inputs of the samples to come."""
        first, until = self._engine.base, self._machine.laid_out
        if until is not None and until <= first:
            self._machine.lay_out()
            until = self._machine.laid_out
        last = first + CHUNK if until is None else min(first + CHUNK, until)
        self._first, self._last = first, last
        self._tick_inputs = self._engine.tick_inputs(first, last)
        self._changes = {base for base, _ in self._engine.knots(last)}
        # A signal that is constant has one value for all of these ticks.
        signals = (self._tick_inputs.reference, self._tick_inputs.noise)
        self._reference, self._noise = (np.broadcast_to(each, last - first).tolist() for each in signals)


def _rounded(value: float, resolution: float) -> float:
    return value if resolution == 0.0 else round(value / resolution) * resolution
