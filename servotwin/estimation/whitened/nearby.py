"""A machine's reduced response, and the motions by which the position changes with each of the machine's numbers.

The motions are difference quotients of the exact responses, that of the free motion included: without its change, a
window that begins in motion would show derivatives of the wrong size and sign.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.core.decimation import Decimation
from servotwin.estimation.core.reduced import ReducedResponse, reduced_response, respond_each, summed_motions
from servotwin.estimation.core.response import Readout, Response
from servotwin.estimation.core.variants import variants
from servotwin.plant.linear import Complex
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

Indices: TypeAlias = NDArray[np.intp]

PITCH, RATIO = 2, 3  # of the factors
STEP = 1e-4  # of a factor's logarithm: difference quotients of the response
SOFT = 1e-2  # structure's stiffness over the screw's: far enough for the motion to be linear in the compliance


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A response with one number a step away.

    Attributes
    ----------
    reduced : ReducedResponse
    poles : (modes,) complex array
        1/s, each next to that of the machine: a screw that becomes soft has one more.
    step : float
        Of the number.
    row : int
        Index of the number.
    """

    reduced: ReducedResponse
    poles: Complex
    step: float
    row: int

    @classmethod
    def of(cls, model: ReducedResponse, other: Response, step: float, row: int) -> Neighbour:
        """Join another response to that of a machine."""
        mine, theirs = model.response.poles, other.poles
        if theirs.size != mine.size:
            other = with_modes_at_rest(other, np.argmin(np.abs(theirs[None, :] - mine[:, None]), axis=1))
        return cls(ReducedResponse(other, model.decimation), other.poles, step, row)


def own_softness(servo: Servo) -> float:
    """A servo's stiffness of the structure over that of its screw; 0: the screw is rigid."""
    return 0.0 if servo.rigid else float(servo.stiffnesses.max()) / servo.k_d


def with_modes_at_rest(model: Response, modes: Indices) -> Response:
    """Return a response with some of its modes only; the others have always come to rest.

    A soft screw lets the first mass ring. How fast, depends on how soft it is: a difference quotient with this ringing
    is no derivative, and a window seems to contradict any compliance that rings at another pitch.
    """
    decay, gain = model.decay[modes], model.position.gain[modes]
    still = np.sum((gain[:, 0] + 1j * gain[:, 1]) / (1.0 - decay[:, 0] - 1j * decay[:, 1])).real
    return replace(
        model,
        poles=model.poles[modes],
        decay=decay,
        position=Readout(gain, model.static_gain - float(still)),
        velocity=Readout(model.velocity.gain[modes], model.velocity.direct),
    )


def motions(model: ReducedResponse, others: Sequence[Neighbour], screw: Array, answer: Array, weights: Array) -> Array:
    """(others, m) changes of the fitted position per step to each neighbour.

    Parameters
    ----------
    model : ReducedResponse
    others : sequence of Neighbour
    screw : (1, n) array
        rad, the fitted screw.
    answer : (m,) array
        The model's response to it.
    weights : (2 modes,) array
        Fitted shares of the free motions.
    """
    modes = model.response.poles.size
    shares = weights[:modes].astype(complex)
    shares[np.abs(model.response.poles.imag) > 0.0] -= 1j * weights[modes:]
    poles: Complex = np.array([model.response.poles, *(other.poles for other in others)])
    changes = summed_motions(poles * model.response.interval, shares, model.decimation, screw.shape[1])
    moved = respond_each([other.reduced for other in others], screw) - answer + changes[1:] - changes[0]
    return np.asarray(moved / np.array([[other.step] for other in others]))


@dataclass(frozen=True, eq=False)
class Nearby:
    """A machine with its neighbours in the factors, and in the screw's compliance if that is free.

    Attributes
    ----------
    model : ReducedResponse
    others : tuple of Neighbour
        The compliance last; none for the pitch, with which only the size of the response changes, nor for the mass
        ratio of two masses.
    count : int
        Numbers that are free.
    """

    model: ReducedResponse
    others: tuple[Neighbour, ...]
    count: int

    def motions(self, screw: Array, answer: Array, weights: Array) -> Array:
        """(count, m) derivatives of the fitted position; arguments as of `motions`."""
        out = np.zeros((self.count, answer.size))
        out[[other.row for other in self.others]] = motions(self.model, self.others, screw, answer, weights)
        out[PITCH] = math.expm1(STEP) / STEP * answer
        return out


@lru_cache(maxsize=64)
def nearby(servo: Servo, factors: tuple[float, ...], rate: float, reduce: Decimation, soft: bool) -> Nearby:
    """Responses around a servo with other logarithms of its factors, at a sample rate (Hz), decimated."""
    here = np.array(factors)
    if soft:
        stiff = nearby(servo, factors, rate, reduce, False)  # by place, as others call it: a name makes another key
        stiffness = math.exp(here[0]) * float(servo.stiffnesses.max())
        compliance = SOFT + own_softness(servo) * math.exp(here[0])
        softened = variants(servo, [here], rate, [stiffness / compliance])[0]
        softer = Neighbour.of(stiff.model, softened, SOFT, here.size)
        return Nearby(stiff.model, (*stiff.others, softer), here.size + 1)
    moved = [row for row in range(here.size) if row != PITCH and (row != RATIO or servo.n > 2)]
    first, *others = variants(servo, [here, *(here + STEP * np.eye(here.size)[row] for row in moved)], rate)
    model = reduced_response(first, reduce)
    neighbours = [Neighbour.of(model, other, STEP, row) for other, row in zip(others, moved, strict=True)]
    return Nearby(model, tuple(neighbours), here.size)
