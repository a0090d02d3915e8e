"""Evidence of a twin: typed records as a step returns them, in memory, and as rows for the store.

Bodies are MessagePack, every double with all its bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct

from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, MachineReading
from servotwin.estimation.learning.machine import LearntMachine
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.learning.wear import Expectation, TrendState
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import (
    Answer,
    Fallback,
    Hello,
    LearntResponse,
    ParameterMessage,
    Receipt,
    Request,
    Update,
    WindowMessage,
    encode,
    finite,
)
from servotwin.messages.acts import Act
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.store.records import EvidenceRecord
from servotwin.twin.lookups import VerificationRequest
from servotwin.twin.oversight import Proposal
from servotwin.twin.triage import Glance

MAX_STATUS = 300
"""Characters of a status; the rest is in the body."""


class GlanceRecord(NamedTuple):
    """Glance at a window, which got no estimate where that was enough; `tail` as in `EvidenceRecord`."""

    window: WindowMessage
    glance: Glance
    tail: float | None


class GapEstimateRecord(NamedTuple):
    """An estimate with the expectation before it, so that it can be repeated."""

    window: WindowMessage
    estimate: GapEstimate
    expected: Expectation
    tail: float | None


class DisturbanceRecord(NamedTuple):
    """Input bias and noise of a window."""

    window: WindowMessage
    disturbance: Disturbance


class TrendRecord(NamedTuple):
    """Gap and wear after a window; None before the first estimate."""

    window: WindowMessage
    trend: Trend | None


class MachineRecord(NamedTuple):
    """The machine as learnt, after a window that told of it."""

    window: WindowMessage
    machine: LearntMachine


class MotorRecord(NamedTuple):
    """The motor as learnt, after a window that told of it."""

    window: WindowMessage
    motor: LearntMotor


class AlarmRecord(NamedTuple):
    """A sentence for the operator on the machine, after a window."""

    window: WindowMessage
    sentence: str


class RedesignRecord(NamedTuple):
    """A redesign, or the reason why there is none."""

    window: WindowMessage
    redesign: Redesign


class ExcitationRecord(NamedTuple):
    """A decision for or against the request of a more informative window, with the reason."""

    window: WindowMessage
    decision: Decision


class VerificationRecord(NamedTuple):
    """Result of verifying the setting that an update carries."""

    request: VerificationRequest
    result: Certificate | NotVerified


class WithdrawalRecord(NamedTuple):
    """A setting that is withdrawn, with the reason."""

    request: VerificationRequest
    why: str


class ProposalRecord(NamedTuple):
    """An update that waits for its approval."""

    proposal: Proposal


class ActRecord(NamedTuple):
    """An engineer's act, and the reason for which it was refused; empty: it was carried out.

    `later`: a roll back, once a window has come with which its setting was sent, or could not be.
    """

    act: Act
    refused: str
    later: bool = False


Record = (
    GlanceRecord | GapEstimateRecord | DisturbanceRecord | TrendRecord | MachineRecord | MotorRecord | AlarmRecord
    | RedesignRecord | ExcitationRecord | VerificationRecord | WithdrawalRecord | VerificationRequest
    | ProposalRecord | ActRecord
    | Update | Request | LearntResponse | Receipt | Fallback | Answer | Hello
)  # fmt: skip
"""Evidence of one step; a message is its own record: an update or a request sent, a receipt received."""

WindowId = tuple[str, str, int]
"""(servo, boot, sequence) of a window."""


@dataclass
class EvidenceLog:
    """Windows and evidence in memory, for simulation and tests."""

    windows: dict[WindowId, WindowMessage] = field(default_factory=dict)
    glances: dict[WindowId, Glance] = field(default_factory=dict)
    estimates: dict[WindowId, GapEstimate] = field(default_factory=dict)
    disturbances: dict[WindowId, Disturbance] = field(default_factory=dict)
    trends: dict[WindowId, Trend | None] = field(default_factory=dict)
    machines: dict[WindowId, LearntMachine] = field(default_factory=dict)
    motors: dict[WindowId, LearntMotor] = field(default_factory=dict)
    alarms: list[tuple[WindowId, str]] = field(default_factory=list)
    redesigns: dict[WindowId, Redesign] = field(default_factory=dict)
    excitations: dict[WindowId, Decision] = field(default_factory=dict)
    updates: list[Update] = field(default_factory=list)
    requests: list[Request] = field(default_factory=list)
    responses: list[LearntResponse] = field(default_factory=list)
    receipts: list[Receipt] = field(default_factory=list)
    fallbacks: list[Fallback] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)
    hellos: list[Hello] = field(default_factory=list)
    unverified: list[VerificationRequest] = field(default_factory=list)
    verifications: list[VerificationRecord] = field(default_factory=list)
    withdrawals: list[WithdrawalRecord] = field(default_factory=list)
    proposals: list[Proposal] = field(default_factory=list)
    acts: list[ActRecord] = field(default_factory=list)

    def add_window(self, window: WindowMessage) -> bool:
        """Store a window under its identity; False when it was stored already."""
        new = window.identity not in self.windows
        self.windows.setdefault(window.identity, window)
        return new

    def add(self, records: Iterable[Record]) -> None:
        """Store the evidence of a step."""
        for record in records:
            self._add(record)

    def _add(self, record: Record) -> None:
        match record:
            case GlanceRecord(window, glance):
                self.glances[window.identity] = glance
            case GapEstimateRecord(window, estimate):
                self.estimates[window.identity] = estimate
            case DisturbanceRecord(window, disturbance):
                self.disturbances[window.identity] = disturbance
            case TrendRecord(window, trend):
                self.trends[window.identity] = trend
            case MachineRecord(window, machine):
                self.machines[window.identity] = machine
            case MotorRecord(window, motor):
                self.motors[window.identity] = motor
            case AlarmRecord(window, sentence):
                self.alarms.append((window.identity, sentence))
            case RedesignRecord(window, redesign):
                self.redesigns[window.identity] = redesign
            case ExcitationRecord(window, decision):
                self.excitations[window.identity] = decision
            case VerificationRecord():
                self.verifications.append(record)
            case WithdrawalRecord():
                self.withdrawals.append(record)
            case ProposalRecord(proposal):
                self.proposals.append(proposal)
            case ActRecord():
                self.acts.append(record)
            case VerificationRequest():
                self.unverified.append(record)
            case Update():
                self.updates.append(record)
            case Request():
                self.requests.append(record)
            case LearntResponse():
                self.responses.append(record)
            case Receipt():
                self.receipts.append(record)
            case Fallback():
                self.fallbacks.append(record)
            case Answer():
                self.answers.append(record)
            case Hello():
                self.hellos.append(record)


class StoredExpectation(Struct, frozen=True):
    """An `Expectation` as plain numbers."""

    previous: float
    trend: TrendState | None
    machine: MachineReading | None = None

    @classmethod
    def of(cls, expected: Expectation) -> StoredExpectation:
        """The numbers of an expectation."""
        trend = None if expected.trend is None else TrendState.of(expected.trend)
        machine = None if expected.machine is None else expected.machine.reading
        return cls(float(expected.previous), trend, machine)

    def expectation(self, settings: TrendSettings) -> Expectation:
        """Make the expectation again, bit for bit."""
        trend = None if self.trend is None else self.trend.trend(settings)
        machine = None if self.machine is None else FactorPrior.of_reading(self.machine)
        return Expectation(self.previous, trend, machine)


class StoredEstimate(Struct, frozen=True):
    """Body of an estimate: the estimate of a window of `boot`, and the expectation before it."""

    estimate: msgspec.Raw
    prior: StoredExpectation
    boot: str


def rows(records: Sequence[Record], message: int, context: str) -> list[EvidenceRecord]:
    """Make the rows for the store.

    Parameters
    ----------
    records : sequence of Record
        Verification requests among them are left out: they go to the queue.
    message : int
        Id of the message that led to them; 0: none.
    context : str
        Key of the context in which they were computed.
    """
    made = (_row(record) for record in records if not isinstance(record, VerificationRequest))
    return [
        row._replace(message=message, context="" if row.kind in _WITHOUT_CONTEXT else context)
        for row in made
        if row is not None
    ]


_WITHOUT_CONTEXT = ("request", "receipt", "fallback", "answer", "hello", "act")
"""Kinds that are not computed (the decision that led to a request has a row of its own)."""


def _row(record: Record) -> EvidenceRecord | None:
    """Make the row of a record, without message and context; None for a trend that does not exist yet."""
    match record:
        case GlanceRecord(window, glance, tail):
            made = _computed(
                "glance", glance, glance.why, gap=finite(glance.gap), std=finite(glance.std_total), tail=tail
            )
            return made._replace(version=window.parameter_version)
        case GapEstimateRecord(window, estimate, expected, tail):
            body = StoredEstimate(msgspec.Raw(plain(estimate)), StoredExpectation.of(expected), window.boot)
            gap, std = finite(estimate.gap), finite(estimate.std_total)
            made = _computed("estimate", body, estimate.status.value, gap=gap, std=std, tail=tail)
            return made._replace(version=window.parameter_version)
        case DisturbanceRecord(_, disturbance):
            return _computed("disturbance", disturbance, "; ".join(disturbance.reasons))
        case TrendRecord(_, trend):
            if trend is None:
                return None
            numbers, reasons = TrendState.of(trend), "; ".join(trend.reasons)
            return _computed("trend", numbers, reasons, gap=finite(trend.gap), std=finite(trend.gap_std))
        case MachineRecord(_, machine):
            return _computed("alarm" if machine.alarm else "machine", machine, machine.alarm)
        case MotorRecord(_, motor):
            return _computed("alarm" if motor.alarm else "motor", motor, motor.alarm)
        case AlarmRecord(_, sentence):
            return _computed("alarm", {"sentence": sentence}, sentence)
        case RedesignRecord(_, redesign):
            return _computed("redesign", _redesign_body(redesign), redesign.reason, gap=finite(redesign.gap))
        case ExcitationRecord(_, decision):
            return _computed("excitation", decision, decision.reason)
        case VerificationRecord(request, result):
            shown = result if isinstance(result, Certificate) else result.best
            body_of = {"question": request, "certificate": shown and _timeless(shown)}
            reason = "" if isinstance(result, Certificate) else result.reason
            return _computed("verification", body_of, reason, **_of_update(request))
        case WithdrawalRecord(request, why):
            return _computed("withdrawn", {"version": request.version, "why": why}, why, **_of_update(request))
        case ProposalRecord(proposal):
            draft = proposal.update
            window_key = "{}/{}".format(*draft.window)
            return _computed("proposal", draft, draft.status, gap=draft.gap, std=draft.std, window=window_key)
        case ActRecord(act, refused, later):
            came = f" ({'not sent' if later else 'refused'}: {refused})" if refused else " (sent)" if later else ""
            window_key = "" if act.window is None else "{}/{}".format(*act.window)
            return _computed(
                "act", {"act": act, "refused": refused, "later": later}, act.sentence + came, window=window_key
            )
        case Update():
            window_key = "{}/{}".format(*record.window)
            row = _sent("update", record, record.status, record.version)
            return row._replace(gap=record.gap, std=record.std, window=window_key)
        case Request():
            return _sent("request", record, record.reason)
        case LearntResponse():
            spread = math.degrees(record.gap_std)
            return _sent("response", record, f"version {record.version} of the structure, gap to {spread:.2g} deg")
        case Receipt():
            return _sent("receipt", record, record.reason.value, record.version)
        case Fallback():
            return _sent("fallback", record, record.cause.value, record.replaced)
        case Answer():
            return _sent("answer", record, record.outcome.value)
        case Hello():
            return _sent("hello", record, record.boot, record.parameter_version)
    raise TypeError(f"{type(record).__name__} is not a record of evidence")


def _computed(kind: str, body: object, status: str, **values: Any) -> EvidenceRecord:
    return EvidenceRecord(kind, 0, plain(body), status=short(status), **values)


def _sent(kind: str, message: ParameterMessage, status: str, version: int | None = None) -> EvidenceRecord:
    return EvidenceRecord(kind, 0, encode(message), version=version, status=short(status))


def _of_update(request: VerificationRequest) -> dict[str, Any]:
    return {"version": request.version, "window": "{}/{}".format(*request.window)}


def failure_row(message: int, why: str, body: Mapping[str, Any] | None = None) -> EvidenceRecord:
    """Make the row of a message whose processing failed."""
    content = {"failed": why, **(body or {})}
    return EvidenceRecord("estimate", message, plain(content), status=short(f"failed: {why}"))


def plain(value: object) -> bytes:
    """Encode dataclasses, structs and arrays as MessagePack; infinities and NaN stay."""
    return _encoder.encode(value)


def short(status: str) -> str:
    """Shorten a status to the length that every database accepts."""
    return status.replace("\0", "")[:MAX_STATUS]


def _redesign_body(redesign: Redesign) -> dict[str, Any]:
    """Body of a redesign without the computing time of its certificate: equal twins store equal evidence."""
    parts = {each.name: getattr(redesign, each.name) for each in fields(redesign)}
    return {**parts, "certificate": redesign.certificate and _timeless(redesign.certificate)}


def _timeless(certificate: Certificate) -> dict[str, Any]:
    return {each.name: getattr(certificate, each.name) for each in fields(certificate) if each.compare}


def _plain_value(value: object) -> object:
    """Convert a number or an array of numpy's to plain Python, which MessagePack can encode."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"evidence holds a {type(value).__name__}, which cannot be encoded")


_encoder = msgspec.msgpack.Encoder(enc_hook=_plain_value)
