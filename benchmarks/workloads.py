"""Inputs of the workloads: a servo that wears for 200 s, an ensemble of gaps and tolerances, and the equations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from servotwin.control import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.axis import Axis
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave

UNIT = 1e-3  # m: unit of position errors
PRESET = "table1"


@cache
def the_servo(preset: str = PRESET, calm: bool = False) -> Servo:
    """A preset, read once; `calm` without integral action, so that it comes to rest in its gap."""
    servo = Servo.preset(preset)
    return servo.replace(controller=servo.controller.replace(Ki=0.0)) if calm else servo


@cache
def knocking_drive() -> Axis:
    """The preset two-mass-drive under a filtered PID on its load in place of its cascade: its motor knocks in the gap
    at all times, which makes many events."""
    law = Controller(Kp=60.0, Ki=40.0, Kd=20.0, Tf=0.02, voltage_limit=60.0, sample_rate=2000.0)
    return Axis.preset("two-mass-drive").replace(controller=law)


@dataclass(frozen=True)
class WearWorkload:
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
    preset : str
    calm : bool
        A loop without integral action.
    """

    duration: float = 200.0
    period: float = 40.0
    amplitude: float = UNIT
    final_gap: float = math.radians(60.0)
    tolerance_gap: float = math.radians(10.0)
    sample_rate: float = 5000.0
    preset: str = PRESET
    calm: bool = False

    @property
    def servo(self) -> Servo:
        return the_servo(self.preset, self.calm)

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
        """Number of samples of the output, both ends included."""
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
class SweepWorkload:
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
        """Number of samples of each member's output, both ends included."""
        return round(self.duration * self.sample_rate) + 1


@dataclass(frozen=True)
class NoisyWorkload:
    """The same wear with a sampled controller in measurement noise, behind the paper's loop filter (section 4.3).

    Parameters
    ----------
    wear : WearWorkload
    noise_std : float or None
        m; None: no noise.
    white : bool
        White noise instead of the paper's, which is high-passed.
    resolution : float
        Count of the position sensor, m; 0: none.
    loop_filter_hz : float or None
        Hz.
    seed : int
    """

    wear: WearWorkload
    noise_std: float | None = 0.22e-3
    white: bool = False
    resolution: float = 0.0
    loop_filter_hz: float | None = 20.0
    seed: int = 1

    @property
    def servo(self) -> Servo:
        """The wear's, with its sensor."""
        return self.wear.servo.replace(position_resolution=self.resolution)

    @property
    def noise(self) -> Noise | None:
        """None: the run without noise."""
        return None if self.noise_std is None else Noise(std=self.noise_std, kind="white" if self.white else "highpass")

    @property
    def controller(self) -> Controller:
        """The servo's own controller, sampled at the rate of the output."""
        servo, rate = self.wear.servo, self.wear.sample_rate
        return servo.controller.replace(sample_rate=rate, loop_filter_hz=self.loop_filter_hz)


@dataclass(frozen=True, eq=False)
class LoopEquations:
    """Equations 1 to 14 as matrices: motor, chain and filtered PID; each solver adds gap and dead zone itself.

    Attributes
    ----------
    motor_A, motor_B : (3, 3) and (3,) arrays
        Of (current, speed, angle) and the voltage.
    chain_A, chain_B : (4, 4) and (4,) arrays
        Of the chain's states and the screw's angle; the rate of the screw is substituted away.
    position : (4,) array
        Row of the last mass.
    Kp, Ki, N, Tf : float
        N = Kd / Tf; the voltage is Kp e + Ki (integral of e) + N (e - lagged e).
    """

    motor_A: Array
    motor_B: Array
    chain_A: Array
    chain_B: Array
    position: Array
    Kp: float
    Ki: float
    N: float
    Tf: float


def equations_of(servo: Servo) -> LoopEquations:
    """Derive the equations of a servo with three masses, a rigid screw and its own continuous controller."""
    A, B, _ = servo.motor()
    chain, law = servo.chain(), servo.controller
    # x' = A x + B_p d + B_v d' becomes z' = A z + (B_p + A B_v) d with z = x - B_v d; positions are not touched.
    drive = servo.p * (chain.B_position + chain.A @ chain.B_velocity)
    return LoopEquations(
        motor_A=A,
        motor_B=B,
        chain_A=chain.A,
        chain_B=drive,
        position=chain.C_last,
        Kp=law.Kp,
        Ki=law.Ki,
        N=law.Kd / law.Tf,
        Tf=law.Tf,
    )
