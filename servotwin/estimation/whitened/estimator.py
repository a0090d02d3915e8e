"""The default estimator: play operator and exact structure at the full rate, nuisances projected out, noise whitened.

The residual and its derivatives are filtered, never the motor's angle: a filter commutes with the structure, not with
the play operator. docs/estimator.md explains it, with its measured accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import Travel, travel
from servotwin.estimation.core.visible import counted, least_bound
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus, no_estimate
from servotwin.estimation.whitened.channels import faults, likely_fault, motor_angle, other_units, refused
from servotwin.estimation.whitened.doubt import gap_doubt
from servotwin.estimation.whitened.fit import AlignedFit, WhitenedFit, align_and_fit, coarse_search
from servotwin.estimation.whitened.free_model import FREEDOM, ContactEvidence, FactorPrior, adapted
from servotwin.estimation.whitened.gate import (
    FitEvidence,
    FitFacts,
    contacts_seen,
    judge,
    least_lead,
    lower_bound,
    misfits,
    one_sided,
    slow_share,
    static_lost_motion,
    sure_of_contact,
    travel_needed,
    with_free_model,
)
from servotwin.estimation.whitened.learning import LearntFit, learn_and_fit
from servotwin.estimation.whitened.load_friction import friction_hint
from servotwin.estimation.whitened.profile import profile_interval
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.estimation.whitened.shift import ModelShift, fastest, model_shift, observer_shift
from servotwin.estimation.whitened.statement import stated
from servotwin.estimation.window import Window
from servotwin.plant.scales import scales, structure_time
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

__all__ = ["METHOD", "SHORTEST", "WhitenedSettings", "WindowFit", "estimate", "fit", "shortest_window"]

METHOD = "whitened"
_ONE_CONTACT = "one contact with a model that is a little off explains the window nearly as well as two"
_NUMBERS = "stiffness", "damping", "pitch", "mass ratio"  # in words, as FACTORS has them
_COUNT = math.sqrt(12.0)  # of the deviation that rounding to it leaves
_LEFT = 5e-4  # of the position's slow motion: with less unexplained the model is right, or off by next to nothing
_NO_SHIFT = ModelShift(0.0, math.inf, "", 0.0)
SHORTEST = 400  # samples: with fewer there is little left beside the nuisances


def shortest_window(_settings: WhitenedSettings, _servo: Servo, sample_rate: float) -> tuple[float, str]:
    """Shortest window (s) at a sample rate (Hz), and the reason in words."""
    return SHORTEST / sample_rate, f"method {METHOD!r}, which needs {SHORTEST} samples"


def estimate(
    window: Window, servo: Servo, prior: float | GapEstimate | None, settings: WhitenedSettings | None
) -> GapEstimate:
    """Estimate the total gap (rad) from a window with theta_m and position.

    Parameters
    ----------
    window : Window
    servo : Servo
        The model; that it fits the window is checked.
    prior : float or GapEstimate, optional
        Total gap, rad: one of the starts, and the result where the window does not show the gap.
    settings : WhitenedSettings, optional

    Raises
    ------
    InvalidInput
        No theta_m, a window too short, a low-pass above half the sample rate.
    """
    return fit(window, servo, prior, settings).concluded()


@dataclass(frozen=True, eq=False)
class WindowFit:
    """A window's fit before it is judged; judging takes longer than fitting.

    Attributes
    ----------
    window : Window
    servo : Servo
    prior : float or GapEstimate, optional
    settings : WhitenedSettings
    blank : GapEstimate
        Estimate without the window; its status and reasons are final where the channels are broken.
    angle : (n,) array
        rad, of the motor.
    broken : bool
        A channel is broken, so that nothing is fitted.
    second : float
        s, one of the servo's own (`plant.scales`).
    aligned : AlignedFit, optional
        None: the channels are broken.
    learnt : LearntFit, optional
        The same with the factors that were free; None: the model was taken as it is.
    """

    window: Window
    servo: Servo
    prior: float | GapEstimate | None
    settings: WhitenedSettings
    blank: GapEstimate
    angle: Array
    broken: bool
    second: float
    aligned: AlignedFit | None = None
    learnt: LearntFit | None = None

    def one_sided(self) -> str:
        """Reason for which the window has too little contact to show the gap; empty when it has enough."""
        if self.aligned is None:
            return ""
        fitted = self.aligned.whitened
        return one_sided(_travel(fitted), travel_needed(fitted.point.gap, self.servo, self.settings), self.settings)

    def rms(self) -> float:
        """Root mean square of the fit's residual, m."""
        return math.nan if self.aligned is None else self.aligned.whitened.residual_rms

    def concluded(self) -> GapEstimate:
        """Judge the fit and make the estimate."""
        if self.aligned is None:
            return self.blank
        made = self._judged()
        # A machine that is learnt was fitted with its numbers free.
        told = made.status in (GapStatus.OK, GapStatus.LOWER_BOUND)
        if not told or self.learnt is not None or self.evidence.unexplained <= _LEFT:
            return made
        return self._beside_free_model(made)

    def _judged(self) -> GapEstimate:
        """The estimate by the fit alone."""
        assert self.aligned is not None
        evidence = self.evidence
        status, reasons = judge(evidence, self.settings)
        usable = status in (GapStatus.OK, GapStatus.LOWER_BOUND)
        if self.learnt is not None and self.learnt.beyond and usable:
            status, reasons = GapStatus.MODEL_MISMATCH, (self.learnt.beyond,)
        teaches = self._teaches(evidence, status)
        if teaches or status in (GapStatus.OK, GapStatus.LOWER_BOUND):
            contacts = contacts_seen(self.aligned, self.servo)
            if status is not GapStatus.UNIDENTIFIABLE and not contacts.two:
                reasons = reasons or (_ONE_CONTACT,)
                bound = self._one_contact(evidence, contacts, reasons)
                if self.learnt is None or misfits(evidence, self.settings):
                    return bound
                either = self.learnt.reading_of_either(contacts.single.point, self.settings.calibration)
                return replace(bound, machine=either)
            teaches = teaches and contacts.two
        if status is GapStatus.MODEL_MISMATCH:
            # A fault of a channel may have bent the machine's numbers first.
            servo = self.servo if self.learnt is None else self.learnt.problem.servo
            fault = likely_fault(self.window, self.angle, servo, evidence.unexplained, self.second)
            reasons = (*fault, *reasons)
        if status in (GapStatus.MODEL_MISMATCH, GapStatus.UNIDENTIFIABLE):
            reasons = (*reasons, *filter(None, [friction_hint(self.aligned.whitened, self.servo)]))
        if status is GapStatus.OK:
            evidence = replace(evidence, doubt=self._doubt(evidence), learnt=self.learnt is not None)
        made = stated(self.blank, evidence, status, reasons, self.prior, self.settings)
        if self.learnt is None or not teaches:
            return made
        return replace(made, machine=self.learnt.reading(self.settings.calibration))

    def _beside_free_model(self, made: GapEstimate) -> GapEstimate:
        """The estimate, or a refusal where a fit with the model free within its usual error contradicts it.

        Whitening takes what a wrong model leaves for noise, and its linear shift does not lead from a wrong minimum to
        the right one. So where anything slow is left, that fit is made.
        """
        usual = FactorPrior.of_spreads(*FREEDOM)
        free = fit(self.window, self.servo, self.prior, self.settings, usual).concluded()
        if not made.ok:
            least = free.interval[0] if free.ok or free.status is GapStatus.LOWER_BOUND else 0.0
            return made if made.gap <= least else self._bounded(least, made.reasons)
        if not free.ok or abs(free.gap - made.gap) <= NORMAL_95 * math.hypot(free.std_total, made.std_total):
            return made
        cause = self.evidence.shift.words if free.machine is None else _farthest(free.machine.factors)
        words = f"with the model free the gap would be {math.degrees(free.gap):.4g} deg: {cause}"
        return stated(self.blank, self.evidence, GapStatus.MODEL_MISMATCH, (words,), self.prior, self.settings)

    @cached_property
    def facts(self) -> FitFacts:
        """Contact, counts and noise in the fit; there must be one."""
        assert self.aligned is not None
        return _facts(self.aligned, self.window, self.servo, self.settings, self.second)

    @cached_property
    def evidence(self) -> FitEvidence:
        """Evidence for and against the fit; there must be one."""
        assert self.aligned is not None
        evidence = _evidence(self.facts, self.window, self.angle, self.servo, self.settings, self.second)
        if self.learnt is not None:
            evidence = evidence.spread_to(self.learnt.gap_std(self.settings.calibration))
        if self.settings.gap_rate > 0.0 and max(evidence.scale, self.servo.position_resolution) > 0.0:
            evidence = evidence.spread_to(math.hypot(evidence.std, self._moved_by_growth()))
        return evidence

    def _moved_by_growth(self) -> float:
        """Distance (rad) of the gap from that of the same window taken for constant, as far as rounding can feign it.

        Two pushes tell gap, offset and growth apart by less than a count of the position, where the machine's own
        error is as large. What the growing gap explains beyond what the fit leaves is growth.
        """
        assert self.aligned is not None
        fitted, still = self.aligned.whitened, replace(self.settings, gap_rate=0.0)
        position, rate = self.window.position, self.window.sample_rate
        _, points = coarse_search(self.angle, position, rate, self.servo, fitted.point.gap, still)
        constant = align_and_fit(self.angle, position, rate, self.servo, points, still).whitened
        explained = math.sqrt(max(0.0, constant.residual_rms**2 - fitted.residual_rms**2))
        feigned = _COUNT * fitted.residual_rms
        share = 1.0 if explained <= feigned else feigned / explained
        return share * abs(constant.point.gap - fitted.point.gap)

    def _one_contact(self, evidence: FitEvidence, contacts: ContactEvidence, reasons: tuple[str, ...]) -> GapEstimate:
        """State a lower bound: one contact explains the window too, and then the gap is as wide as the motor's lead."""
        bound = lower_bound(evidence, self.settings) if sure_of_contact(evidence, self.settings) else 0.0
        if bound >= evidence.smallest:  # the lead, which costs far more, can only lower it
            ramp = fastest(evidence.aligned.whitened.reduction, self.second)
            bound = min(bound, least_lead(evidence, contacts, self.servo, self.settings, ramp))
        return self._bounded(bound, reasons)

    def _bounded(self, bound: float, reasons: tuple[str, ...]) -> GapEstimate:
        """State a lower bound (rad), or, where it says nothing, that the window does not show the gap."""
        fitted = self.evidence.aligned.whitened
        blank = replace(self.blank, reasons=reasons, rms=fitted.residual_rms, evaluations=fitted.evaluations)
        if bound < self.evidence.smallest:
            return replace(blank, status=GapStatus.UNIDENTIFIABLE)
        return replace(blank, status=GapStatus.LOWER_BOUND, gap=bound, interval=(bound, math.inf))

    def _doubt(self, evidence: FitEvidence) -> float:
        """Root mean square (rad) of what machines and sensors that are not as assumed can do to the gap."""
        aligned, ramp = evidence.aligned, fastest(evidence.aligned.whitened.reduction, self.second)
        if self.learnt is not None:
            return self.learnt.doubt(ramp, self.settings.calibration)
        problem, fitted = with_free_model(aligned, self.servo), aligned.whitened
        at = np.array([*fitted.point, *problem.prior.mean])
        return gap_doubt(problem, at, max(1.0, fitted.variance), aligned.delay, ramp, learnt=False)

    def _teaches(self, evidence: FitEvidence, status: GapStatus) -> bool:
        """True where the window shows the machine's numbers, whether or not it shows the gap well enough."""
        # A screw that begins in contact does not show its place, which then does not matter.
        known = self.learnt is not None and bool(np.all(np.isfinite(self.learnt.free.covariance[2:, 2:])))
        wide = status is GapStatus.UNIDENTIFIABLE and math.isfinite(evidence.interval[1]) and not self.one_sided()
        return known and (status is GapStatus.OK or wide)


def fit(
    window: Window,
    servo: Servo,
    prior: float | GapEstimate | None,
    settings: WhitenedSettings | None,
    machine: FactorPrior | None = None,
    first: WindowFit | None = None,
) -> WindowFit:
    """The first half of `estimate`, with the same arguments and errors.

    With `machine`, the model's factors are free within that; without it the model is taken as it is. `first`: what
    `fit_gap_only` returned for the same arguments.
    """
    if machine is None:
        return first or fit_gap_only(window, servo, prior, settings)
    made = first or _unfitted(window, servo, prior, settings)
    if made.broken:
        return made
    start = _start(prior)
    learnt = learn_and_fit(
        made.angle, window.position, window.sample_rate, servo, start, made.settings, machine, made.aligned
    )
    return replace(made, servo=learnt.servo, aligned=learnt.aligned, learnt=learnt)


def fit_gap_only(
    window: Window,
    servo: Servo,
    prior: float | GapEstimate | None,
    settings: WhitenedSettings | None,
    machine: FactorPrior | None = None,
) -> WindowFit:
    """Fit gap and place to the machine as it is known, whose own numbers stay: a small part of what `fit` costs."""
    made = _unfitted(window, servo, prior, settings)
    if made.broken:
        return made
    here = servo if machine is None else adapted(servo, machine.mean)
    position, rate = window.position, window.sample_rate
    _, points = coarse_search(made.angle, position, rate, here, _start(prior), made.settings)
    return replace(made, servo=here, aligned=align_and_fit(made.angle, position, rate, here, points, made.settings))


def _unfitted(
    window: Window, servo: Servo, prior: float | GapEstimate | None, settings: WhitenedSettings | None
) -> WindowFit:
    """Prepare a fit; its channels may be broken."""
    second = scales(servo).time
    settings = (settings or WhitenedSettings()).on(second)
    _check(window)
    assert window.theta_m is not None
    blank = _nothing(window, servo, prior)
    broken = faults(window) or other_units(window, servo.encoder_resolution, servo.position_resolution)
    if broken:
        blank = refused(blank, broken)
    angle = window.theta_m if broken else motor_angle(window, servo.encoder_resolution, settings, second)
    return WindowFit(window, servo, prior, settings, blank, angle, bool(broken), second)


def _check(window: Window) -> None:
    if window.theta_m is None:
        raise InvalidInput(f"{window.where}the window has no theta_m: method 'whitened' needs the motor's angle in rad")
    if window.position.size < SHORTEST:
        size = window.position.size
        raise InvalidInput(f"{window.where}the window has {size} samples: method 'whitened' needs at least {SHORTEST}")


def _start(prior: float | GapEstimate | None) -> float:
    value = prior.gap if isinstance(prior, GapEstimate) else prior
    return 0.0 if value is None or not math.isfinite(value) else value


def _facts(aligned: AlignedFit, window: Window, servo: Servo, settings: WhitenedSettings, second: float) -> FitFacts:
    result = aligned.whitened
    # A load that swings behind a slow loop is no noise either.
    paces = {second, structure_time(servo) or second}
    return FitFacts(
        aligned=aligned,
        travel=_travel(result),
        unexplained=max(slow_share(result, pace) for pace in paces),
        needed=travel_needed(result.point.gap, servo, settings),
        smallest=least_bound(servo.encoder_resolution),
        count=servo.encoder_resolution if window.theta_m is None else _count(window.theta_m, servo),
        scale=counted(window.position) / abs(result.reduction.response.static_gain),
        colour=max(0.0, 1.0 - result.noise.unpredicted / result.reduction.decimation.whiteness),
    )


def _evidence(
    facts: FitFacts, window: Window, angle: Array, servo: Servo, settings: WhitenedSettings, second: float
) -> FitEvidence:
    aligned, result = facts.aligned, facts.aligned.whitened
    std = settings.calibration * result.std * math.sqrt(max(1.0, result.variance))
    gain, gap = result.reduction.response.static_gain, result.point.gap
    identifiable = math.isfinite(result.std)
    return FitEvidence(
        **vars(facts),
        std=std,
        interval=profile_interval(result, std, settings.calibration, aligned.largest, 1e-3 * aligned.tolerance**0.5),
        shift=model_shift(result, servo, settings.order, second) if identifiable else _NO_SHIFT,
        observer=observer_shift(result, servo, second) if identifiable else (0.0, math.inf),
        lost_motion=static_lost_motion(angle, window.position, window.sample_rate * second, gain, gap),
    )


def _count(angle: Array, servo: Servo) -> float:
    """Count of the encoder (rad): what shows, or what is stated where that is more."""
    return max(servo.encoder_resolution, counted(angle))


def _farthest(factors: Sequence[float]) -> str:
    """Words on the factor (logarithm) that is the farthest off the model, in usual deviations."""
    place = int(np.argmax(np.abs(factors) / np.array(FREEDOM)))
    return f"a {_NUMBERS[place]} off by {100.0 * math.expm1(factors[place]):+.2g} % would explain most of it"


def _travel(result: WhitenedFit) -> Travel:
    """Sum up the screw's motion without the end of the window, to which the last mass cannot have answered."""
    reduction, model = result.reduction, result.reduction.response
    count = max(2, reduction.theta_m.size - round(model.unseen / model.interval))
    middle = result.point.gap - 0.5 * reduction.rate * (reduction.theta_m.size - count)
    at = result.point.screw(0.0)._replace(gap=middle, rate=reduction.rate)
    return travel(reduction.theta_m[:count], at)


def _nothing(window: Window, servo: Servo, prior: float | GapEstimate | None) -> GapEstimate:
    """Make the estimate without the window: from the prior alone."""
    blank = no_estimate(window.mid_time, model_version=servo.version, method=METHOD)
    if isinstance(prior, GapEstimate):
        return replace(blank, gap=prior.gap, std=prior.std, std_total=prior.std_total, interval=prior.interval)
    return blank if prior is None else replace(blank, gap=prior)
