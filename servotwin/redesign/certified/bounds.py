"""Bounds of a share from a sample."""

from __future__ import annotations

from servotwin.errors import InvalidInput


def share_at_least(successes: int, trials: int, confidence: float) -> float:
    """Lower bound of a share (Clopper-Pearson): with that confidence at least so much of all succeeds.

    Parameters
    ----------
    successes, trials : int
        Of independent trials.
    confidence : float
        Within 0 .. 1.

    Raises
    ------
    InvalidInput
        The numbers are no sample.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise InvalidInput(f"{successes} successes in {trials} trials: must be 0 to all of at least 1")
    if successes == 0:
        return 0.0
    from scipy.special import betaincinv

    # The quantile of a beta distribution; without a failure it is (1 - confidence)^(1 / trials).
    return float(betaincinv(successes, trials - successes + 1, 1.0 - confidence))
