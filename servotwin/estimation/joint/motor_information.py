"""What can be learnt of the motor, and from what: the point that the paper leaves open.

G1 = k_T / (s (J L s^2 + J R s + k_T k_B)) has three coefficients for five parameters: from voltage and angle three
products are identifiable, J L / k_T, J R / k_T and k_B, and no single parameter but k_B. The information matrix says
the same, and how well each is known from a given window.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import BY_GAP, BY_START, SCREW, Gap, contacts
from servotwin.estimation.core.family import MOTOR, Hold, Sampled, motor_family, structure_family
from servotwin.estimation.joint.identifiability import Identifiability, identifiability
from servotwin.estimation.window import Window
from servotwin.hybrid.compiled import compiled
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

PRODUCTS: Mapping[str, Mapping[str, float]] = {
    "k_B": {"k_B": 1.0},
    "J R/(k_T k_B)": {"J": 1.0, "R": 1.0, "k_T": -1.0, "k_B": -1.0},
    "L/R": {"L": 1.0, "R": -1.0},
    "J R/k_T": {"J": 1.0, "R": 1.0, "k_T": -1.0},
    "J L/k_T": {"J": 1.0, "L": 1.0, "k_T": -1.0},
    "p/k_B": {"pitch": 1.0, "k_B": -1.0},
    **{name: {name: 1.0} for name in ("J", "L", "R", "k_T")},
}
_SHORT = 200  # samples: an input that is wholly unknown leaves nothing of any number of them


@dataclass(frozen=True)
class SensorNoise:
    """White noise, standard deviations: rad on the motor's angle, m on the position."""

    theta_m: float = math.radians(0.01)
    position: float = 1e-6


@dataclass(frozen=True, eq=False)
class Case:
    """What is measured, and what that shows of (J, L, R, k_T, k_B)."""

    measured: str
    shows: Identifiability

    @property
    def stds(self) -> Mapping[str, float]:
        """Relative standard deviation of each of `PRODUCTS`; inf where it is not identifiable."""
        known = {"pitch": 0.0} if "pitch" not in self.shows.names else {}
        return {name: self.shows.relative_std(_without(powers, known)) for name, powers in PRODUCTS.items()}


def _without(powers: Mapping[str, float], known: Mapping[str, float]) -> Mapping[str, float]:
    """The powers of what is not known."""
    return {name: power for name, power in powers.items() if name not in known}


def motor_cases(
    window: Window, servo: Servo, at: Gap, noise: SensorNoise | None = None, hold: Hold = Hold.LINEAR
) -> tuple[Case, ...]:
    """The six cases, for the motion that a window holds.

    Parameters
    ----------
    window : Window
        With theta_m and voltage: the operating point. Which of them a case may use is the case's affair.
    servo : Servo
    at : Gap
        Gap and first screw angle that the window was made with (rad).
    noise : SensorNoise, optional
    hold : Hold
        What the voltage does between samples.

    Raises
    ------
    InvalidInput
        The window lacks theta_m or voltage, or the screw is elastic.
    """
    if window.theta_m is None or window.voltage is None:
        raise InvalidInput(f"{window.where}the window needs theta_m (rad) and voltage (V)")
    if not servo.rigid:
        raise InvalidInput("servo k_d is finite: its load acts on the motor, and G1 alone does not describe that")
    spread, motor = noise or SensorNoise(), motor_family(servo).sampled(window.sample_rate, hold)
    responses, free = motor.respond(window.voltage), motor.free(window.voltage.size)
    driven = responses[1:]
    angle = _fitted(window.theta_m, responses[0], free)
    return (
        Case("theta_m, voltage unknown", _unknown_input(motor, driven, spread.theta_m)),
        Case("theta_m, loop open (voltage 0)", _coasting(motor, angle, window.sample_rate, spread.theta_m)),
        Case("voltage and theta_m", identifiability(MOTOR, driven, free, spread.theta_m)),
        *_from_position(angle, servo, at, window.sample_rate, (driven, free), spread.position),
    )


def _fitted(theta_m: Array, forced: Array, free: Array) -> Array:
    """The angle that the model itself gives for the voltage, from the initial state that fits best."""
    state = np.linalg.lstsq(free.T, theta_m - forced, rcond=None)[0]
    return np.asarray(forced + state @ free)


def _unknown_input(motor: Sampled, driven: Array, noise: float) -> Identifiability:
    """Every sample of the voltage is one more unknown, and each is worth a sample of the angle."""
    size = min(_SHORT, driven.shape[1])
    pulses = motor.plain(np.eye(size))
    return identifiability(MOTOR, driven[:, :size], np.vstack([motor.free(size), pulses]), noise)


def _coasting(motor: Sampled, theta_m: Array, rate: float, noise: float) -> Identifiability:
    """The motor runs out from the window's greatest speed, its state at the beginning unknown."""
    speed = float(np.abs(np.diff(theta_m)).max()) * rate
    runs = motor.respond(np.zeros(theta_m.size), np.array([0.0, speed, 0.0]))[1:]
    return identifiability(MOTOR, runs, motor.free(theta_m.size), noise)


def _from_position(
    theta_m: Array, servo: Servo, at: Gap, rate: float, motor: tuple[Array, Array], noise: float
) -> tuple[Case, ...]:
    """Through the gap and the structure: gap, first screw angle and initial states are unknown too."""
    structure, screw = structure_family(servo).sampled(rate), contacts(theta_m, at)
    position = structure.respond(screw[SCREW])
    driven, free = (through_gap(columns, theta_m, at) for columns in motor)
    unknown = np.vstack([structure.plain(np.vstack([free, screw[[BY_GAP, BY_START]]])), structure.free(theta_m.size)])
    skewed = np.vstack([unknown, np.gradient(position[0])])
    seen, names = structure.plain(driven), (*MOTOR, "pitch")
    with_pitch = np.vstack([seen, position[3:]])
    return (
        Case("voltage and position, clocks in step", identifiability(MOTOR, seen, unknown, noise)),
        Case("voltage and position, delay unknown", identifiability(MOTOR, seen, skewed, noise)),
        Case("voltage and position, pitch unknown too", identifiability(names, with_pitch, skewed, noise)),
    )


def through_gap(columns: Array, theta_m: Array, at: Gap) -> Array:
    """(k, n) changes of the screw's angle for changes `columns` (k, n) of the motor's: kept since the last contact."""
    last = last_contacts(theta_m, at.gap, at.theta_d0, at.rate)
    touched = last >= 0
    return np.where(touched, columns[:, np.maximum(last, 0)], 0.0)


@compiled
def last_contacts(
    theta_m: Array, gap: float, theta_d0: float, rate: float
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """(n,) sample at which the motor last pushed the screw; -1 before it ever did."""
    last = np.empty(theta_m.size, np.int64)
    screw, latest, middle = theta_d0, -1, 0.5 * (theta_m.size - 1)
    for i in range(theta_m.size):
        half = 0.5 * (gap + rate * (i - middle))
        moved = min(max(screw, theta_m[i] - half), theta_m[i] + half)
        if moved != screw:
            screw, latest = moved, i
        last[i] = latest
    return last


def table(cases: tuple[Case, ...]) -> str:
    """The relative standard deviations as a Markdown table; a dash where a product is not identifiable at all."""
    head = ["measured", "identifiable", *PRODUCTS]
    lines = [head, ["---"] * len(head)]
    for case in cases:
        cells = [_percent(std) for std in case.stds.values()]
        lines.append([case.measured, f"{case.shows.rank} of {len(case.shows.names)}", *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _percent(std: float) -> str:
    return "-" if math.isinf(std) else "> 100 %" if std > 1.0 else f"{100.0 * std:.2g} %"
