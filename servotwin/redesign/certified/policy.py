"""The default policy: a setting verified on all machines that the evidence allows, otherwise the fallback set."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import ClassVar, Protocol

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of, with_gains
from servotwin.control.retuning import static_gain
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import Band, Setting
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.assess import NEAR
from servotwin.redesign.certified.candidates import friction_push
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.evidence_ranges import SAME_FEEDFORWARD, EvidenceRanges
from servotwin.redesign.certified.fallback import fallback_certificate
from servotwin.redesign.certified.last_search import Asked, LastSearch, digest_of, learnt_ranges, ranges_of
from servotwin.redesign.certified.learnt_servo import learnt_servo, narrowed
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import LearntFactors, Range, Region, Uncertainty
from servotwin.redesign.design import Design, with_feedforward
from servotwin.redesign.policy import Evidence, Redesign

# Relative: a smaller change of a gain is not worth an update.
_SAME = 1e-3


class Verifier(Protocol):
    """Source of verified settings for a region: by simulation, or from a table.

    Attributes
    ----------
    provisional : bool
        True when its certificates are those of wider regions, and the region itself is still to be verified.
    """

    @property
    def provisional(self) -> bool: ...

    def asked(self, region: Region) -> Asked | None:
        """Question of the search that `verify` makes for a region; None: it makes none."""
        ...

    def verify(self, region: Region, running: Setting | None) -> Certificate | NotVerified:
        """Find a verified setting for a region; `running` is in force, where that is known."""
        ...

    def fallback(self) -> Certificate:
        """Certificate of the setting for the whole stated range."""
        ...


@dataclass(frozen=True)
class CertifiedPolicy:
    """Policy that verifies settings by simulation on the joint uncertainty of gap, plant, input bias and steps.

    Parameters
    ----------
    servo : Servo or Axis
        The model.
    uncertainty : Uncertainty
        Prior knowledge, before any window; the fallback set is verified for its range of gaps.
    demands : Demands
    trial : Trial, optional
        Made for the servo by default.
    feedforward_limit : float
        V, either sign.
    horizon : float
        s for which a setting is to hold: the gap may grow meanwhile as fast as the trend says.
    clock : callable
        s, from which the certificates' computing times are taken.
    """

    servo: Plant
    uncertainty: Uncertainty = field(default_factory=lambda: Uncertainty(input_bias=(-0.1, 0.1)))
    demands: Demands = field(default_factory=Demands)
    trial: Trial | None = None
    feedforward_limit: float = 0.2
    horizon: float = 40.0
    needs_estimate: ClassVar[bool] = False
    provisional: ClassVar[bool] = False
    clock: Callable[[], float] = field(default=perf_counter, compare=False)

    @property
    def simulations(self) -> Trial:
        """Trial of every verification.

        Raises
        ------
        InvalidInput
            No candidate is within the bounds on Ms.
        """
        return self.trial or trial_for(self.servo, self.uncertainty, self.demands)

    @property
    def ranges(self) -> EvidenceRanges:
        """Makes the region that a setting must serve."""
        return EvidenceRanges(self.servo, self.uncertainty, self.feedforward_limit, self.horizon)

    def redesign(self, evidence: Evidence) -> Redesign:
        """Choose the verified setting for the evidence; without one the fallback set, and the reason.

        The setting must stay within the fallback set's band, since the edge falls back when the loop leaves it. Where
        the gap may be wider than the stated range nothing is sent: not even the fallback set is verified there. It is
        sent where the gap may only grow so wide: the one in force is for the gap of before. Where
        the window's own estimate is unusable, its input bias still counts, with the gap of the trend.
        """
        learnt = learnt_servo(self.servo, self.uncertainty, evidence.machine, evidence.motor)
        if learnt is None:
            return self.decide(evidence, self)
        ranges = dict(learnt_ranges(learnt[1], evidence.machine, evidence.motor))
        return self.decide(evidence, _LearntVerifier(self, *learnt, ranges))

    def decide(self, evidence: Evidence, verifier: Verifier) -> Redesign:
        """Choose as `redesign` does, with the certificates of `verifier`."""
        region, past = self.ranges.region(evidence), evidence.search
        asked = verifier.asked(region)
        if self.ranges.estimate(evidence) is None and not (
            self.ranges.shows_more(evidence) or self._changed(evidence, asked)
        ):
            return Redesign(None, math.nan, evidence.unusable)
        if too_wide := self._too_wide(region):
            return self._for_growth(evidence, verifier.fallback(), region) or Redesign(None, math.nan, too_wide)
        if asked is not None and past is not None and past.fails(asked):
            reason = f"{past.reason}; the ranges have not become noticeably narrower since that search"
            return self._without(evidence, region, verifier.fallback(), reason)
        kept = None if asked is None else self._still_verified(evidence, region, asked)
        result = kept or verifier.verify(region, evidence.setting)
        if isinstance(result, NotVerified):
            reason = result.reason + self.ranges.contradiction(region)
            if asked is None:
                return _fallback_redesign(verifier.fallback(), region, reason)
            made = self._without(evidence, region, verifier.fallback(), reason)
            return replace(made, search=LastSearch(asked, reason=result.reason))
        made = self._answer(evidence, region, result, verifier)
        return made if asked is None or kept is not None else replace(made, search=LastSearch(asked, result.setting))

    def _changed(self, evidence: Evidence, asked: Asked | None) -> bool:
        """True where a rest, of a machine whose gap no window has shown, changes the question of the last search: the
        size of the steps or the machine's numbers may have become known since."""
        if asked is None or evidence.search is None or evidence.gains is None:
            return False
        return math.isfinite(evidence.disturbance.bias_std) and not evidence.search.asked.alike(asked)

    def _without(self, evidence: Evidence, region: Region, fallback: Certificate, reason: str) -> Redesign:
        """The fallback set, where a search found nothing and it is not in force yet."""
        untold = not math.isfinite(evidence.disturbance.bias_std) and alike(fallback.setting, evidence.setting)
        small = SAME_FEEDFORWARD * self.ranges.smallest_answer
        if untold or _in_force(_fed(fallback, region).setting, evidence, small):
            return Redesign(None, math.nan, f"{reason}; the fallback set stays")
        return _fallback_redesign(fallback, region, reason)

    def _still_verified(self, evidence: Evidence, region: Region, asked: Asked) -> Certificate | None:
        """Certificate of the setting in force, where the last search chose it for nearly the same question."""
        found = None if evidence.search is None else evidence.search.finds(asked)
        if found is None or not alike(found, evidence.setting):
            return None
        fed = self._with_push(with_feedforward(found, region.feedforward), region, evidence)
        result = self.confirm(region, fed, evidence.machine, evidence.motor)
        return result if isinstance(result, Certificate) else None

    def _with_push(self, found: Design, region: Region, evidence: Evidence) -> Design:
        """The setting with the feedforward of the friction that is known now, where it has one."""
        law = found.controller
        if not isinstance(law, Controller) or not law.friction_feedforward:
            return found
        servo, known = self._learnt(region, evidence.machine, evidence.motor)
        push = friction_push(servo, known, self._limited_demands)
        return Design(law.replace(friction_feedforward=push), found.tolerance)

    def _learnt(
        self, region: Region, machine: FactorPrior | None, motor: LearntMotor | None
    ) -> tuple[Plant, Uncertainty]:
        """Model and ranges of a region, as learnt where they were."""
        known, learnt = region.within(self.uncertainty), learnt_servo(self.servo, self.uncertainty, machine, motor)
        return (self.servo, known) if learnt is None else (learnt[0], narrowed(known, learnt[1]))

    def _answer(self, evidence: Evidence, region: Region, found: Certificate, verifier: Verifier) -> Redesign:
        """Redesign that follows from a certificate."""
        estimate = self.ranges.estimate(evidence)
        gap = math.nan if estimate is None else estimate.gap
        if _in_force(found.setting, evidence, SAME_FEEDFORWARD * self.ranges.smallest_answer):
            return Redesign(None, gap, "the verified setting is in force already", certificate=found)
        redesign = _redesign(found, region.noise, gap, "")
        return replace(redesign, to_verify=region) if verifier.provisional else redesign

    def _too_wide(self, region: Region) -> str:
        """Reason to send nothing: the gap may be wider than stated; empty: it is not."""
        if region.gap[1] <= self.uncertainty.gap[1]:
            return ""
        low, high, most = (math.degrees(x) for x in (*region.gap, self.uncertainty.gap[1]))
        return f"the gap may be {low:.3g} to {high:.3g} deg, and at most {most:.3g} deg are certified: nothing is sent"

    def _for_growth(self, evidence: Evidence, fallback: Certificate, region: Region) -> Redesign | None:
        """The fallback set, where the gap is within the stated range and may only grow beyond it; None: it is not."""
        if self.ranges.gap_now(evidence)[1] > self.uncertainty.gap[1]:
            return None
        high, most = (math.degrees(x) for x in (region.gap[1], self.uncertainty.gap[1]))
        reason = (
            f"the gap may grow to {high:.3g} deg within {self.horizon:g} s at the rate of wear seen and assumed "
            f"([twin.trend]), and at most {most:.3g} deg are certified"
        )
        if alike(fallback.setting, evidence.setting):
            return Redesign(None, math.nan, f"{reason}; the fallback set stays")
        return _fallback_redesign(fallback, region, reason)

    def fall_back(self, evidence: Evidence, reason: str) -> Redesign:
        """Choose the fallback set, whatever else would be verified."""
        region = self.ranges.region(evidence)
        if too_wide := self._too_wide(region):
            return Redesign(None, math.nan, too_wide)
        return _fallback_redesign(self.fallback(), region, reason)

    def confirm_again(self, evidence: Evidence, setting: Setting) -> Redesign:
        """Verify an earlier setting for the present evidence; without a setting where it is not verified."""
        region = self.ranges.region(evidence)
        if too_wide := self._too_wide(region):
            return Redesign(None, math.nan, too_wide)
        law = self.servo.controller
        design = Design(law if setting.gains is None else with_gains(law, setting.gains), setting.tolerance)
        result = self.confirm(region, design, evidence.machine, evidence.motor)
        if isinstance(result, NotVerified):
            return Redesign(None, math.nan, result.reason)
        return _redesign(result, region.noise, evidence.estimate.gap, "")

    def asked(self, region: Region) -> Asked:
        """Question of a search for a region."""
        of = digest_of(self.servo, self.uncertainty, self._limited_demands, self.simulations)
        return Asked(of, ranges_of(self.servo, self.uncertainty, self.demands, region))

    def verify(self, region: Region, running: Setting | None = None) -> Certificate | NotVerified:
        """Find the cheapest setting for a region by simulation, or the running one where it is hardly dearer."""
        return self.verify_on(self.servo, region.within(self.uncertainty), region, running)

    def verify_on(
        self, servo: Plant, known: Uncertainty, region: Region, running: Setting | None
    ) -> Certificate | NotVerified:
        """Verify as `verify` does, on a servo with an uncertainty of its own."""
        demands, trial = self.demands_within_band(), self.simulations
        fed, in_force = region.feedforward, None
        if running is not None and running.gains is not None:
            in_force = Design(with_gains(servo.controller, running.gains), running.tolerance)
        return certify(servo, known, demands, trial, fed, region.noise, self.clock, in_force)

    def confirm(
        self,
        region: Region,
        setting: Design,
        machine: FactorPrior | None = None,
        motor: LearntMotor | None = None,
    ) -> Certificate | NotVerified:
        """Verify one setting for a region, by simulation, on machine and motor as learnt where they were."""
        servo, known = self._learnt(region, machine, motor)
        demands = self.demands_within_band()
        return confirm(servo, known, setting, demands, self.simulations, region.noise, self.clock)

    def demands_within_band(self) -> Demands:
        """Demands with the fallback set's band as a bound; a dead zone must open the loop inside of that band."""
        certificate, leave = self.fallback(), max((leave for _, leave in self.demands.hysteresis), default=1.0)
        tolerance = min(self.demands.tolerance, band_of(certificate).error / leave)
        # Less than what counts as arrived for the smallest step is no error.
        tail = max(certificate.tail, NEAR * self.uncertainty.step[0])
        return replace(self._limited_demands, tail=min(self.demands.tail, tail), tolerance=tolerance)

    def fallback(self) -> Certificate:
        """Certificate of the setting for every gap and bias of the stated range, whatever is estimated.

        Raises
        ------
        InvalidInput
            No setting is verified for the whole range: state a narrower one, or lower the demands.
        """
        return fallback_certificate(self.servo, self.uncertainty, self._limited_demands, self.simulations)

    @property
    def friction_feedforward_limit(self) -> float:
        """V, largest friction feedforward of this policy: the model's own friction may be fed forward, whatever bias is
        stated."""
        own = float(self.servo.command_of(self.servo.own_friction))
        return min(self.demands.friction_limit, max(self.feedforward_limit, own))

    @property
    def _limited_demands(self) -> Demands:
        """Demands with the largest friction feedforward that an edge of this policy takes."""
        return replace(self.demands, friction_limit=self.friction_feedforward_limit)


@dataclass(frozen=True)
class _LearntVerifier:
    """Verification by simulation on what was learnt of the machine, in place of the model's stated error.

    The fallback set stays that of the stated ranges. `ranges` are those of the learnt numbers.
    """

    policy: CertifiedPolicy
    servo: Plant
    learnt: LearntFactors
    ranges: dict[str, Range]
    provisional: ClassVar[bool] = False

    def asked(self, region: Region) -> Asked:
        asked = self.policy.asked(region)
        return Asked(asked.of, asked.ranges | self.ranges)

    def verify(self, region: Region, running: Setting | None = None) -> Certificate | NotVerified:
        known = narrowed(region.within(self.policy.uncertainty), self.learnt)
        return self.policy.verify_on(self.servo, known, region, running)

    def fallback(self) -> Certificate:
        return self.policy.fallback()


def alike(one: Design, other: Setting | None) -> bool:
    """True when two settings are the same but for what they feed forward against bias and friction."""
    if other is None or other.gains is None:
        return False
    now, new = other.gains, gains_of(one.controller)
    if type(now) is not type(new):
        return False
    names = [name for name in new.__struct_fields__ if name not in new.fed]
    gains = ((getattr(now, name), getattr(new, name)) for name in names)
    pairs = (*gains, (other.tolerance, one.tolerance))
    return all(math.isclose(a, b, rel_tol=_SAME, abs_tol=0.0) for a, b in pairs)


def _in_force(setting: Design, evidence: Evidence, small: float) -> bool:
    """True when the edge runs the setting already, by its last report, but for a `small` (V) change of feedforwards."""
    now, new = evidence.gains, gains_of(setting.controller)
    if now is None or type(now) is not type(new):
        return False
    changes = [getattr(now, name) - getattr(new, name) for name in new.fed]
    return max(map(abs, changes)) <= small and alike(setting, evidence.setting)


def band_of(certificate: Certificate, noise: float = 0.0) -> Band:
    """Band within which the loop stays once it has arrived, `noise` (m rms) included.

    The simulated machines are a sample: the real one may need half as long again as the slowest of them.
    """
    error = max(certificate.within, certificate.tail) + noise
    effort = certificate.effort + abs(static_gain(certificate.setting.controller)) * (
        NEAR * certificate.step[1] + noise
    )
    return Band(error, error, effort, math.ceil(1.5 * certificate.settling_worst))


def _fallback_redesign(certificate: Certificate, region: Region, reason: str) -> Redesign:
    return _redesign(_fed(certificate, region), region.noise, math.nan, f"{reason}; the fallback set is sent")


def _fed(fallback: Certificate, region: Region) -> Certificate:
    """The fallback set with the feedforward against a known input bias: it is verified for what that leaves.

    As it is where the evidence contradicts the stated biases: it is for every machine within these, and one whose
    voltage is misread is one of them.
    """
    (low, high), fed = region.input_bias, fallback.fed(region.feedforward)
    known = all(least <= low and high <= most for least, most in (fallback.input_bias, fed.input_bias))
    return fed if known else fallback


def _redesign(certificate: Certificate, noise: float, gap: float, reason: str) -> Redesign:
    """Redesign that sends a certificate's setting, with its band."""
    return Redesign(certificate.setting.setting(band_of(certificate, noise)), gap, reason, certificate)
