"""Windows of machines that differ from their model, one by one and in a row as a twin gets them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from benchmarks.estimator_windows import WindowCase, cut, random_servo
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus
from servotwin.estimation.learning.wear import Wear
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import Run, simulate
from servotwin.twin.estimating import estimator_of
from servotwin.twin.settings import TwinSettings

FALSE = math.radians(0.1)  # error from which an accepted estimate outside its own interval counts as false
STEP_S, LOOPS = 10.0, ("calm", "dead zone", "no dead zone")


@dataclass(frozen=True)
class ModelError:
    """Largest relative errors of stiffness, damping, pitch, and of the motor's torque gain and back EMF."""

    k: float
    c: float
    pitch: float = 0.0
    motor: float = 0.0

    def machine(self, rng: np.random.Generator, model: Servo) -> Servo:
        """Draw a machine whose loop is stable without a gap."""
        while True:
            k, c, p = (1.0 + rng.uniform(-width, width) for width in (self.k, self.c, self.pitch))
            plant = model.replace(k=tuple(k * model.stiffnesses), c=tuple(c * model.dampings), p=p * model.p)
            if self.motor:
                k_T, k_B = (1.0 + rng.uniform(-self.motor, self.motor) for _ in range(2))
                plant = plant.replace(k_T=k_T * plant.k_T, k_B=k_B * plant.k_B)
            try:
                plant.check_loop()
                return plant
            except InvalidInput:
                continue


def worn_run(rng: np.random.Generator, model: Servo, machine: Servo, loop: str, steps: int, largest: float) -> Run:
    """A machine under its model's controller, stepping every 10 s while its gap grows by up to 3 deg."""
    gap = float(rng.uniform(math.radians(0.5), largest))
    duration = STEP_S * (steps + 1)
    law = model.controller.replace(Ki=0.0) if loop == "calm" else model.controller
    amplitude = math.exp(rng.uniform(math.log(3e-4), math.log(2.5e-3)))
    return simulate(
        machine,
        duration,
        controller=law,
        reference=SquareWave(amplitude, 2.0 * STEP_S),
        gap=SCurve(gap, gap + math.radians(float(rng.uniform(0.0, 3.0))), duration + 5.0),
        tolerance=model.tolerance_for(gap) if loop == "dead zone" else None,
        theta_d0=float(rng.uniform(-0.5, 0.5)) * gap,
    )


def step_windows(run: Run, loop: str, model: Servo, noise: float, rng: np.random.Generator) -> Iterator[WindowCase]:
    """The window of each step: 2 s from 0.3 s before it in a calm loop, otherwise the second after it."""
    early, seconds = (0.3, 2.0) if loop == "calm" else (0.0, 1.0)
    for number in range(1, round(float(run.time[-1]) / STEP_S)):
        case = cut(run, STEP_S * number - early, seconds, f"{loop}, step {number}")
        case = case.noisy(rng.normal(0.0, noise, case.window.position.size)) if noise else case
        yield case.replaced(case.window, model)


@dataclass
class Tally:
    """Counts over many windows.

    Attributes
    ----------
    windows, two_contacts, accepted : int
    accepted_late, two_contacts_late : int
        Of windows with two contacts before which the twin has had ten.
    false : int
        Accepted, off by more than 0.1 deg and outside of their 95 % interval.
    inside : int
        Accepted with the gap inside the interval.
    within : int
        Accepted and off by at most 1.96 `std`, the statistical part of the spread.
    worst : float
        rad, the largest error of the false ones.
    above : int
        Lower bounds by more than 0.1 deg above the gap.
    half_widths : list of float
        rad, of the accepted intervals.
    examples : list of str
        The false ones in words.
    """

    windows: int = 0
    two_contacts: int = 0
    accepted: int = 0
    accepted_late: int = 0
    two_contacts_late: int = 0
    false: int = 0
    inside: int = 0
    within: int = 0
    worst: float = 0.0
    above: int = 0
    half_widths: list[float] = field(default_factory=list)
    examples: list[str] = field(default_factory=list)

    def add(self, case: WindowCase, estimate: GapEstimate, late: bool) -> None:
        """Count one window; `late`: the twin has had ten before it."""
        self.windows += 1
        self.two_contacts += case.two_contacts
        self.two_contacts_late += late and case.two_contacts
        if not estimate.ok:
            self.above += estimate.status is GapStatus.LOWER_BOUND and estimate.gap > case.gap + FALSE
            return
        inside, error = estimate.interval[0] <= case.gap <= estimate.interval[1], abs(estimate.gap - case.gap)
        self.accepted += 1
        self.accepted_late += late and case.two_contacts
        self.inside += inside
        self.within += error <= NORMAL_95 * estimate.std
        self.half_widths.append(0.5 * (estimate.interval[1] - estimate.interval[0]))
        if error > FALSE and not inside:
            self.false += 1
            self.worst = max(self.worst, error)
            self.examples.append(f"{case.words}: {estimate!r}, and it was {math.degrees(case.gap):.4g} deg")

    def join(self, other: Tally) -> None:
        """Add another tally's counts."""
        for name in ("windows", "two_contacts", "accepted", "accepted_late", "two_contacts_late", "false", "inside"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.within += other.within
        self.above += other.above
        self.worst = max(self.worst, other.worst)
        self.half_widths += other.half_widths
        self.examples += other.examples

    @property
    def statistical(self) -> float:
        """Share of the accepted estimates within 1.96 of their own `std`."""
        return self.within / self.accepted if self.accepted else math.nan

    @property
    def half_width(self) -> float:
        """Median half of the accepted intervals, rad."""
        return median(self.half_widths) if self.half_widths else math.nan

    @property
    def coverage(self) -> float:
        """Share of the accepted estimates whose 95 % interval holds the gap."""
        return self.inside / self.accepted if self.accepted else math.nan


def learning_twin(
    error: ModelError, loop: str, machines: int, seed: int, noise: float = 1e-6, steps: int = 15, largest: float = 30.0
) -> Tally:
    """Follow `machines` through `steps` windows each, as a twin does that learns; `largest` gap in degrees."""
    rng, settings, tally = np.random.default_rng(seed), TwinSettings(), Tally()
    for _ in range(machines):
        model = random_servo(rng)
        run = worn_run(rng, model, error.machine(rng, model), loop, steps, math.radians(largest))
        estimator, wear = estimator_of(model, settings), Wear(0.0)
        for number, case in enumerate(step_windows(run, loop, model, noise, rng)):
            now = case.window.mid_time
            expected = wear.expect(settings.trend, "boot", now, now, settings.learning)
            estimate = estimator(case.window, expected)
            wear, _ = wear.update(settings.trend, "boot", estimate, now, settings.learning)
            tally.add(case, estimate, number >= 10)
    return tally
