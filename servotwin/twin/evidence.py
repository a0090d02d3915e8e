"""What a twin finds and does, as rows for the store: bodies in MessagePack, every double with all its bits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend, TrendSettings
from servotwin.messages import (
    Answer,
    Fallback,
    Hello,
    ParameterMessage,
    Receipt,
    Request,
    Update,
    Window,
    encode,
    finite,
)
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.store.records import EvidenceRecord
from servotwin.twin.decode import decode_channel
from servotwin.twin.glance import Glance
from servotwin.twin.lookups import Question
from servotwin.twin.state import TrendState, restored_trend, trend_state
from servotwin.twin.wear import Expectation

LONGEST_STATUS = 300
"""Characters; the rest is in the body."""
_TAIL = 10  # the last one of so many parts of a window


class Prior(Struct, frozen=True):
    """What was expected of a window: an `Expectation`, as plain numbers."""

    previous: float
    trend: TrendState | None

    @classmethod
    def of(cls, expected: Expectation) -> Prior:
        """That of an expectation."""
        return cls(float(expected.previous), None if expected.trend is None else trend_state(expected.trend))

    def expectation(self, settings: TrendSettings) -> Expectation:
        """The expectation, bit for bit."""
        return Expectation(self.previous, None if self.trend is None else restored_trend(self.trend, settings))


class Estimated(Struct, frozen=True):
    """Body of an estimate: what an estimator said of a window of `boot`, and what it was told before."""

    estimate: msgspec.Raw
    prior: Prior
    boot: str


class Rows:
    """A twin's store that makes rows of what it is given, for one message after the other.

    Parameters
    ----------
    context : str
        Key of what is computed under.

    Attributes
    ----------
    message : int
        Id of the message that everything now follows from; 0: none.
    found : list of EvidenceRecord
    questions : list of Question
        What is still to be proved.
    """

    def __init__(self, context: str) -> None:
        self.context, self.message = context, 0
        self.found: list[EvidenceRecord] = []
        self.questions: list[Question] = []

    def add_window(self, _window: Window) -> bool:
        """It is in the store already, or it would not be here."""
        return True

    def add_glance(self, window: Window, glance: Glance) -> None:
        """What a glance saw: all there is of a window of which it was enough."""
        gap, std, version = finite(glance.gap), finite(glance.std), window.parameter_version
        self._computed("glance", plain(glance), glance.why, version=version, gap=gap, std=std, tail=tail_of(window))

    def add_estimate(self, window: Window, estimate: GapEstimate, expected: Expectation) -> None:
        """With its prior, so that it can be made again."""
        body = Estimated(msgspec.Raw(plain(estimate)), Prior.of(expected), window.boot)
        self._computed(
            "estimate",
            plain(body),
            estimate.status.value,
            version=window.parameter_version,
            gap=finite(estimate.gap),
            std=finite(estimate.std_total),
            tail=tail_of(window),
        )

    def add_disturbance(self, _window: Window, disturbance: Disturbance) -> None:
        """Input bias and noise."""
        self._computed("disturbance", plain(disturbance), "; ".join(disturbance.reasons))

    def add_trend(self, _window: Window, trend: Trend | None) -> None:
        """Gap and wear; nothing before there is a trend."""
        if trend is not None:
            state, reasons = plain(trend_state(trend)), "; ".join(trend.reasons)
            self._computed("trend", state, reasons, gap=finite(trend.gap), std=finite(trend.gap_std))

    def add_redesign(self, _window: Window, redesign: Redesign) -> None:
        """What was made of a window, or why nothing."""
        self._computed("redesign", plain(_parts(redesign)), redesign.reason, gap=finite(redesign.gap))

    def add_excitation(self, _window: Window, decision: Decision) -> None:
        """What was asked for, or why nothing."""
        self._computed("excitation", plain(decision), decision.reason)

    def add_update(self, update: Update) -> None:
        """An update on its way."""
        window = "{}/{}".format(*update.window)
        values = {"version": update.version, "gap": update.gap, "std": update.std, "window": window}
        self._computed("update", encode(update), update.status, **values)

    def add_request(self, request: Request) -> None:
        """A request on its way."""
        self._message("request", request, request.reason)

    def add_receipt(self, receipt: Receipt) -> None:
        """What became of an update."""
        self._message("receipt", receipt, receipt.reason.value, receipt.version)

    def add_fallback(self, fallback: Fallback) -> None:
        """What the edge left."""
        self._message("fallback", fallback, fallback.cause.value, fallback.replaced)

    def add_answer(self, answer: Answer) -> None:
        """What became of a request."""
        self._message("answer", answer, answer.outcome.value)

    def add_question(self, question: Question) -> None:
        """A proof that is still to come."""
        self.questions.append(question)

    def add_proof(self, question: Question, found: Certificate | NotVerified) -> None:
        """What a proof showed of the setting that an update carries."""
        shown = found if isinstance(found, Certificate) else found.best
        body = {"question": question, "certificate": shown and _timeless(shown)}
        self._of_update("proof", question, plain(body), "" if isinstance(found, Certificate) else found.reason)

    def add_withdrawn(self, question: Question, why: str) -> None:
        """What is taken back."""
        self._of_update("withdrawn", question, plain({"version": question.version, "why": why}), why)

    def add_hello(self, hello: Hello) -> None:
        """A start of the edge."""
        self._message("hello", hello, hello.boot, hello.parameter_version)

    def _computed(self, kind: str, body: bytes, status: str, **values: Any) -> None:
        self.found.append(
            EvidenceRecord(kind, self.message, body, status=short(status), context=self.context, **values)
        )

    def _of_update(self, kind: str, question: Question, body: bytes, status: str) -> None:
        self._computed(kind, body, status, version=question.version, window="{}/{}".format(*question.window))

    def _message(self, kind: str, message: ParameterMessage, status: str, version: int | None = None) -> None:
        self.found.append(EvidenceRecord(kind, self.message, encode(message), version=version, status=short(status)))


def failed(message: int, why: str, body: Mapping[str, Any] | None = None) -> EvidenceRecord:
    """That nothing could be made of a message."""
    said = {"failed": why, **(body or {})}
    return EvidenceRecord("estimate", message, plain(said), status=short(f"failed: {why}"))


def plain(value: object) -> bytes:
    """MessagePack of dataclasses, structs and arrays; infinities and NaN stay what they are."""
    return _encoder.encode(value)


def short(status: str) -> str:
    """A status that every database takes."""
    return status.replace("\0", "")[:LONGEST_STATUS]


def tail_of(window: Window) -> float | None:
    """The largest tracking error (m) in the last tenth of a window; None: it lacks one of the channels."""
    position, reference = window.channel("position"), window.channel("reference")
    if position is None or reference is None:
        return None
    last = 2 * -(-window.samples // _TAIL)
    ends = (decode_channel(msgspec.structs.replace(each, data=each.data[-last:])) for each in (position, reference))
    return finite(float(np.max(np.abs(np.subtract(*ends)))))


def _parts(redesign: Redesign) -> dict[str, Any]:
    """Of its certificate all but how long it took, so that equal twins keep equal evidence."""
    parts = {field.name: getattr(redesign, field.name) for field in fields(redesign)}
    return {**parts, "certificate": redesign.certificate and _timeless(redesign.certificate)}


def _timeless(certificate: Certificate) -> dict[str, Any]:
    return {field.name: getattr(certificate, field.name) for field in fields(certificate) if field.compare}


def _plain_value(value: object) -> object:
    """What MessagePack knows of a number or an array of numpy's."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"evidence holds {type(value).__name__}, which has no place in it")


_encoder = msgspec.msgpack.Encoder(enc_hook=_plain_value)
