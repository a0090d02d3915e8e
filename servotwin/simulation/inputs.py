"""Inputs of a run as piecewise cubics, and changes of them while it runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic


@dataclass
class RunInputs:
    """Inputs of a run as piecewise cubics, its sample rate (Hz), and constant disturbances of the plant: input bias (V,
    behind the controller) and friction (N m, on the motor's shaft)."""

    reference: PiecewiseCubic
    gap: PiecewiseCubic
    tolerance: PiecewiseCubic | None
    sample_rate: float
    input_bias: float = 0.0
    friction: float = 0.0

    def constants(self, servo: Plant) -> dict[str, float]:
        """States of a plant's automaton that are constants, by name: disturbances and the plant's own forces."""
        forces = plant_forces(servo)
        return {**forces, "input bias": self.input_bias, "friction": self.friction + forces["friction"]}

    def times(self, first: int, last: int) -> Array:
        """Times of samples first .. last - 1, s."""
        return np.arange(first, last) / self.sample_rate

    def retune(self, time: float, tolerance: float) -> None:
        """Make the tolerance a constant (m) from `time` (s) on."""
        assert self.tolerance is not None
        keep = self.tolerance.times < time
        times, coeffs = self.tolerance.times[keep], self.tolerance.coeffs[keep]
        self.tolerance = PiecewiseCubic(np.append(times, time), np.vstack([coeffs, [[tolerance, 0.0, 0.0, 0.0]]]))

    def jumps(self, until: float) -> list[tuple[float, str]]:
        """Times and kinds (reference, parameter) of the inputs' jumps in (0, until]."""
        jumps = [(float(t), "reference") for t in self.reference.jumps]
        jumps += [(float(t), "parameter") for t in self.gap.jumps]
        jumps += [(float(t), "parameter") for t in self.tolerance.jumps] if self.tolerance is not None else []
        return sorted((time, kind) for time, kind in jumps if 0.0 < time <= until)


def plant_forces(servo: Plant) -> dict[str, float]:
    """States of a plant's automaton that are constant forces of the plant, by name."""
    guide, shaft = servo.guide, servo.motor_stribeck
    return {
        "friction": servo.motor_friction,
        "friction drop": shaft.drop,
        "friction stribeck": shaft.speed,
        "load force": guide.force,
        "load friction": guide.friction,
        "load friction drop": guide.stribeck.drop,
        "load friction stribeck": guide.stribeck.speed,
        "drive limit": servo.command_limit or 0.0,
    }


def with_forces(constants: dict[str, Array], plants: Sequence[Plant]) -> dict[str, Array]:
    """Constants of members, with the plants' own forces beside or among them."""
    # Thousands of members share a few plants.
    forces = {key: plant_forces(plant) for key, plant in {id(each): each for each in plants}.items()}
    if not any(any(each.values()) for each in forces.values()):
        return constants
    own = {name: np.array([forces[id(plant)][name] for plant in plants]) for name in plant_forces(plants[0])}
    friction = constants["friction"] + own.pop("friction")
    return {**constants, "friction": friction, **{name.replace(" ", "_"): values for name, values in own.items()}}


def quantised(values: Array, resolution: float) -> Array:
    """Round to whole counts; resolution 0 is an ideal sensor."""
    return values if resolution == 0.0 else np.round(values / resolution) * resolution


def about(pieces: PiecewiseCubic, time: float) -> Array:
    """(4,) ascending coefficients, about a time (s), of the piece in force there."""
    piece = max(int(np.searchsorted(pieces.times, time, side="right")) - 1, 0)
    shift, c = time - pieces.times[piece], pieces.coeffs[piece]
    return np.array(
        [
            ((c[3] * shift + c[2]) * shift + c[1]) * shift + c[0],
            (3.0 * c[3] * shift + 2.0 * c[2]) * shift + c[1],
            3.0 * c[3] * shift + c[2],
            c[3],
        ]
    )


def spliced(before: PiecewiseCubic, after: PiecewiseCubic, time: float) -> PiecewiseCubic:
    """Join `before` up to a time (s) and `after` from then on."""
    past, future = before.times < time, after.times > time
    times = np.concatenate([before.times[past], [time], after.times[future]])
    return PiecewiseCubic(times, np.vstack([before.coeffs[past], about(after, time), after.coeffs[future]]))


def recent(pieces: PiecewiseCubic, time: float) -> PiecewiseCubic:
    """Drop the pieces before a time (s); one constant stands for them."""
    first = int(np.searchsorted(pieces.times, time, side="right")) - 1
    if first <= 0:
        return pieces
    past = [[pieces.coeffs[first, 0], 0.0, 0.0, 0.0]]
    return PiecewiseCubic(np.append(0.0, pieces.times[first:]), np.vstack([past, pieces.coeffs[first:]]))


def raised(pieces: PiecewiseCubic, offset: float) -> PiecewiseCubic:
    """Add a constant to a signal."""
    return PiecewiseCubic(pieces.times, pieces.coeffs + np.array([offset, 0.0, 0.0, 0.0]))


def whole_ratio(tick_rate: float, sample_rate: float) -> int | None:
    """The higher rate over the lower one, if that is a whole number."""
    ratio = max(tick_rate, sample_rate) / min(tick_rate, sample_rate)
    return round(ratio) if abs(ratio - round(ratio)) <= 1e-9 * ratio else None


def steps_of(tick_rate: float, sample_rate: float) -> tuple[int, int]:
    """Base steps per tick and per sample; one of them is 1."""
    whole = whole_ratio(tick_rate, sample_rate)
    if whole is None:
        raise InvalidInput(
            f"controller sample_rate = {tick_rate} Hz and sample_rate = {sample_rate} Hz: "
            "one must be a whole multiple of the other"
        )
    return (1, whole) if tick_rate >= sample_rate else (whole, 1)
