"""Windows of random axes whose shaft is free in the gap, or of one mass on a rigid screw, and the estimates from them.

``python -m benchmarks.axis_windows SEED COUNT`` prints one line for each kind; with ``shaft`` or ``screw`` after them,
for these only.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

SHAFT = ("clean", "model off", "counts", "delay", "all", "quiet")
"""Clean has white noise of 0.1 to 10 % of the gap, as all others; model off: k_d and inertia 5 %, dampings 50 % off;
delay: up to a twentieth of the shaft's radian; quiet: a reference below the gap, and the model off."""
SCREW = ("clean", "counts", "noise", "ratio")


@dataclass(frozen=True, eq=False)
class AxisCase:
    """A window of a machine, the model that the estimator gets, the true gap and one count at the motor, rad."""

    window: Window
    model: Axis
    gap: float
    count: float = 0.0


def two_mass_drive(random: np.random.Generator) -> tuple[Axis, float]:
    """A stable drive with a free shaft, and the shaft's own frequency (rad/s).

    Inertia 0.01 to 100 kg m^2, frequency 2 to 32 Hz, ratio 0.01 to 1, motor 0.2 to 2 times as heavy as the load.
    """
    while True:
        m, omega = 10 ** random.uniform(-2, 2), 2.0 * math.pi * 10 ** random.uniform(0.3, 1.5)
        p, share = 10 ** random.uniform(-2, 0), random.uniform(0.2, 2.0)
        drag, damping = random.uniform(0.005, 0.1) * m * omega, 2.0 * random.uniform(0.005, 0.2) * m * omega
        speed, total = omega * random.uniform(0.15, 0.4), (1.0 + share) * m
        law = Controller(
            Kp=total * speed**2 * p,
            Ki=0.2 * total * speed**3 * p * random.integers(0, 2),
            Kd=2.0 * random.uniform(0.3, 0.9) * total * speed * p,
            Tf=0.1 / omega,
        )
        axis = Axis(
            TorqueDrive(J=share * m * p * p, lag=0.05 / omega, friction=0.3 * drag * p * p),
            Transmission(p, m * omega**2, damping if random.random() < 0.8 else 0.0, "free"),
            Load((m,), (0.0,), (drag,), "rotary"),
            law,
            Sensors(feedback="motor" if random.random() < 0.5 else "load"),
        )
        try:
            axis.check_loop()
        except InvalidInput:
            continue
        return axis, omega


def shaft_case(random: np.random.Generator, kind: str) -> AxisCase:
    """A window of 12 to 25 own periods of a drive with a gap of 0.01 to 1 deg at the load, 80 to 200 samples each."""
    axis, omega = two_mass_drive(random)
    at_load, period = math.radians(10 ** random.uniform(-2, 0)), 2.0 * math.pi / omega
    gap = at_load / axis.p
    amplitude = at_load * (10 ** random.uniform(-1, 0) if kind == "quiet" else 10 ** random.uniform(0, 1.5))
    rate, duration = random.uniform(80, 200) / period, random.uniform(12, 25) * period
    reference = SquareWave(amplitude, duration * random.uniform(0.3, 1.2))
    run = simulate(axis, 1.6 * duration, reference=reference, gap=gap, sample_rate=rate)
    first = int(0.5 * duration * rate * random.random())
    part, count = slice(first, first + int(duration * rate)), 0.0
    angle, position = run.theta_m, run.position
    if kind in ("delay", "all"):
        position = np.interp(run.time - 0.05 / omega * random.uniform(-1, 1), run.time, position)
    position = position + random.normal(0.0, at_load * 10 ** random.uniform(-3, -1), position.size)
    if kind in ("counts", "all"):
        shares = 10 ** random.uniform(-2, -0.5, 2)
        count = gap * float(shares.max())
        position = np.round(position / (at_load * shares[0])) * at_load * shares[0]
        angle = np.round(angle / (gap * shares[1])) * gap * shares[1]
    model = _off(axis, random) if kind in ("model off", "all", "quiet") else axis
    return AxisCase(Window(position[part], angle[part], sample_rate=rate), model, gap, count)


def _off(axis: Axis, random: np.random.Generator) -> Axis:
    """The axis with stiffness and inertia 5 % and dampings 50 % off."""
    t, load = axis.transmission, axis.load
    near, far = random.choice([0.95, 1.05], 2), random.choice([0.5, 1.5], 2)
    return axis.replace(
        transmission=Transmission(t.p, t.k_d * near[0], t.c_d * far[0], "free"),
        load=Load((load.m[0] * near[1],), load.k, (load.c[0] * far[1],), "rotary"),
    )


def screw_case(random: np.random.Generator, kind: str) -> AxisCase:
    """A window of a table of one mass on a screw of 5 mm per turn, gap 1 to 100 um; one in five touches one flank.

    Counts: 0.1 um or an eighth of the gap at the table, 10 to 200 in the gap at the motor. Ratio: 0.1 % off, and noise.
    """
    p, at_load = 5e-3 / (2.0 * math.pi), 10 ** random.uniform(-6, -4)
    gap, time = at_load / p, np.arange(int(random.integers(600, 4000))) / 1000.0
    swing = gap * (10 ** random.uniform(0.2, 2.5) if random.random() < 0.8 else random.uniform(0.1, 0.9))
    omega = 2.0 * math.pi * random.uniform(0.7, 3.0) / time[-1]
    angle = swing * (np.sin(omega * time + random.uniform(0, 6.28)) + 0.2 * np.sin(3.1 * omega * time))
    ratio = p * (1.0 + 1e-3 * random.uniform(-1, 1)) if kind == "ratio" else p
    position = ratio * play(angle, gap, angle[0] + gap * random.uniform(-0.5, 0.5)) + random.uniform(-1, 1)
    at_motor = at_table = 0.0
    if kind in ("noise", "ratio"):
        position = position + random.normal(0.0, at_load * 10 ** random.uniform(-3, -0.7), time.size)
    if kind == "counts":
        at_table, at_motor = min(1e-7, at_load / 8.0), gap / random.uniform(10, 200)
        position, angle = np.round(position / at_table) * at_table, np.round(angle / at_motor) * at_motor
    axis = Axis(
        VelocityDrive(5e-3),
        Transmission(p),
        Load((20.0,)),
        Controller(3e4, 1e4, 0.0, 0.1),
        Sensors(at_motor, at_table),
    )
    return AxisCase(Window(position, angle, sample_rate=1000.0), axis, gap, max(at_motor, at_table / p))


@dataclass
class AxisTally:
    """Estimates of one kind: numbers by status, and of accepted ones the errors over `std_total`."""

    by_status: dict[GapStatus, int] = field(default_factory=dict)
    errors: list[float] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)
    inside: int = 0
    false: int = 0
    bounds_above: int = 0

    def add(self, case: AxisCase, estimate: GapEstimate) -> None:
        """Count one estimate; false: off by more than 1 % of the gap and two counts, and outside of its interval."""
        self.by_status[estimate.status] = self.by_status.get(estimate.status, 0) + 1
        self.bounds_above += estimate.status is GapStatus.LOWER_BOUND and estimate.gap > case.gap
        if not estimate.ok:
            return
        error = estimate.gap - case.gap
        inside = estimate.interval[0] <= case.gap <= estimate.interval[1]
        self.inside += inside
        self.false += abs(error) > max(0.01 * case.gap, 2.0 * case.count) and not inside
        self.errors.append(error / estimate.std_total)
        self.shares.append(abs(error) / case.gap)

    def __str__(self) -> str:
        """One line."""
        counts = ", ".join(f"{status.value} {number}" for status, number in sorted(self.by_status.items()))
        spread = math.sqrt(float(np.mean(np.square(self.errors)))) if self.errors else math.nan
        middle = float(np.median(self.shares)) if self.shares else math.nan
        return (
            f"{counts}; inside {self.inside}, false {self.false}, bounds above {self.bounds_above}; "
            f"error / std_total {spread:.2f} rms, median error {100 * middle:.2g} % of the gap"
        )


def tally(make: Callable[[np.random.Generator, str], AxisCase], kind: str, count: int, seed: int) -> AxisTally:
    """Estimate `count` windows of a kind."""
    result = AxisTally()
    for index in range(count):
        case = make(np.random.default_rng([seed, index, len(kind)]), kind)
        estimate = estimate_gap(case.window, case.model)
        result.add(case, estimate)
    return result


def main(seed: int, count: int, only: str = "") -> None:
    """Print a line for each kind, or for those of shafts or screws only."""
    for name, make, kinds in (("shaft", shaft_case, SHAFT), ("screw", screw_case, SCREW)):
        for kind in kinds if only in ("", name) else ():
            print(f"{name}, {kind}: {tally(make, kind, count, seed)}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
