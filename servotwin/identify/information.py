"""How well a least-squares fit knows its first parameter."""

from __future__ import annotations

import math

import numpy as np

from servotwin.plant.signals import Array

_SINGULAR = 1e-7  # of the column's length: what is left of it below this is rounding of the differences


def standard_deviation(sensitivities: Array, residual: Array) -> float:
    """Standard deviation of the first parameter from the Gauss-Newton information; inf where it has none.

    The Schur complement of the information matrix is the squared length of what is left of the parameter's column of
    sensitivities when its projection on the others' is taken off: never a pseudo-inverse, which would call an
    unidentifiable parameter certain.

    The residuals are taken as they are correlated: the variance is the sum of the autocovariances of what each sample
    contributes to the estimate, up to where that sum stops growing.

    Parameters
    ----------
    sensitivities : (n, m) array
        Derivatives of the residual; columns of zeros are parameters without effect.
    residual : (n,) array
    """
    column, others = sensitivities[:, 0], sensitivities[:, 1:]
    nuisance = np.linalg.lstsq(others, column, rcond=_SINGULAR)[0]
    left = column - others @ nuisance
    information = float(left @ left)
    if math.sqrt(information) <= _SINGULAR * float(np.linalg.norm(column)):
        return math.inf
    freedom = residual.size / max(1, residual.size - sensitivities.shape[1])
    return math.sqrt(freedom * _long_run_variance(left * residual)) / information


def _long_run_variance(scores: Array) -> float:
    """Variance of the sum of `scores` (n,): its autocovariances summed until a pair of them is not positive (Geyer)."""
    size = 1 << (2 * scores.size - 1).bit_length()
    spectrum = np.fft.rfft(scores - scores.mean(), size)
    covariances = np.fft.irfft(spectrum * spectrum.conj(), size)[: scores.size]
    pairs = covariances[: scores.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    last = int(np.argmax(pairs <= 0.0)) if np.any(pairs <= 0.0) else pairs.size
    return float(max(covariances[0], 2.0 * pairs[:last].sum() - covariances[0]))
