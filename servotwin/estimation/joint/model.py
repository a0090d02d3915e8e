"""The position as a function of the gap and of the model's own numbers, with its exact derivatives.

From the motor's angle, or, where that is not measured, from the voltage: theta_m = G1 u. The screw follows through the
gap, the structure answers, and the whole may come late by a delay. The structure's initial state and the encoder's
offset are linear unknowns, solved for on the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from servotwin.estimation.core.contacts import BY_GAP, BY_RATE, BY_START, SCREW, Gap, contacts, through_gap
from servotwin.estimation.core.counts import between_counts, errors_between, errors_of_counts
from servotwin.estimation.core.family import STRUCTURE, InputHold, Sampled, motor_family, structure_family
from servotwin.estimation.core.least_squares import orthonormal, project_out
from servotwin.estimation.core.motor_angle import noise_of, without_noise
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

Reduce: TypeAlias = Callable[[Array], Array]
MOTOR_START = ("speed0", "current0")  # rad/s and A at the first sample, when only the voltage is known
JUMP = "jump "  # V s: what a jump of the voltage between two samples adds to the area of the line between them
_EDGE = 2  # samples that interpolation needs beyond the shift
_ROUNDING = 1e-9  # of a derivative: a smaller remainder beside the nuisances is rounding
_MOST_JUMPS, _TELLING, _USUAL = 16, 1e-3, 10.0  # jumps; least size of one: of the range, over the usual difference


@dataclass(frozen=True, eq=False)
class JointSlopes:
    """Residual (m,) at a point and its derivatives (P, m) by the parameters, nuisances projected out."""

    residual: Array
    jacobian: Array
    cost: float


@dataclass(frozen=True, eq=False)
class JointModel:
    """Model of a window as a function of named parameters.

    Parameters are "gap" (rad), "place" (-1..1, where in the gap the screw begins), "delay" (s, of the position),
    "gap rate" (rad/s), the logarithms of "k/m", "c/m", "pitch", "k_d" and "k_B" over the servo's, "speed0" and
    "current0".

    Attributes
    ----------
    window : Window
    servo : Servo
    names : tuple of str
    hold : InputHold
        Of the voltage; counts only where theta_m is not measured.
    margin : int
        Samples left out at either end, so that any allowed delay finds its samples.
    jumps : tuple of int
        Samples after which the voltage jumps at a time unknown.
    noise : float
        rad, of an angle that came in counts with more noise than that, and was smoothed; otherwise 0.
    """

    window: Window
    servo: Servo
    names: tuple[str, ...]
    hold: InputHold
    margin: int
    jumps: tuple[int, ...] = ()
    noise: float = 0.0

    @property
    def rate(self) -> float:
        """Sample rate, Hz."""
        return self.window.sample_rate

    @property
    def of_structure(self) -> tuple[str, ...]:
        """The structure's free parameters."""
        return tuple(name for name in STRUCTURE if name in self.names)

    @property
    def measured(self) -> Array:
        """(1, n - 2 margin) position, counted from its first sample."""
        position = self.window.position - self.window.position[0]
        return position[None, self.margin : position.size - self.margin]

    def adapted(self, values: Mapping[str, float]) -> Servo:
        """The servo with the parameters' factors."""
        names = zip(("k", "c", "p", "k_d", "k_B"), (*STRUCTURE, "k_B"), strict=True)
        return self._apart.scaled({name: math.exp(values.get(parameter, 0.0)) for name, parameter in names})

    @cached_property
    def _apart(self) -> Servo:
        """The servo with a number for each mass."""
        return self.servo.replace(k=tuple(self.servo.stiffnesses), c=tuple(self.servo.dampings))

    def motor(self, servo: Servo, values: Mapping[str, float]) -> tuple[Array, dict[str, Array]]:
        """Angle of the motor from its first sample on (n,), and its derivatives by the parameters it depends on."""
        if self.window.theta_m is not None:
            return self.window.theta_m - self.window.theta_m[0], {}
        assert self.window.voltage is not None
        start = np.array([values.get("current0", 0.0), values.get("speed0", 0.0), 0.0])
        family = motor_family(servo).select(("k_B",))
        sampled, kick = family.sampled(self.rate, self.hold), family.sampled(2.0 * self.rate).F[0] @ family.system.B
        angle, by_k_B = sampled.respond(self.window.voltage, start)
        free = sampled.free(angle.size)
        by = {"k_B": by_k_B, "current0": free[0], "speed0": free[1]}
        for index in self.jumps:
            name = f"{JUMP}{index}"
            by[name] = np.zeros(angle.size)
            by[name][index + 1 :] = kick @ free[:, : angle.size - index - 1]
            angle = angle + values.get(name, 0.0) * by[name]
        return angle, by

    def screw(self, values: Mapping[str, float]) -> tuple[Servo, Array, Gap]:
        """The adapted servo, the motor's angle and the gap that the screw follows it through."""
        servo = self.adapted(values)
        theta_m, _ = self.motor(servo, values)
        return servo, theta_m, self.gap_at(theta_m, values)

    def gap_at(self, theta_m: Array, values: Mapping[str, float]) -> Gap:
        """Arguments of the play operator."""
        gap = values["gap"]
        return Gap(gap, float(theta_m[0]) + 0.5 * gap * values["place"], values.get("gap rate", 0.0) / self.rate)

    def cost(self, values: Mapping[str, float], reduce: Reduce) -> float:
        """Squared length of the residual, nuisances projected out."""
        return self.costs(values, [values], reduce)[0]

    def costs(self, values: Mapping[str, float], gaps: Sequence[Mapping[str, float]], reduce: Reduce) -> list[float]:
        """The same at points that differ from `values` in "gap", "place" and "gap rate" alone."""
        servo = self.adapted(values)
        theta_m, _ = self.motor(servo, values)
        structure = structure_family(servo).select(()).sampled(self.rate)
        shift = values.get("delay", 0.0) * self.rate
        basis = orthonormal(reduce(self.nuisances(structure, shift)))
        result = []
        for one in gaps:
            forced = structure.plain(contacts(theta_m, self.gap_at(theta_m, one))[:1])
            remainder = project_out(basis, reduce(self.measured - self.delayed(forced, shift)))[0]
            result.append(float(remainder @ remainder))
        return result

    def slopes(self, values: Mapping[str, float], reduce: Reduce) -> JointSlopes:
        """Residual and derivatives; those of the nuisances by the parameters are included."""
        table = self.table(values, reduce)
        split = table.shape[0] - len(self.names)
        basis, moved = orthonormal(table[1:split]), table[split:]
        remainder = project_out(basis, np.vstack([table[:1], -moved]))
        remainder[1:][np.linalg.norm(remainder[1:], axis=1) <= _ROUNDING * np.linalg.norm(moved, axis=1)] = 0.0
        return JointSlopes(remainder[0], remainder[1:], float(remainder[0] @ remainder[0]))

    def table(self, values: Mapping[str, float], reduce: Reduce) -> Array:
        """(1 + N + 1 + P, m) measured less forced position, nuisances, derivatives of the position by `names`."""
        servo = self.adapted(values)
        theta_m, by_motor = self.motor(servo, values)
        at = self.gap_at(theta_m, values)
        screw = contacts(theta_m, at)
        structure = structure_family(servo).select(self.of_structure).sampled(self.rate)
        shift = values.get("delay", 0.0) * self.rate
        forced = self.delayed(structure.plain(screw[:1]), shift)
        rows = reduce(np.vstack([self.measured - forced, self.nuisances(structure, shift)]))
        weights = np.linalg.lstsq(rows[1:].T, rows[0], rcond=None)[0]
        tangents = self._tangents(screw, theta_m, at, by_motor, values)
        derivatives = self._derivatives(structure, screw, weights[:-1], tangents)
        return np.vstack([rows, reduce(np.array([self._row(derivatives[name], name, shift) for name in self.names]))])

    def _tangents(
        self, screw: Array, theta_m: Array, at: Gap, by_motor: Mapping[str, Array], values: Mapping[str, float]
    ) -> dict[str, Array]:
        """(n,) derivatives of the screw's angle by the parameters that move it."""
        moved = {
            "gap": screw[BY_GAP] + 0.5 * values["place"] * screw[BY_START],
            "place": 0.5 * values["gap"] * screw[BY_START],
            "gap rate": screw[BY_RATE] / self.rate,
        }
        if by_motor:
            passed = through_gap(np.array(list(by_motor.values())), theta_m, at)
            moved.update(zip(by_motor, passed, strict=True))
        return {name: row for name, row in moved.items() if name in self.names}

    def _derivatives(
        self, structure: Sampled, screw: Array, initial: Array, tangents: Mapping[str, Array]
    ) -> dict[str, Array]:
        """(n,) derivatives of the position at the full rate; "delay" holds the position itself."""
        whole = structure.respond(screw[SCREW], initial)
        moved = structure.plain(np.array(list(tangents.values())))
        return {
            **dict(zip(("delay", *self.of_structure), whole, strict=True)),
            **dict(zip(tangents, moved, strict=True)),
        }

    def shaken(self, random: np.random.Generator) -> JointModel:
        """The model of a window that has other errors of the encoders' rounding as well, equally likely."""
        window, servo = self.window, self.servo
        channels = {}
        if servo.encoder_resolution > 0.0 and window.theta_m is not None:
            channels["theta_m"] = self._other_angle(window.theta_m, random)
        if servo.position_resolution > 0.0:
            channels["position"] = window.position + errors_of_counts(
                window.position, servo.position_resolution, random
            )
        return replace(self, window=window.replace(**channels))

    def _other_angle(self, angle: Array, random: np.random.Generator) -> Array:
        """(n,) angle with other errors, as large as it has already."""
        count = self.servo.encoder_resolution
        if self.noise == 0.0:
            return angle + errors_between(angle, count, random)
        return without_noise(angle + self.noise * random.standard_normal(angle.size), count).angle

    def _row(self, row: Array, name: str, shift: float) -> Array:
        if name != "delay":
            return self.delayed(row[None], shift)[0]
        return -self.rate * self.delayed(row[None], shift, slope=True)[0]

    def nuisances(self, structure: Sampled, shift: float) -> Array:
        """(N + 1, n - 2 margin) free motions of the structure and the encoder's offset."""
        free = self.delayed(structure.free(self.window.position.size), shift)
        return np.vstack([free, self.servo.p * np.ones(free.shape[1])])

    def delayed(self, rows: Array, shift: float, slope: bool = False) -> Array:
        """(k, n - 2 margin) of rows (k, n): `shift` samples later, by cubics; or their slopes per sample."""
        whole = math.floor(-shift)
        weights = cubic_slopes(-shift - whole) if slope else cubic(-shift - whole)
        first, size = self.margin + whole - 1, rows.shape[1] - 2 * self.margin
        return sum(
            (weight * rows[:, first + j : first + j + size] for j, weight in enumerate(weights)),
            start=np.zeros((len(rows), size)),
        )


def between_its_counts(model: JointModel) -> JointModel:
    """The model of a window whose angle, which comes in counts, has no staircase, and no noise beyond the counts."""
    angle, count = model.window.theta_m, model.servo.encoder_resolution
    assert angle is not None
    quiet = without_noise(angle, count).angle
    if quiet is not angle:
        return replace(model, window=model.window.replace(theta_m=quiet), noise=noise_of(angle))
    return replace(model, window=model.window.replace(theta_m=between_counts(angle, count)))


def jumps(voltage: Array) -> tuple[int, ...]:
    """Samples after which a voltage (n,) jumps: at the edges of a dead zone, or at a step of the reference.

    A jump is a difference that stands out from those before and after it, by much of the range and of what is usual.
    """
    change = np.diff(voltage)
    usual = 0.5 * (np.abs(change[:-2]) + np.abs(change[2:]))
    excess = np.abs(change[1:-1]) - 2.0 * np.maximum(np.abs(change[:-2]), np.abs(change[2:]))
    telling = excess > max(_TELLING * float(np.ptp(voltage)), _USUAL * float(np.median(usual)))
    candidates = np.flatnonzero(telling)
    largest = candidates[np.argsort(-excess[candidates], kind="stable")[:_MOST_JUMPS]]
    return tuple(int(i) + 1 for i in np.sort(largest))


def margin_for(limit: float, rate: float) -> int:
    """Samples to leave out at either end for delays of up to `limit` (s) at `rate` (Hz)."""
    return math.ceil(limit * rate - 1e-9) + _EDGE


def cubic(x: float) -> tuple[float, float, float, float]:
    """Weights of the samples at -1, 0, 1, 2 for the value at x (0..1) of the cubic through them."""
    return (
        -x * (x - 1.0) * (x - 2.0) / 6.0,
        (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0,
        -(x + 1.0) * x * (x - 2.0) / 2.0,
        (x + 1.0) * x * (x - 1.0) / 6.0,
    )


def cubic_slopes(x: float) -> tuple[float, float, float, float]:
    """The same for the slope, per sample."""
    return (
        -(3.0 * x * x - 6.0 * x + 2.0) / 6.0,
        (3.0 * x * x - 4.0 * x - 1.0) / 2.0,
        -(3.0 * x * x - 2.0 * x - 2.0) / 2.0,
        (3.0 * x * x - 1.0) / 6.0,
    )
