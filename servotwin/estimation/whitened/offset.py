"""Read the encoder's offset from a window, and the gap from a window with one contact once the offset is known.

The offset is position / static gain less the screw's angle: what the encoder would have to be shifted by for both to
agree at rest. It is a constant in the residual, so it costs nothing to read once the gap is known; with the offset from
earlier windows, a later one shows the gap with one contact only. The offset is constant as long as the gap opens to
both sides alike; `TrendSettings.offset_walk_rad_per_sqrt_s` is for wear on one flank.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import BY_GAP, BY_START, SCREW, Gap, polygon
from servotwin.estimation.core.least_squares import least_squares
from servotwin.estimation.core.response import response
from servotwin.estimation.estimate import CarriedOffset, GapEstimate, GapStatus, LastContact, OffsetReading
from servotwin.estimation.two_contacts import deg
from servotwin.estimation.whitened.channels import motor_angle
from servotwin.estimation.whitened.contact_pair import OneContact, Pair, pair
from servotwin.estimation.whitened.estimator import WhitenedSettings, WindowFit, fit, fit_gap_only
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_GAP, _CONSTANT = 0, 1  # rows of the columns
# A right offset leaves about the same residual as none. Searches that got lost in its narrow valley stated gaps 1 deg
# off with a small spread; their residual was a hundred times as large.
_WORSE = 3.0
_UNLIKE = 6.0  # standard deviations: a carried offset that moves the gap so far has changed, or is another machine's


def estimate_carrying(
    window: Window,
    servo: Servo,
    prior: float | GapEstimate | None,
    settings: WhitenedSettings,
    carried: tuple[float, float] | None,
    machine: FactorPrior | None = None,
    before: LastContact | None = None,
) -> GapEstimate:
    """Estimate the gap from the window alone, or, where that shows too little, with what earlier windows showed.

    That is the encoder's offset, or the last contact on the other side, which must not contradict it.

    The estimate holds the offset for the trend. The carried offset is not used where the window shows both sides of the
    gap, so that an encoder that has slipped cannot spoil the estimate.

    Parameters
    ----------
    window : Window
    servo : Servo
    prior : float or GapEstimate, optional
        As for `estimate_gap`.
    settings : WhitenedSettings
        With an `offset` of its own, none is carried and none is read.
    carried : (float, float), optional
        Mean and standard deviation of the offset, rad.
    machine : FactorPrior, optional
        What is known of the machine's numbers; None: the model is exact.
    before : LastContact, optional
        Of the last window that showed one contact.
    """
    known = settings.offset is None and carried is not None and 0.0 < carried[1] < settings.largest_std
    # Where the machine is known well, a fit of the gap alone tells whether contact suffices.
    gap_only = (known or before is not None) and not (machine is not None and machine.wide)
    fitted = (fit_gap_only if gap_only else fit)(window, servo, prior, settings, machine)
    paired = _pair(fitted, servo, machine, before)
    if gap_only and not (fitted.one_sided() and (known or paired is not None)):
        fitted, gap_only = fit(window, servo, prior, settings, machine, fitted), False
        paired = _pair(fitted, servo, machine, before)
    if paired is not None and not known and (by_contacts := paired.estimate) is not None:
        return by_contacts
    made = _alone_or_aided(fitted, servo, machine, carried if known else None, paired, gap_only)
    if paired is None:
        return made
    return (not made.ok and paired.estimate) or paired.added_to(made)


def _pair(fitted: WindowFit, servo: Servo, machine: FactorPrior | None, before: LastContact | None) -> Pair | None:
    """Look at the last contact of a fit, and at the one before; None: it has none for certain."""
    one = None if fitted.settings.offset is not None else OneContact.of(fitted, servo, machine)
    return None if one is None else pair(one, before)


def _alone_or_aided(
    fitted: WindowFit,
    servo: Servo,
    machine: FactorPrior | None,
    carried: tuple[float, float] | None,
    paired: Pair | None,
    gap_only: bool,
) -> GapEstimate:
    """Estimate the gap from the window alone, or with a carried offset that does not contradict the last contact."""
    window, prior, settings = fitted.window, fitted.prior, fitted.settings
    if gap_only and carried is None:
        fitted, gap_only = fit(window, servo, prior, settings, machine, fitted), False
    # A window of one contact cannot show the gap alone, and judging it takes longer than everything else here.
    alone = None if carried is not None and fitted.one_sided() else fitted.concluded()
    if alone is not None:
        if settings.offset is None and alone.ok:
            return replace(alone, offset=read_offset(window, fitted.servo, alone, settings))
        if carried is None or alone.status is GapStatus.MODEL_MISMATCH:
            return alone
    assert carried is not None
    aided = fit(window, servo, prior, replace(settings, offset=carried), machine)
    helped = aided.concluded()
    agrees = paired is None or paired.agrees(helped)
    fits = helped.ok and agrees and not helped.rms > _WORSE * fitted.rms()
    expected = prior if isinstance(prior, GapEstimate) and fits and _is_unlike(helped, prior) else None
    offset = CarriedOffset(*carried, _slope(_columns(window, aided.servo, helped, settings))) if fits else None
    if fits and expected is None:
        return replace(helped, offset=offset)
    if gap_only:
        fitted = fit(window, servo, prior, settings, machine, fitted)
    refused = _refused(alone or fitted.concluded(), helped)
    return refused if expected is None or refused.ok else _doubting(refused, helped, expected, offset)


def _is_unlike(helped: GapEstimate, expected: GapEstimate) -> bool:
    """True for a gap that rests on a carried offset, and is surely not the one that is expected."""
    return abs(helped.gap - expected.gap) > _UNLIKE * math.hypot(helped.std_total, expected.std_total)


def _doubting(
    alone: GapEstimate, helped: GapEstimate, expected: GapEstimate, offset: CarriedOffset | None
) -> GapEstimate:
    """The estimate of the window alone, with the offset that does not fit it: the trend forgets that."""
    found, known = deg(helped.gap), deg(expected.gap)
    why = f"with the encoder's offset from earlier windows the gap would be {found}, and {known} are expected"
    forgotten = "that offset is not used until a window shows it again"
    return replace(alone, offset=offset, reasons=(*alone.reasons, f"{why}: {forgotten}"))


def _refused(alone: GapEstimate, helped: GapEstimate) -> GapEstimate:
    """Return the estimate of the window alone, with the reason for not using the other."""
    if not helped.ok or alone.status is GapStatus.MODEL_MISMATCH or helped.rms <= _WORSE * alone.rms:
        return alone
    worse = f"with the encoder's offset from earlier windows {helped.rms / alone.rms:.3g} times the residual is left"
    return replace(alone, reasons=(*alone.reasons, worse))


def read_offset(
    window: Window, servo: Servo, estimate: GapEstimate, settings: WhitenedSettings | None = None
) -> OffsetReading:
    """The offset (rad) with its standard deviation and its covariance with the gap.

    Shape of the covariance: that of white noise; size: such that the gap's variance is the estimate's `std_total`
    squared, so that whatever that accounts for widens the offset in proportion.

    Raises
    ------
    InvalidInput
        The estimate is not OK, or the window has no theta_m.
    """
    if window.theta_m is None or not estimate.ok:
        missing = "theta_m" if window.theta_m is None else "an OK estimate"
        raise InvalidInput(f"{window.where}the encoder's offset needs {missing}")
    table = _columns(window, servo, estimate, settings or WhitenedSettings())
    residual, columns = table[0], table[1:]
    gain = response(servo, window.sample_rate).static_gain
    solved = least_squares(np.delete(columns, _GAP, axis=0), residual)
    covariance = _scaled(least_squares(columns, residual).root, estimate.std_total)
    # `_columns` counts both channels from their first samples; here the origins come back.
    offset = float(solved.coefficients[0]) + float(window.position[0]) / gain - float(window.theta_m[0])
    return OffsetReading(offset, math.sqrt(covariance[1, 1]), float(covariance[0, 1]))


def _columns(window: Window, servo: Servo, estimate: GapEstimate, settings: WhitenedSettings) -> Array:
    """(k, n) residual, its derivatives by gap and constant (per rad of offset), nuisances."""
    model = response(servo, window.sample_rate)
    angle = motor_angle(window, servo.encoder_resolution, settings, scales(servo).time)
    first, home = float(angle[0]), float(window.position[0])
    screw = polygon(angle - first, Gap(estimate.gap, estimate.theta_d0 - first))
    rows = model.respond(screw[[SCREW, BY_GAP, BY_START]])
    constant = np.full((1, angle.size), model.static_gain)
    late = model.velocities(screw[[SCREW]])
    return np.vstack([window.position - home - rows[0], rows[1:2], constant, rows[2:], model.free(angle.size), late])


def _slope(table: Array) -> float:
    """Change of the best fit's gap per change of the offset."""
    columns = table[1:]
    answer = least_squares(np.delete(columns, _CONSTANT, axis=0), columns[_CONSTANT])
    return -float(answer.coefficients[_GAP])


def _scaled(root: Array, std: float) -> Array:
    """(2, 2) covariance of gap and offset, scaled to a standard deviation of the gap (rad)."""
    pair = root[:, :2]
    covariance = pair.T @ pair
    return np.asarray(covariance * (std * std / float(covariance[0, 0])))
