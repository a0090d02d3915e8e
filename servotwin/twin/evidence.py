"""Evidence of a twin: typed records, as a step returns them."""

from __future__ import annotations

from typing import NamedTuple

from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.learning.machine import LearntMachine
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.learning.wear import Expectation
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
from servotwin.messages.acts import Act
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.twin.lookups import VerificationRequest
from servotwin.twin.oversight import Proposal
from servotwin.twin.triage import Glance


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


MessageRecord = Update | Request | LearntResponse | Receipt | Fallback | Answer | Hello
"""A message that is its own record: an update or a request sent, a receipt received."""

Record = (
    GlanceRecord | GapEstimateRecord | DisturbanceRecord | TrendRecord | MachineRecord | MotorRecord | AlarmRecord
    | RedesignRecord | ExcitationRecord | VerificationRecord | WithdrawalRecord | VerificationRequest
    | ProposalRecord | ActRecord | MessageRecord
)  # fmt: skip
"""Evidence of one step."""
