"""The inputs of the workloads: a servo that wears for 200 s, and an ensemble of gaps and tolerances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from servotwin.control import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave

UNIT = 1e-3  # m: what errors of a position are divided by
PRESET = "table1"


@cache
def the_servo() -> Servo:
    """The preset of all workloads, read once."""
    return Servo.preset(PRESET)


@dataclass(frozen=True)
class Wear:
    """A gap that opens along a smoothstep under a square-wave reference (W1, W3 and the sampled run).

    Parameters
    ----------
    duration, period : float
        s, of the run and of the square wave.
    amplitude : float
        m.
    final_gap, tolerance_gap : float
        rad, total gap at the end, and the gap that the constant tolerance is made for.
    sample_rate : float
        Hz, of the output.
    """

    duration: float = 200.0
    period: float = 40.0
    amplitude: float = UNIT
    final_gap: float = math.radians(60.0)
    tolerance_gap: float = math.radians(10.0)
    sample_rate: float = 5000.0

    @property
    def servo(self) -> Servo:
        return the_servo()

    @property
    def tolerance(self) -> float:
        """m."""
        return self.servo.tolerance_for(self.tolerance_gap)

    @property
    def gap(self) -> SCurve:
        """Total gap, rad."""
        return SCurve(0.0, self.final_gap, duration=self.duration)

    @property
    def reference(self) -> SquareWave:
        """m."""
        return SquareWave(amplitude=self.amplitude, period=self.period)

    @property
    def turns(self) -> int:
        """Number of half periods."""
        return round(2.0 * self.duration / self.period)

    @property
    def samples(self) -> int:
        """Of the output, both ends included."""
        return round(self.duration * self.sample_rate) + 1

    @property
    def half_gap(self) -> tuple[float, float, float]:
        """Half the gap as c0 + c2 t^2 + c3 t^3, rad."""
        half = 0.5 * self.final_gap
        return 0.0, 3.0 * half / self.duration**2, -2.0 * half / self.duration**3

    def level(self, turn: int) -> float:
        """Reference in a half period, m."""
        return self.amplitude if turn % 2 == 0 else -self.amplitude


@dataclass(frozen=True)
class Sweep:
    """Total gaps 0 .. 60 deg times tolerances 0 .. those for 20 deg, each run from rest to a step (W2).

    Parameters
    ----------
    side : int
        Number of gaps, and of tolerances.
    duration : float
        s.
    step : float
        m.
    sample_rate : float
        Hz, of the output.
    """

    side: int = 16
    duration: float = 20.0
    step: float = UNIT
    sample_rate: float = 100.0

    @property
    def servo(self) -> Servo:
        return the_servo()

    @property
    def members(self) -> tuple[Array, Array]:
        """(K,) total gaps in rad and (K,) tolerances in m; 0 is no backlash, no dead zone."""
        gaps = np.radians(np.linspace(0.0, 60.0, self.side))
        tolerances = self.servo.tolerance_for(math.radians(10.0)) * np.linspace(0.0, 2.0, self.side)
        grid = np.meshgrid(gaps, tolerances, indexing="ij")
        return grid[0].ravel(), grid[1].ravel()

    @property
    def samples(self) -> int:
        """Of each member's output, both ends included."""
        return round(self.duration * self.sample_rate) + 1


@dataclass(frozen=True)
class Noisy:
    """The same wear with a sampled controller in measurement noise, behind the paper's loop filter (section 4.3)."""

    wear: Wear
    noise_std: float = 0.22e-3
    loop_filter_hz: float = 20.0
    seed: int = 1

    @property
    def noise(self) -> Noise:
        """The paper's, high-passed."""
        return Noise(std=self.noise_std)

    @property
    def controller(self) -> Controller:
        """The servo's own, sampled at the rate of the output."""
        servo, rate = self.wear.servo, self.wear.sample_rate
        return servo.controller.replace(sample_rate=rate, loop_filter_hz=self.loop_filter_hz)
