"""How well a least-squares fit of two parameters knows the first."""

from __future__ import annotations

import math

from scipy.signal import correlate

from servotwin.plant.signals import Array

_SINGULAR = 1e-7  # of the column's length: what is left of it below this is rounding of the differences


def standard_deviation(sensitivity: Array, nuisance: Array, residual: Array) -> float:
    """Standard deviation of a parameter from the Gauss-Newton information; inf where the window says nothing of it.

    The Schur complement of the information matrix is the squared length of what is left of the parameter's sensitivity
    when its projection on the other's is taken off: never a pseudo-inverse, which would call an unidentifiable
    parameter certain.

    The residual is taken as it is correlated. The variance of its product with what is left is the sum over all lags
    of both their autocovariances, which is the mean square of that product over all shifts of one against the other.

    Parameters
    ----------
    sensitivity, nuisance : (n,) arrays
        Derivatives of the residual by the parameter and by the other one; zeros when it has no effect.
    residual : (n,) array
    """
    square = float(nuisance @ nuisance)
    left = sensitivity - nuisance * (float(nuisance @ sensitivity) / square) if square > 0.0 else sensitivity
    information = float(left @ left)
    if math.sqrt(information) <= _SINGULAR * math.sqrt(float(sensitivity @ sensitivity)):
        return math.inf
    shifted = correlate(residual, left, method="fft")
    return math.sqrt(float(shifted @ shifted) / residual.size) / information
