"""Simulated runs without a twin, shared by figures and claims: each is a small frozen job and is computed once."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np

from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.reproduction import measures
from servotwin.reproduction.measures import Array, MeasuredStep, Settling
from servotwin.simulation import Run, simulate

AMPLITUDE = 1e-3  # m, section 3.2
PERIOD, DURATION = 40.0, 200.0  # s, section 3.2
_STEP_DURATION = 60.0  # s, of the runs with one step
_END_DEG, STRESS_DEG = 20.0, 30.0  # where the gap's S-curve ends (erratum E15)
ESTIMATE_DEG = 10.0  # the fixed estimate of Figs 11 and 12
RATE, _TRACE_RATE = 5000.0, 500.0  # Hz: simulated and recorded; stored for plots and measures
_SETTLING = Settling(AMPLITUDE)
_COUNTS = 2.0  # of the position's sensor: a load that swings by so many has settled

_R = TypeVar("_R", covariant=True)


@dataclass(frozen=True, slots=True)
class Square:
    """A reading of "a square wave with a 1 mm amplitude" (erratum E20)."""

    name: str
    amplitude: float
    offset: float

    @property
    def signal(self) -> SquareWave:
        """The reference."""
        return SquareWave(self.amplitude, PERIOD, self.offset)

    def scaled(self, factor: float) -> Square:
        """Scale amplitude and offset."""
        return replace(self, amplitude=self.amplitude * factor, offset=self.offset * factor)

    @property
    def family(self) -> tuple[Square, ...]:
        """Nine squares whose amplitudes differ by 0.1 %, less than any machine is known to (erratum E17)."""
        return tuple(self.scaled(1.0 + 1e-3 * k) for k in range(-4, 5))


BIPOLAR = Square("±1 mm", AMPLITUDE, 0.0)
UNIPOLAR = Square("0/1 mm", AMPLITUDE / 2.0, AMPLITUDE / 2.0)


@dataclass(frozen=True, eq=False)
class Trace:
    """The signals of a run at `_TRACE_RATE` Hz, or whole, each (N,), SI units."""

    time: Array
    position: Array
    reference: Array
    theta_m: Array
    theta_d: Array
    voltage: Array
    gap: Array
    tolerance: Array
    settling: Settling = _SETTLING

    @classmethod
    def of(cls, run: Run) -> Trace:
        """Decimate a run: every tenth sample at 5 kHz."""
        return cls._every(run, round(run.sample_rate / _TRACE_RATE))

    @classmethod
    def whole(cls, run: Run) -> Trace:
        """Every sample of a run of any machine, whose steps count as those of the paper do.

        The tail is a quarter of the time between two steps, and the scale half of the reference's span.
        """
        every = cls._every(run, 1)
        between = np.median(np.diff([*measures.reference_changes(every.time, every.reference), every.time[-1]]))
        amplitude = 0.5 * float(np.ptp(every.reference)) or float(np.max(np.abs(every.reference)))
        floor = _COUNTS * run.servo.position_resolution
        return replace(every, settling=Settling(amplitude, 0.25 * float(between), floor))

    @classmethod
    def _every(cls, run: Run, samples: int) -> Trace:
        names = (name for name in cls.__dataclass_fields__ if name != "settling")
        signals = {name: np.ascontiguousarray(getattr(run, name)[::samples]) for name in names}
        return cls(**signals, settling=_SETTLING)

    @cached_property
    def steps(self) -> tuple[MeasuredStep, ...]:
        """Every stretch of constant reference, measured."""
        return measures.steps(self.time, self.position, self.reference, self.gap, self.settling)


class RunJob(Hashable, Protocol[_R]):
    """A simulation to run. Equal jobs are run once."""

    def run(self) -> _R: ...


@dataclass(frozen=True, slots=True)
class StepJob:
    """A step from rest with a constant gap; `dead_zone_deg` is the gap for which the dead zone is made, None: none."""

    preset: str
    gap_deg: float
    dead_zone_deg: float | None = None
    amplitude: float = AMPLITUDE
    theta_d0_deg: float = 0.0
    duration: float = _STEP_DURATION

    def simulate(self) -> Run:
        """Simulate the run."""
        servo = Servo.preset(self.preset)
        return simulate(
            servo,
            self.duration,
            reference=self.amplitude,
            gap=math.radians(self.gap_deg),
            tolerance=tolerance(servo, self.dead_zone_deg),
            theta_d0=math.radians(self.theta_d0_deg),
            sample_rate=RATE,
        )

    def run(self) -> Trace:
        """Simulate; keep the signals."""
        return Trace.of(self.simulate())


@dataclass(frozen=True, slots=True)
class StepMeasureJob:
    """A step as in `StepJob`; only its measures are kept."""

    step: StepJob

    def run(self) -> MeasuredStep:
        """Simulate; measure the step relative to its own size."""
        run = self.step.simulate()
        still = np.zeros_like(run.time)
        size = abs(self.step.amplitude)
        return measures.steps(run.time, run.position, run.reference, still, Settling(size))[0]


@dataclass(frozen=True, slots=True)
class MotorTravelJob:
    """The motor's largest angle (rad) in a step run."""

    step: StepJob

    def run(self) -> float:
        """Simulate; keep the largest angle."""
        return float(np.abs(self.step.simulate().theta_m).max())


@dataclass(frozen=True, slots=True)
class WearJob:
    """The square wave while the gap wears from 0 to `to_deg`, with a fixed dead zone (Fig 12); None: no dead zone."""

    preset: str
    square: Square = BIPOLAR
    dead_zone_deg: float | None = ESTIMATE_DEG
    to_deg: float = _END_DEG

    def run(self) -> Trace:
        """Simulate; keep the signals."""
        servo = Servo.preset(self.preset)
        run = simulate(
            servo,
            DURATION,
            reference=self.square.signal,
            gap=wear(self.to_deg),
            tolerance=tolerance(servo, self.dead_zone_deg),
            sample_rate=RATE,
        )
        return Trace.of(run)


@dataclass(frozen=True, slots=True)
class FixedFamilyJob:
    """The steps of Fig 12's run for a family of squares."""

    preset: str
    square: Square = BIPOLAR

    def run(self) -> tuple[tuple[MeasuredStep, ...], ...]:
        """Simulate; one row of steps per member."""
        return tuple(WearJob(self.preset, member).run().steps for member in self.square.family)


def wear(to_deg: float) -> SCurve:
    """The S-curve of the gap, rad."""
    return SCurve(0.0, math.radians(to_deg), DURATION)


def tolerance(servo: Servo, dead_zone_deg: float | None) -> float | None:
    """Dead-zone half-width, m, for a gap in degrees; None: no dead zone."""
    return None if dead_zone_deg is None else servo.tolerance_for(math.radians(dead_zone_deg))


@dataclass(eq=False)
class Runs:
    """One preset and every run made with it so far."""

    preset: str
    results: dict[Any, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def servo(self) -> Servo:
        """The preset's servo."""
        return Servo.preset(self.preset)

    def get(self, job: RunJob[_R]) -> _R:
        """Return the job's result; compute it the first time."""
        if job not in self.results:
            self.results[job] = job.run()
        result: _R = self.results[job]
        return result

    def step(self, gap_deg: float, dead_zone_deg: float | None = None) -> Trace:
        """Signals of a 1 mm step (Figs 9 and 11)."""
        return self.get(StepJob(self.preset, gap_deg, dead_zone_deg))

    def settle(self, gap_deg: float, dead_zone_deg: float | None, **more: float) -> MeasuredStep:
        """Measures of a step."""
        return self.get(StepMeasureJob(StepJob(self.preset, gap_deg, dead_zone_deg, **more)))

    def sweep(self, gaps_deg: Iterable[float]) -> tuple[MeasuredStep, ...]:
        """Measures of 1 mm steps over gaps, with the dead zone made for `ESTIMATE_DEG`."""
        return tuple(self.settle(float(gap), ESTIMATE_DEG) for gap in gaps_deg)

    def ensemble(self, gap_deg: float, dead_zone_deg: float) -> tuple[MeasuredStep, ...]:
        """81 members over reference amplitudes (0.5 to 2 mm) and initial screw angles (the whole gap), erratum E17."""
        starts = np.linspace(-0.5, 0.5, 9) * gap_deg
        sizes = AMPLITUDE * np.geomspace(0.5, 2.0, 9)
        return tuple(
            self.settle(gap_deg, dead_zone_deg, amplitude=float(size), theta_d0_deg=float(start), duration=30.0)
            for size in sizes
            for start in starts
        )

    def reaction(self, gap_deg: float, amplitude: float) -> float:
        """Largest motor angle (rad) in 5 s after a step, with the dead zone made for the gap."""
        return self.get(MotorTravelJob(StepJob(self.preset, gap_deg, gap_deg, amplitude, duration=5.0)))

    def wear(self, square: Square = BIPOLAR, to_deg: float = _END_DEG) -> Trace:
        """Signals of Fig 12."""
        return self.get(WearJob(self.preset, square, to_deg=to_deg))
