"""Evidence of a twin as rows for the store.

Bodies are MessagePack, every double with all its bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from servotwin.estimation.estimate import LastContact, MachineReading
from servotwin.estimation.learning.trend import TrendSettings
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
    encode,
    finite,
)
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.policy import Redesign
from servotwin.store.records import EvidenceRecord
from servotwin.twin.evidence import (
    ActRecord,
    AlarmRecord,
    DisturbanceRecord,
    ExcitationRecord,
    GapEstimateRecord,
    GlanceRecord,
    MachineRecord,
    MessageRecord,
    MotorRecord,
    ProposalRecord,
    Record,
    RedesignRecord,
    TrendRecord,
    VerificationRecord,
    WithdrawalRecord,
)
from servotwin.twin.lookups import VerificationRequest

MAX_STATUS = 300
"""Characters of a status; the rest is in the body."""


class StoredExpectation(Struct, frozen=True):
    """An `Expectation` as plain numbers."""

    previous: float
    trend: TrendState | None
    machine: MachineReading | None = None
    contact: LastContact | None = None

    @classmethod
    def of(cls, expected: Expectation) -> StoredExpectation:
        """The numbers of an expectation."""
        trend = None if expected.trend is None else TrendState.of(expected.trend)
        machine = None if expected.machine is None else expected.machine.reading
        return cls(float(expected.previous), trend, machine, expected.contact)

    def expectation(self, settings: TrendSettings) -> Expectation:
        """Make the expectation again, bit for bit."""
        trend = None if self.trend is None else self.trend.trend(settings)
        machine = None if self.machine is None else FactorPrior.of_reading(self.machine)
        return Expectation(self.previous, trend, machine, self.contact)


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
        case Update() | Request() | LearntResponse() | Receipt() | Fallback() | Answer() | Hello():
            return _row_of_message(record)
    raise TypeError(f"{type(record).__name__} is not a record of evidence")


def _row_of_message(message: MessageRecord) -> EvidenceRecord:
    """Make the row of a message that was sent or received."""
    match message:
        case Update():
            window_key = "{}/{}".format(*message.window)
            row = _sent("update", message, message.status, message.version)
            return row._replace(gap=message.gap, std=message.std, window=window_key)
        case Request():
            return _sent("request", message, message.reason)
        case LearntResponse():
            spread = math.degrees(message.gap_std)
            return _sent("response", message, f"version {message.version} of the structure, gap to {spread:.2g} deg")
        case Receipt():
            return _sent("receipt", message, message.reason.value, message.version)
        case Fallback():
            return _sent("fallback", message, message.cause.value, message.replaced)
        case Answer():
            return _sent("answer", message, message.outcome.value)
        case _:
            return _sent("hello", message, message.boot, message.parameter_version)


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
