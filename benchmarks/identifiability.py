"""Parameters, or products of parameters, that a measurement determines; those of the motor in six cases.

Everything is by the logarithms of the parameters, so that a direction of the information matrix is a product of powers
and its standard deviation is relative. A direction without information is a product that no such data can ever show.

G1 = k_T / (s (J L s^2 + J R s + k_T k_B)) has three coefficients for five parameters: from voltage and angle three
products are identifiable, J L / k_T, J R / k_T and k_B, and no single parameter but k_B. The information matrix says
the same, and how well each is known from a given window. The paper leaves this open.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import BY_GAP, BY_START, SCREW, Gap, contacts, through_gap
from servotwin.estimation.core.family import MOTOR, InputHold, Sampled, motor_family, structure_family
from servotwin.estimation.core.least_squares import orthonormal, project_out
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_SINGULAR = 1e-9  # of the longest sensitivity: less is rounding
_ALONG = 1e-6  # share of a direction that may lie where nothing is known


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Singular value decomposition of the whitened sensitivities, nuisances taken off.

    Attributes
    ----------
    names : tuple of str
        P parameters.
    strengths : (P,) array
        Singular values, falling; the information matrix has their squares as eigenvalues. 0 where there is none.
    directions : (P, P) array
        Row i: exponents of the parameters in the product that belongs to strength i, of length 1.
    """

    names: tuple[str, ...]
    strengths: Array
    directions: Array

    @property
    def rank(self) -> int:
        """Number of independent products of the parameters that can be identified at all."""
        return int(np.count_nonzero(self.strengths))

    @property
    def information(self) -> Array:
        """(P, P) Fisher information of the logarithms."""
        return np.asarray(self.directions.T @ np.diag(self.strengths**2) @ self.directions)

    def relative_std(self, exponents: Mapping[str, float]) -> float:
        """Standard deviation of the logarithm of a product of powers; inf where the data do not determine it.

        Raises
        ------
        InvalidInput
            A name is none of the parameters.
        """
        for name in exponents:
            if name not in self.names:
                raise InvalidInput(f"parameter {name!r} does not exist: allowed are {', '.join(self.names)}")
        powers = np.array([exponents.get(name, 0.0) for name in self.names])
        along = self.directions @ powers
        if np.any(np.abs(along[self.rank :]) > _ALONG * np.linalg.norm(powers)):
            return math.inf
        return float(np.linalg.norm(along[: self.rank] / self.strengths[: self.rank]))


def identifiability(names: Sequence[str], sensitivities: Array, nuisances: Array, noise: float) -> Identifiability:
    """Decompose the information in the derivatives of a measurement.

    Parameters
    ----------
    names : P of str
    sensitivities : (P, n) array
        Derivatives by the logarithms of the parameters.
    nuisances : (k, n) array
        Derivatives by whatever else is unknown, in any units.
    noise : float
        Standard deviation of white noise on the measurement, in its unit.
    """
    if not (math.isfinite(noise) and noise > 0.0):
        raise InvalidInput(f"noise = {noise!r}: must be finite and greater than 0")
    left = project_out(orthonormal(nuisances), sensitivities)
    longest = float(np.linalg.norm(sensitivities, axis=1).max(initial=0.0))
    directions, strengths, _ = np.linalg.svd(left, full_matrices=False)
    known = np.where(strengths > _SINGULAR * longest, strengths / noise, 0.0)
    return Identifiability(tuple(names), np.pad(known, (0, len(names) - known.size)), _complete(directions.T))


def _complete(rows: Array) -> Array:
    """Orthonormal rows (r, P) and as many more as make a basis."""
    if rows.shape[0] == rows.shape[1]:
        return rows
    return np.vstack([rows, np.linalg.svd(rows)[2][rows.shape[0] :]])


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
class MotorCase:
    """Measured channels, and their information about (J, L, R, k_T, k_B)."""

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
    window: Window, servo: Servo, at: Gap, noise: SensorNoise | None = None, hold: InputHold = InputHold.LINEAR
) -> tuple[MotorCase, ...]:
    """Compute the six cases for the motion in a window.

    Parameters
    ----------
    window : Window
        With theta_m and voltage: the operating point. Each case uses only the channels that it names.
    servo : Servo
    at : Gap
        Gap and first screw angle that the window was made with (rad).
    noise : SensorNoise, optional
    hold : InputHold
        Course of the voltage between samples.

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
        MotorCase("theta_m, voltage unknown", _unknown_input(motor, driven, spread.theta_m)),
        MotorCase("theta_m, loop open (voltage 0)", _coasting(motor, angle, window.sample_rate, spread.theta_m)),
        MotorCase("voltage and theta_m", identifiability(MOTOR, driven, free, spread.theta_m)),
        *_from_position(angle, servo, at, window.sample_rate, (driven, free), spread.position),
    )


def _fitted(theta_m: Array, forced: Array, free: Array) -> Array:
    """The angle that the model itself gives for the voltage, from the initial state that fits best."""
    state = np.linalg.lstsq(free.T, theta_m - forced, rcond=None)[0]
    return np.asarray(forced + state @ free)


def _unknown_input(motor: Sampled, driven: Array, noise: float) -> Identifiability:
    """Case with an unknown voltage: each of its samples is an unknown and cancels a sample of the angle."""
    size = min(_SHORT, driven.shape[1])
    pulses = motor.plain(np.eye(size))
    return identifiability(MOTOR, driven[:, :size], np.vstack([motor.free(size), pulses]), noise)


def _coasting(motor: Sampled, theta_m: Array, rate: float, noise: float) -> Identifiability:
    """Case of a motor that runs out from the window's largest speed, with an unknown initial state."""
    speed = float(np.abs(np.diff(theta_m)).max()) * rate
    runs = motor.respond(np.zeros(theta_m.size), np.array([0.0, speed, 0.0]))[1:]
    return identifiability(MOTOR, runs, motor.free(theta_m.size), noise)


def _from_position(
    theta_m: Array, servo: Servo, at: Gap, rate: float, motor: tuple[Array, Array], noise: float
) -> tuple[MotorCase, ...]:
    """Cases with the position, where gap, first screw angle and initial states are unknown as well."""
    structure, screw = structure_family(servo).select(("pitch",)).sampled(rate), contacts(theta_m, at)
    position = structure.respond(screw[SCREW])
    driven, free = (through_gap(columns, theta_m, at) for columns in motor)
    unknown = np.vstack([structure.plain(np.vstack([free, screw[[BY_GAP, BY_START]]])), structure.free(theta_m.size)])
    skewed = np.vstack([unknown, np.gradient(position[0])])
    shown, names = structure.plain(driven), (*MOTOR, "pitch")
    with_pitch = np.vstack([shown, position[1:]])
    return (
        MotorCase("voltage and position, clocks in step", identifiability(MOTOR, shown, unknown, noise)),
        MotorCase("voltage and position, delay unknown", identifiability(MOTOR, shown, skewed, noise)),
        MotorCase("voltage and position, pitch unknown too", identifiability(names, with_pitch, skewed, noise)),
    )


def table(cases: tuple[MotorCase, ...]) -> str:
    """The relative standard deviations as a Markdown table; a dash where a product is not identifiable at all."""
    head = ["measured", "identifiable", *PRODUCTS]
    lines = [head, ["---"] * len(head)]
    for case in cases:
        cells = [_percent(std) for std in case.stds.values()]
        lines.append([case.measured, f"{case.shows.rank} of {len(case.shows.names)}", *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _percent(std: float) -> str:
    return "-" if math.isinf(std) else "> 100 %" if std > 1.0 else f"{100.0 * std:.2g} %"
