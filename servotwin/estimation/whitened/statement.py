"""The estimate that a judged fit states: gap, spreads and interval."""

from __future__ import annotations

import math
from dataclasses import replace

from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus, Interval, interval_95
from servotwin.estimation.whitened.gate import FitEvidence, lower_bound
from servotwin.estimation.whitened.settings import WhitenedSettings


def stated(
    blank: GapEstimate,
    evidence: FitEvidence,
    status: GapStatus,
    reasons: tuple[str, ...],
    prior: float | GapEstimate | None,
    settings: WhitenedSettings,
) -> GapEstimate:
    """Fill a blank estimate from the evidence."""
    fitted = evidence.aligned.whitened
    result = replace(
        blank,
        status=status,
        reasons=reasons,
        rms=fitted.residual_rms,
        evaluations=fitted.evaluations,
    )
    if status is GapStatus.LOWER_BOUND:
        bound = lower_bound(evidence, settings)
        return replace(result, gap=bound, std=math.inf, std_total=math.inf, interval=(bound, math.inf))
    if status is not GapStatus.OK:
        return result
    first = evidence.aligned.first + 0.5 * fitted.point.gap * fitted.point.place
    total, interval = _widened(evidence, settings)
    result = replace(result, gap=fitted.point.gap, std=evidence.std, std_total=total, theta_d0=first, interval=interval)
    return _combined(result, prior) if settings.combine and isinstance(prior, GapEstimate) else result


def _widened(evidence: FitEvidence, settings: WhitenedSettings) -> tuple[float, Interval]:
    """Standard deviation (rad) and interval of the gap with errors outside the model and the doubt in it.

    Beside a machine that is being learnt the doubt is one more random part. The doubt in a model that is taken as exact
    contains that model's own error, the same in all windows: it adds as it is.
    """
    gap, (low, high) = evidence.aligned.whitened.point.gap, evidence.interval
    random = math.hypot(settings.model_error, evidence.doubt if evidence.learnt else 0.0)
    added = 0.0 if evidence.learnt else evidence.doubt
    below, above = (math.hypot(part, NORMAL_95 * random) + NORMAL_95 * added for part in (gap - low, high - gap))
    return math.hypot(evidence.std, random) + added, (max(0.0, gap - below), gap + above)


def _combined(estimate: GapEstimate, prior: GapEstimate) -> GapEstimate:
    """Average two estimates, weighted by their total variances."""
    if not (math.isfinite(prior.gap) and math.isfinite(prior.std_total) and prior.std_total > 0.0):
        return estimate
    share = estimate.std_total**2 / (estimate.std_total**2 + prior.std_total**2)
    gap = estimate.gap + share * (prior.gap - estimate.gap)
    total = math.sqrt(1.0 - share) * estimate.std_total
    std = math.hypot((1.0 - share) * estimate.std, share * prior.std)
    return replace(estimate, gap=gap, std=std, std_total=total, interval=interval_95(gap, total))
