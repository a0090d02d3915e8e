"""Where a twin keeps its evidence: window -> estimate -> redesign -> update -> receipt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.messages import Answer, Fallback, Hello, Receipt, Request, Update, Window
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.twin.glance import Glance
from servotwin.twin.lookups import Question
from servotwin.twin.wear import Expectation

Identity = tuple[str, str, int]
"""(servo, boot, sequence) of a window."""


class Store(Protocol):
    """What a twin asks of its store. Each call returns only when the thing is safe."""

    def add_window(self, window: Window) -> bool:
        """Keep a window under its identity; False when it was there already."""
        ...

    def add_glance(self, window: Window, glance: Glance) -> None:
        """Keep what a glance at a window saw, and whether it was enough."""
        ...

    def add_estimate(self, window: Window, estimate: GapEstimate, expected: Expectation) -> None:
        """Keep what was estimated from a window, and what was expected of it."""
        ...

    def add_disturbance(self, window: Window, disturbance: Disturbance) -> None:
        """Keep input bias and noise as a window shows them."""
        ...

    def add_trend(self, window: Window, trend: Trend | None) -> None:
        """Keep what is known of the wear after a window; None: nothing yet."""
        ...

    def add_redesign(self, window: Window, redesign: Redesign) -> None:
        """Keep what was made of a window; where that is nothing, why."""
        ...

    def add_update(self, update: Update) -> None:
        """Keep an update before it is sent."""
        ...

    def add_receipt(self, receipt: Receipt) -> None:
        """Keep what the edge says it did."""
        ...

    def add_fallback(self, fallback: Fallback) -> None:
        """Keep what the edge did by itself."""
        ...

    def add_hello(self, hello: Hello) -> None:
        """Keep that the edge started or came back."""
        ...

    def add_excitation(self, window: Window, decision: Decision) -> None:
        """Keep what was asked for after a window, and why, or why nothing."""
        ...

    def add_request(self, request: Request) -> None:
        """Keep a request before it is sent."""
        ...

    def add_answer(self, answer: Answer) -> None:
        """Keep what the edge says to a request."""
        ...

    def add_question(self, question: Question) -> None:
        """Keep that a proof is still to come, and see to it."""
        ...

    def add_proof(self, question: Question, found: Certificate | NotVerified) -> None:
        """Keep what a proof showed."""
        ...

    def add_withdrawn(self, question: Question, why: str) -> None:
        """Keep that what was sent is taken back."""
        ...


@dataclass
class MemoryStore:
    """A store that forgets with its process; for simulation and tests."""

    windows: dict[Identity, Window] = field(default_factory=dict)
    glances: dict[Identity, Glance] = field(default_factory=dict)
    estimates: dict[Identity, GapEstimate] = field(default_factory=dict)
    disturbances: dict[Identity, Disturbance] = field(default_factory=dict)
    trends: dict[Identity, Trend | None] = field(default_factory=dict)
    redesigns: dict[Identity, Redesign] = field(default_factory=dict)
    updates: list[Update] = field(default_factory=list)
    receipts: list[Receipt] = field(default_factory=list)
    fallbacks: list[Fallback] = field(default_factory=list)
    hellos: list[Hello] = field(default_factory=list)
    excitations: dict[Identity, Decision] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)
    questions: list[Question] = field(default_factory=list)
    proofs: list[tuple[Question, Certificate | NotVerified]] = field(default_factory=list)
    withdrawn: list[tuple[Question, str]] = field(default_factory=list)

    def add_window(self, window: Window) -> bool:
        """Keep a window under its identity; False when it was there already."""
        new = window.identity not in self.windows
        self.windows.setdefault(window.identity, window)
        return new

    def add_glance(self, window: Window, glance: Glance) -> None:
        """Keep a glance."""
        self.glances[window.identity] = glance

    def add_estimate(self, window: Window, estimate: GapEstimate, _expected: Expectation) -> None:
        """Keep what was estimated from a window."""
        self.estimates[window.identity] = estimate

    def add_disturbance(self, window: Window, disturbance: Disturbance) -> None:
        """Keep bias and noise."""
        self.disturbances[window.identity] = disturbance

    def add_trend(self, window: Window, trend: Trend | None) -> None:
        """Keep the trend after a window."""
        self.trends[window.identity] = trend

    def add_redesign(self, window: Window, redesign: Redesign) -> None:
        """Keep what was made of a window."""
        self.redesigns[window.identity] = redesign

    def add_update(self, update: Update) -> None:
        """Keep an update."""
        self.updates.append(update)

    def add_receipt(self, receipt: Receipt) -> None:
        """Keep a receipt."""
        self.receipts.append(receipt)

    def add_fallback(self, fallback: Fallback) -> None:
        """Keep a fallback."""
        self.fallbacks.append(fallback)

    def add_hello(self, hello: Hello) -> None:
        """Keep a hello."""
        self.hellos.append(hello)

    def add_excitation(self, window: Window, decision: Decision) -> None:
        """Keep a decision."""
        self.excitations[window.identity] = decision

    def add_request(self, request: Request) -> None:
        """Keep a request."""
        self.requests.append(request)

    def add_answer(self, answer: Answer) -> None:
        """Keep an answer."""
        self.answers.append(answer)

    def add_question(self, question: Question) -> None:
        """Keep a question."""
        self.questions.append(question)

    def add_proof(self, question: Question, found: Certificate | NotVerified) -> None:
        """Keep a proof."""
        self.proofs.append((question, found))

    def add_withdrawn(self, question: Question, why: str) -> None:
        """Keep a withdrawal."""
        self.withdrawn.append((question, why))
