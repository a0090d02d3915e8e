"""Decimated response of the structure, straight from the screw's angle at the full rate.

The modes run once per reduced sample, not once per angle. Decimation and response are linear, so that a reduced sample
is a weighted sum of the angles under it, and of the modes at the begin of these. In between, a mode decays by a known
factor and takes up another weighted sum of angles. The sums of all samples are formed side by side, where a recurrence
at the full rate waits for its own result at every angle. The free motions are geometric series before and after.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from servotwin.estimation.core.decimation import AVERAGES, Decimation
from servotwin.estimation.core.response import Readout, Response, add_motions, free_motions
from servotwin.hybrid.compiled import bare, inlined
from servotwin.plant.linear import Complex
from servotwin.plant.signals import Array


@dataclass(frozen=True, eq=False)
class BlockWeights:
    """Weights that make reduced samples of blocks of angles, `factor` angles to a block.

    Attributes
    ----------
    angles : (4 + 2 modes, factor) array
        Weights of a block's angles: four sums for the outputs that the block is under, as their first to last block;
        then, for each mode, real and imaginary part of what it takes up.
    decay : (modes, 2) array
        Of a mode over a block, real and imaginary part.
    gain : (modes, 2) array
        Share of a mode at the begin of an output's four blocks.
    """

    angles: Array
    decay: Array
    gain: Array

    @classmethod
    def of(cls, decay: Array, readout: Readout, reduce: Decimation) -> BlockWeights:
        """Compute the weights for modes with a `decay` (modes, 2) per angle; the decimation's factor is above 1."""
        modes, factor = len(decay), reduce.factor
        angles, slow, gain = np.empty((AVERAGES + 2 * modes, factor)), np.empty((modes, 2)), np.empty((modes, 2))
        echo = np.zeros(AVERAGES * factor)
        weigh(decay, readout.gain, readout.direct, reduce.taps, echo, angles, slow, gain)
        return cls(angles, slow, gain)


@dataclass(frozen=True, eq=False)
class ReducedResponse:
    """A response followed by a decimation: equal to one after the other but for rounding.

    Attributes
    ----------
    response : Response
    decimation : Decimation
    """

    response: Response
    decimation: Decimation

    @cached_property
    def position(self) -> BlockWeights | None:
        """Weights of the positions; None: the decimation's factor is 1."""
        return self._weights(self.response.position)

    @cached_property
    def velocity(self) -> BlockWeights | None:
        """Weights of the velocities; None: the decimation's factor is 1."""
        return self._weights(self.response.velocity)

    def _weights(self, readout: Readout) -> BlockWeights | None:
        if self.decimation.factor == 1:
            return None
        return BlockWeights.of(self.response.decay, readout, self.decimation)

    def respond(self, inputs: Array) -> Array:
        """(k, m) reduced positions (m) for angles (k, n) (rad) at the full rate; see `Response.respond`."""
        return self.response.respond(inputs) if self.position is None else _run(inputs, self.position)

    def velocities(self, inputs: Array) -> Array:
        """(k, m) reduced velocities (m/s) for angles (k, n) (rad) at the full rate; see `Response.velocities`."""
        return self.response.velocities(inputs) if self.velocity is None else _run(inputs, self.velocity)

    def free(self, samples: int) -> Array:
        """(2 modes, m) reduced free motions over `samples` angles; see `Response.free`."""
        exponents, factor = self.response.poles * self.response.interval, self.decimation.factor
        return free_motions(factor * exponents, _averages(exponents, factor), _reduced_size(samples, factor))


def summed_motions(exponents: Complex, shares: Complex, reduce: Decimation, samples: int) -> Array:
    """(s, m) reduced free motions of some structures (s, modes) over `samples` angles, summed with the modes' shares
    (modes,)."""
    count = _reduced_size(samples, reduce.factor)
    out, near = np.zeros((len(exponents), count)), np.empty(max(1, math.isqrt(count)), complex)
    add_motions(reduce.factor * exponents, shares * _averages(exponents, reduce.factor), near, out)
    return out


def _reduced_size(samples: int, factor: int) -> int:
    """Samples that are left of `samples`."""
    return samples if factor == 1 else samples // factor - AVERAGES + 1


def _averages(exponents: Complex, factor: int) -> Complex:
    """Weighted sums of exp(exponent i) under the taps of a decimation: `AVERAGES` means, one after another."""
    if factor == 1:
        return np.ones_like(exponents)
    return np.asarray((np.expm1(factor * exponents) / (factor * np.expm1(exponents))) ** AVERAGES)


def respond_each(models: Sequence[ReducedResponse], angles: Array) -> Array:
    """(s, m) reduced positions (m) of structures with as many modes, and one decimation, for angles (1, n)."""
    weights = [one for one in (model.position for model in models) if one is not None]
    return _run_each(angles, weights)[:, 0] if weights else np.vstack([model.respond(angles) for model in models])


@lru_cache(maxsize=64)
def reduced_response(model: Response, reduce: Decimation) -> ReducedResponse:
    """Return the `ReducedResponse` of the two, made once."""
    return ReducedResponse(model, reduce)


def _run(inputs: Array, weights: BlockWeights) -> Array:
    return _run_each(inputs, [weights])[0]


def _run_each(inputs: Array, structures: Sequence[BlockWeights]) -> Array:
    """(s, k, m) answers of structures with the same number of modes."""
    sums, factor = structures[0].angles.shape
    blocks = inputs.shape[1] // factor
    out = np.empty((len(structures), len(inputs), blocks - AVERAGES + 1))
    inputs = np.ascontiguousarray(inputs)  # as `evaluate` calls it: another order is compiled anew
    room = np.empty((factor, blocks)), np.empty((sums, blocks))
    for weights, answers in zip(structures, out, strict=True):
        run_blocks(inputs, *_arrays(weights), *room, answers)
    return out


def _arrays(weights: BlockWeights) -> tuple[Array, Array, Array]:
    return weights.angles, weights.decay, weights.gain


@bare
def weigh(
    decay: Array, gain: Array, direct: float, taps: Array, echo: Array, angles: Array, slow: Array, share: Array
) -> None:
    """`BlockWeights.of` into `angles`, `slow` and `share`; `echo` (4 factor,) is zero, room for the impulse response.

    The echo of an angle begins one sample later and lasts; an output contains it with the taps that lie under it.
    """
    factor = angles.shape[1]
    for mode in range(len(decay)):
        power_r, power_i = 1.0, 0.0
        share[mode, 0] = share[mode, 1] = 0.0
        for j in range(taps.size):
            shown_r = gain[mode, 0] * power_r - gain[mode, 1] * power_i
            shown_i = gain[mode, 0] * power_i + gain[mode, 1] * power_r
            echo[j] += shown_r
            share[mode, 0] += taps[j] * shown_r
            share[mode, 1] += taps[j] * shown_i
            if j < factor:
                angles[4 + 2 * mode, factor - 1 - j] = power_r
                angles[5 + 2 * mode, factor - 1 - j] = power_i
            power_r, power_i = (
                decay[mode, 0] * power_r - decay[mode, 1] * power_i,
                decay[mode, 1] * power_r + decay[mode, 0] * power_i,
            )
            if j == factor - 1:
                slow[mode, 0], slow[mode, 1] = power_r, power_i
    for j in range(taps.size):
        weight = direct * taps[j]
        for later in range(j + 1, taps.size):
            weight += taps[later] * echo[later - j - 1]
        angles[j // factor, j % factor] = weight


@inlined
def add_rows(weights: Array, j: int, one: Array, two: Array, three: Array, four: Array, out: Array) -> None:
    """Add to `out` (n,) the sum of four rows (n,), weighted by four of the weights from the j-th on."""
    a, b, c, d = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
    for i in range(out.size):
        out[i] += (a * one[i] + b * two[i]) + (c * three[i] + d * four[i])


@inlined
def add_modes(decay: Array, gain: Array, one: int, two: int, share: float, sums: Array, out: Array) -> None:
    """Add the output of mode `one`, and `share` times that of mode `two`: one waits for its own products."""
    ar, ai, br, bi = decay[one, 0], decay[one, 1], decay[two, 0], decay[two, 1]
    pr, pi, qr, qi = gain[one, 0], gain[one, 1], share * gain[two, 0], share * gain[two, 1]
    ur, ui, vr, vi = sums[4 + 2 * one], sums[5 + 2 * one], sums[4 + 2 * two], sums[5 + 2 * two]
    xr = xi = yr = yi = 0.0
    for i in range(out.size):
        out[i] += (pr * xr - pi * xi) + (qr * yr - qi * yi)
        xr, xi = ar * xr - ai * xi + ur[i], ai * xr + ar * xi + ui[i]
        yr, yi = br * yr - bi * yi + vr[i], bi * yr + br * yi + vi[i]


@bare
def run_blocks(inputs: Array, angles: Array, decay: Array, gain: Array, table: Array, sums: Array, out: Array) -> None:
    """`ReducedResponse.respond` into `out` (k, m), with room for the blocks side by side and for their weighted sums.

    Parameters
    ----------
    inputs : (k, n) array
    angles, decay, gain : arrays
        As of `BlockWeights`.
    table : (factor, blocks) array
    sums : (4 + 2 modes, blocks) array
    out : (k, blocks - 3) array
    """
    factor, blocks = table.shape
    modes = len(decay)
    for k in range(len(inputs)):
        for block in range(blocks):
            for j in range(factor):
                table[j, block] = inputs[k, block * factor + j]
        for w in range(len(angles)):
            row = sums[w]
            # Both at once, added in the order of the loops below: the paper's structure at 1 kHz.
            if factor == 2:
                for i in range(blocks):
                    row[i] = angles[w, 1] * table[1, i] + angles[w, 0] * table[0, i]
                continue
            for i in range(blocks):
                row[i] = 0.0
            for j in range(0, factor - 3, 4):
                add_rows(angles[w], j, table[j], table[j + 1], table[j + 2], table[j + 3], row)
            for j in range(factor // 4 * 4, factor):
                for i in range(blocks):
                    row[i] += angles[w, j] * table[j, i]
        answer = out[k]
        for i in range(answer.size):
            answer[i] = (sums[0, i] + sums[1, i + 1]) + (sums[2, i + 2] + sums[3, i + 3])
        for first in range(0, modes - 1, 2):
            add_modes(decay, gain, first, first + 1, 1.0, sums, answer)
        if modes % 2 == 1:
            add_modes(decay, gain, modes - 1, modes - 1, 0.0, sums, answer)
