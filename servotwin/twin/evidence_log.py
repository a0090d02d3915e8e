"""Evidence of a twin in memory, for simulation and tests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.learning.machine import LearntMachine
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.learning.trend import Trend
from servotwin.messages import (
    Answer,
    Fallback,
    Hello,
    LearntResponse,
    Receipt,
    Request,
    Update,
    WindowMessage,
)
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.twin.evidence import (
    ActRecord,
    AlarmRecord,
    DisturbanceRecord,
    ExcitationRecord,
    GapEstimateRecord,
    GlanceRecord,
    MachineRecord,
    MotorRecord,
    ProposalRecord,
    Record,
    RedesignRecord,
    TrendRecord,
    VerificationRecord,
    WithdrawalRecord,
)
from servotwin.twin.lookups import VerificationRequest
from servotwin.twin.oversight import Proposal
from servotwin.twin.triage import Glance

WindowId = tuple[str, str, int]
"""(servo, boot, sequence) of a window."""


@dataclass
class EvidenceLog:
    """Windows and evidence in memory."""

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
