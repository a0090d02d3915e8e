"""Exact simulation of a servo: continuous (plant and law in one automaton) or sampled (the edge's tick, compiled, on
the exact plant)."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, Law, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.noise import Noise, NoiseSource
from servotwin.plant.plants import Plant
from servotwin.plant.sensors import check_encoders
from servotwin.plant.signals import PiecewiseCubic, SignalLike, as_gap, as_nonnegative, as_pieces
from servotwin.simulation.continuous import ContinuousEngine
from servotwin.simulation.growth import advance_bounded
from servotwin.simulation.inputs import RunInputs, raised, spliced, whole_ratio
from servotwin.simulation.lifted_engine import LiftedEngine, advances_in_blocks
from servotwin.simulation.plant_block_engine import fits_plant_blocks, in_plant_blocks
from servotwin.simulation.readings import PositionErrors, Readings, motor_readings
from servotwin.simulation.run import Run
from servotwin.simulation.sampled import SampledEngine
from servotwin.simulation.sampled_law import SampledLawEngine

# Hz, of what is recorded where nothing is said and the controller's rate is a multiple or a divisor of it.
_RECORDED = 5000.0


class _Advancing(Protocol):
    @property
    def state(self) -> Array: ...
    def advance(self, index: int) -> None: ...


class Engine(_Advancing, Protocol):
    """One way to run the loop; times are sample indices."""

    @property
    def index(self) -> int: ...
    def set_tolerance(self, tolerance: float) -> None: ...
    def set_reference(self, reference: PiecewiseCubic) -> None: ...
    def set_controller(self, controller: Any, tolerance: float | None) -> None: ...
    def channel(self, name: str, first: int, last: int) -> Array: ...
    def events(self) -> list[tuple[float, str, int, bool]]: ...


class Simulation:
    """A run that can be stopped at any sample, inspected, changed and continued.

    Parameters
    ----------
    servo : Servo or Axis
    duration : float
        s; the horizon up to which inputs are laid out.
    controller : Controller, Cascade or LinearLaw, optional
        The servo's own by default. Its ``sample_rate`` decides between the continuous and the sampled loop.
    reference : number or signal
        m.
    gap : number or signal
        rad, total gap.
    tolerance : number, signal or None
        m, half-width of the dead zone; None: no dead zone, and none can be set later. 0 is a dead zone of zero width.
    theta_d0 : float
        rad, start of the screw; clamped into the gap around the motor, which starts at 0. The structure starts at rest.
    sample_rate : float, optional
        Hz, of what is recorded. By default 5000 Hz, or the controller's own rate where the two do not divide one
        another.
    noise : Noise, optional
        On the measured position, in place of that of its encoder; a continuous controller sees it constant between
        samples. Samples between the ticks of a sampled controller have draws of their own.
    seed : int
        Seed of the noise.
    input_bias : float
        V, added to the voltage behind the controller and its limits.
    friction : float
        N m, Coulomb's on the motor's shaft, which sticks and slips; needs a rigid screw.
    delay : int
        Samples of a sampled controller from a measurement to the voltage that it gives.
    keep : int, optional
        Number of samples to store, at least one; needs a sampled controller. None: all samples, and the events.

    Raises
    ------
    InvalidInput
        For a negative gap, tolerance or friction, or rates that do not divide one another.
    """

    def __init__(
        self,
        servo: Plant,
        duration: float,
        controller: AnyController | None = None,
        reference: SignalLike = 0.0,
        gap: SignalLike = 0.0,
        tolerance: SignalLike | None = None,
        theta_d0: float = 0.0,
        sample_rate: float | None = None,
        noise: Noise | None = None,
        seed: int | np.random.Generator = 0,
        input_bias: float = 0.0,
        friction: float = 0.0,
        keep: int | None = None,
        delay: int = 0,
    ) -> None:
        self.servo = servo
        self.controller: Law = law_of(servo.controller if controller is None else controller)
        sample_rate = _recorded(self.controller.sample_rate) if sample_rate is None else sample_rate
        _check_times(duration, sample_rate)
        _check_disturbances(input_bias, friction)
        check_encoders(servo, self.controller)
        self.samples = round(duration * sample_rate) + 1
        self.inputs = RunInputs(
            as_pieces(reference, duration),
            as_gap(gap, duration, servo.largest_gap),
            None if tolerance is None else as_nonnegative(tolerance, duration, "tolerance", "m"),
            sample_rate,
            float(input_bias),
            float(friction),
        )
        self._reference = self.inputs.reference
        rng = np.random.default_rng(seed)
        self.keep = keep
        self._check_keep()
        if delay < 0 or (delay > 0 and self.controller.sample_rate is None):
            raise InvalidInput(f"delay = {delay!r} samples: must be 0 or more, and 0 for a continuous controller")
        self.readings = self._readings(noise, rng)
        self.engine: Engine = self._made(theta_d0, noise, rng, delay)

    def _readings(self, noise: Noise | None, rng: np.random.Generator) -> Readings | None:
        """Errors of the encoders at the steps of the simulation, which are the shorter of samples and ticks."""
        rate = max(self.inputs.sample_rate, self.controller.sample_rate or 0.0)
        return Readings.of(self.servo, rate, round(rate / self.inputs.sample_rate), noise, rng)

    def _made(self, theta_d0: float, noise: Noise | None, rng: np.random.Generator, delay: int) -> Engine:
        servo, law, inputs, samples, readings = self.servo, self.controller, self.inputs, self.samples, self.readings
        # The oldest sample that can be asked for shows an older one.
        keep = None if self.keep is None else self.keep + (0 if readings is None else readings.late)
        if noise is not None and isinstance(law, LinearLaw) and not law.reads("y_load"):
            raise InvalidInput("noise is on the load's encoder, which the controller does not read: noise must be None")
        if law.sample_rate is None:
            source: NoiseSource | PositionErrors | None = None
            if readings is not None:
                source = readings.source(inputs.sample_rate, 1, rng)
            elif noise is not None:
                source = noise.source(inputs.sample_rate, rng)
            return ContinuousEngine(servo, law, inputs, theta_d0, noise=source)
        if isinstance(law, LinearLaw):
            return SampledLawEngine(servo, law, inputs, theta_d0, samples, noise, rng, keep, delay, readings)
        return SampledEngine(servo, law, inputs, theta_d0, samples, noise, rng, keep, delay, readings)

    @property
    def index(self) -> int:
        """Index of the last sample reached."""
        return self.engine.index

    @property
    def time(self) -> float:
        """Its time, s."""
        return self.engine.index / self.inputs.sample_rate

    def advance(self, index: int) -> None:
        """Advance to a sample index, at most the last one of the horizon."""
        if not self.index <= index < self.samples:
            raise InvalidInput(
                f"sample {index} is outside {self.index} .. {self.samples - 1}, where this simulation can go"
            )
        if index > self.index:
            _advance(self, self.engine, index)

    def set_tolerance(self, tolerance: float) -> None:
        """Set the dead-zone half-width (m) from the present sample on; replaces the planned tolerance."""
        self._check_tolerance(tolerance)
        self.inputs.retune(self.time, tolerance)
        self.engine.set_tolerance(tolerance)

    def set_reference(self, reference: SignalLike) -> None:
        """Set the reference (m, number or signal on the run's own time) from the present sample on.

        It replaces the planned reference; its values before the present sample do not matter.
        """
        self._reference = as_pieces(reference, (self.samples - 1) / self.inputs.sample_rate)
        self._follow(self._reference)

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference from the present sample on; replaces an earlier offset."""
        # Without an offset the reference stays as it is, bit for bit.
        self._follow(self._reference if offset == 0.0 else raised(self._reference, offset))

    def set_controller(self, controller: AnyController, tolerance: float | None = None) -> None:
        """Change the controller from the present sample on, without a jump of the voltage.

        Parameters
        ----------
        controller : Controller, Cascade or LinearLaw
            Of the same kind as the one before, at the same rate. Its difference to the voltage at this instant
            becomes an offset that fades with its `release_time`; a voltage beyond its own limit is cut.
        tolerance : float, optional
            m, a new dead-zone half-width, which replaces the planned one; None keeps the planned one.

        Raises
        ------
        InvalidInput
            The sample rate differs, the tolerance is negative, or the simulation has no dead zone.
        """
        law = law_of(controller)
        if law.sample_rate != self.controller.sample_rate:
            rates = (_described(each.sample_rate) for each in (self.controller, law))
            raise InvalidInput("controller sample_rate: a running simulation cannot go from {} to {}".format(*rates))
        kinds = [type(each).__name__ for each in (self.controller, law)]
        if kinds[0] != kinds[1]:
            raise InvalidInput("controller: a running simulation cannot go from a {} to a {}".format(*kinds))
        check_encoders(self.servo, law)
        if tolerance is not None:
            self._check_tolerance(tolerance)
        if law == self.controller and tolerance is None:
            return
        self.engine.set_controller(law, tolerance)
        self.controller = law
        if tolerance is not None:
            self.inputs.retune(self.time, tolerance)

    def _follow(self, reference: PiecewiseCubic) -> None:
        """Follow a reference from the present sample on."""
        self.inputs.reference = spliced(self.inputs.reference, reference, self.time)
        self.engine.set_reference(self.inputs.reference)

    def _check_keep(self) -> None:
        if self.keep is not None and (self.keep < 1 or self.controller.sample_rate is None):
            raise InvalidInput(f"keep = {self.keep} samples: must be at least 1, and needs a sampled controller")

    def _check_tolerance(self, tolerance: float) -> None:
        if self.inputs.tolerance is None:
            raise InvalidInput("this simulation has no dead zone: start it with tolerance=0.0 to set one later")
        if not (np.isfinite(tolerance) and tolerance >= 0.0):
            raise InvalidInput(f"tolerance = {tolerance} m: must be finite and 0 or more")

    def measured(self, name: str, first: int, last: int) -> Array:
        """Output of a sensor or of the law at samples first .. last - 1.

        Parameters
        ----------
        name : str
            theta_m, position, voltage or reference.
        first, last : int
            Samples before the present one, whose tick is still to come.

        Returns
        -------
        (last - first,) array
        """
        oldest = 0 if self.keep is None else max(0, self.index - self.keep)
        if not oldest <= first <= last <= self.index + 1:
            raise InvalidInput(
                f"samples {first} .. {last} are outside {oldest} .. {self.index + 1}, the samples simulated so far"
                + ("" if self.keep is None else " and still stored")
            )
        if name == "reference":
            return self.inputs.reference.on(self.inputs.times(first, last))
        if name == "theta_m":
            return motor_readings(self.servo, self.readings, self.engine.channel, first, last)
        return self.engine.channel("measured_position" if name == "position" else name, first, last)

    def run(self) -> Run:
        """Everything up to the present sample.

        Raises
        ------
        InvalidInput
            The simulation stores its last samples only (`keep`).
        """
        if self.keep is not None:
            raise InvalidInput(f"keep = {self.keep} samples: a simulation that stores only its last samples has no run")
        return Run(
            self.servo, self.inputs, self.engine.index + 1, self.engine.channel, self.engine.events, self.readings
        )


def _recorded(rate: float | None) -> float:
    return _RECORDED if rate is None or whole_ratio(rate, _RECORDED) else rate


def simulate(
    servo: Plant,
    duration: float,
    *,
    controller: AnyController | None = None,
    reference: SignalLike = 0.0,
    gap: SignalLike = 0.0,
    tolerance: SignalLike | None = None,
    theta_d0: float = 0.0,
    sample_rate: float | None = None,
    noise: Noise | None = None,
    seed: int | np.random.Generator = 0,
    input_bias: float = 0.0,
    friction: float = 0.0,
) -> Run:
    """Simulate a servo from rest.

    Parameters
    ----------
    servo : Servo or Axis
    duration : float
        s.
    controller : Controller, Cascade or LinearLaw, optional
        The servo's own by default. Its ``sample_rate`` decides between the continuous and the sampled loop.
    reference : number or signal
        Reference of the position, m: a number, SCurve, Step, SquareWave, Samples or PiecewiseCubic.
    gap : number or signal
        Total gap, rad, 0 to 2 pi.
    tolerance : number, signal or None
        Half-width of the dead zone, m; None: no dead zone.
    theta_d0 : float
        Angle of the screw at the start, rad, clamped into the gap around the motor, which starts at 0.
    sample_rate : float, optional
        Hz, of the samples that are returned. By default 5000 Hz, or the controller's own rate where the two do not
        divide one another.
    noise : Noise, optional
        Noise on the measured position, in place of that of its encoder.
    seed : int or numpy.random.Generator
        Seed of the noise.
    input_bias : float
        Voltage added behind the controller and its limits, V.
    friction : float
        Coulomb friction on the motor's shaft, N m; needs a rigid screw.

    Returns
    -------
    Run
        ``round(duration * sample_rate) + 1`` samples, both ends included.

    Raises
    ------
    InvalidInput
        A gap above one turn, a negative gap, tolerance or friction, or rates that do not divide one another; a loop
        that is unstable, and whose motion grows beyond what can be computed.
    """
    simulation = Simulation(
        servo, duration, controller, reference, gap, tolerance, theta_d0, sample_rate, noise, seed, input_bias, friction
    )
    exact = noise is None and simulation.readings is None
    run = _run_in_blocks(simulation, theta_d0) if exact else None
    return run or _run_plant_in_blocks(simulation) or _run_by_steps(simulation)


def _advance(simulation: Simulation, engine: _Advancing, index: int) -> None:
    """Advance an engine of a simulation; raises UnstableLoop where its motion grows beyond every number."""
    advance_bounded(simulation.servo, simulation.controller, lambda: engine.advance(index), lambda: engine.state)


def _run_by_steps(simulation: Simulation) -> Run:
    """The whole run, sample by sample or event by event."""
    simulation.advance(simulation.samples - 1)
    return simulation.run()


def _run_plant_in_blocks(simulation: Simulation) -> Run | None:
    """The whole run with the plant in blocks and the law tick by tick; None where they do not fit or do not pay."""
    if not isinstance(simulation.engine, SampledEngine) or isinstance(simulation.engine, SampledLawEngine):
        return None
    if not fits_plant_blocks(simulation.engine):
        return None
    engine = in_plant_blocks(simulation.engine)
    _advance(simulation, engine, engine.samples - 1)
    return Run(
        simulation.servo, simulation.inputs, simulation.samples, engine.channel, engine.events, simulation.readings
    )


def _run_in_blocks(simulation: Simulation, theta_d0: float) -> Run | None:
    """The whole run without noise in blocks of ticks; None where they do not fit or do not pay."""
    servo, law, inputs, samples = simulation.servo, simulation.controller, simulation.inputs, simulation.samples
    if not isinstance(law, Controller) or not advances_in_blocks(servo, law, inputs, samples):
        return None
    engine = LiftedEngine(servo, law, inputs, theta_d0, samples)
    _advance(simulation, engine, samples - 1)
    return Run(servo, inputs, samples, engine.channel, engine.events)


def _described(sample_rate: float | None) -> str:
    return "continuous" if sample_rate is None else f"sampled at {sample_rate} Hz"


def _check_times(duration: float, sample_rate: float) -> None:
    if not (np.isfinite(duration) and duration > 0.0):
        raise InvalidInput(f"duration = {duration} s: must be positive and finite")
    if not (np.isfinite(sample_rate) and sample_rate > 0.0):
        raise InvalidInput(f"sample_rate = {sample_rate} Hz: must be positive and finite")


def _check_disturbances(input_bias: float, friction: float) -> None:
    if not np.isfinite(input_bias):
        raise InvalidInput(f"input_bias = {input_bias} V: must be finite")
    if not (np.isfinite(friction) and friction >= 0.0):
        raise InvalidInput(f"friction = {friction} N m: must be finite and 0 or more")
