"""A twin in this process: the state between its steps, and a log of its evidence, for simulation and tests."""

from __future__ import annotations

from servotwin.estimation.learning.trend import Trend
from servotwin.messages import Acknowledge, InvalidMessage, Message, WindowMessage
from servotwin.twin.evidence_log import EvidenceLog
from servotwin.twin.lookups import VerificationRequest
from servotwin.twin.model import TwinModel
from servotwin.twin.state import encode_state
from servotwin.twin.step import Event, Wake, WindowArrival, next_wake, step


class Twin:
    """The twin of one servo: messages and time in, messages out.

    A window is logged, then acknowledged, then estimated, once: a second copy is only acknowledged.

    Parameters
    ----------
    servo : str
        Name of the servo whose messages it processes.
    model : TwinModel
    log : EvidenceLog, optional
    state : bytes, optional
        Earlier value of `state`, from which the twin continues.

    Raises
    ------
    InvalidInput
        The state cannot be read, or belongs to another servo.
    """

    def __init__(self, servo: str, model: TwinModel, log: EvidenceLog | None = None, state: bytes = b"") -> None:
        self.servo, self.model = servo, model
        self.log = EvidenceLog() if log is None else log
        self._state = model.restored(servo, state) if state else model.initial_state(servo)

    @property
    def trend(self) -> Trend | None:
        """Gap and rate of wear from all accepted windows, in the sample time of the edge's boot."""
        return self._state.wear.trend(self.model.settings.trend)

    def state(self) -> bytes:
        """Encoded state of the twin; equal twins give equal bytes."""
        return encode_state(self._state)

    def restore(self, state: bytes) -> None:
        """Continue from an earlier state of this servo's twin, under the present settings.

        Raises
        ------
        InvalidInput
            The state cannot be read, or belongs to another servo.
        """
        self._state = self.model.restored(self.servo, state)

    def receive(self, message: Message, now: float) -> list[Message]:
        """Process a message that arrived at `now` (s, the twin's own clock); return the messages to the edge.

        Raises
        ------
        InvalidMessage
            The message is for another servo, or of a kind that only an edge receives.
        """
        if not isinstance(message, WindowMessage):
            return self._step(message, now)
        if message.servo != self.servo:
            raise InvalidMessage(f"message of servo {message.servo!r} came to the twin of {self.servo!r}")
        sent: list[Message] = [Acknowledge(message.servo, message.boot, message.sequence)]
        return sent + self._step(WindowArrival(message, now), now) if self.log.add_window(message) else sent

    def verify(self, request: VerificationRequest, now: float) -> list[Message]:
        """Verify a setting that was looked up."""
        return self._step(request, now)

    def next_wake(self) -> float | None:
        """Time at which `wake` is due, s; None: no answer is pending."""
        return next_wake(self.model, self._state)

    def wake(self, now: float) -> list[Message]:
        """Return the messages whose answers are overdue, to be sent again."""
        return self._step(Wake(), now)

    def _step(self, event: Event, now: float) -> list[Message]:
        result = step(self.model, self._state, event, now)
        self._state = result.state
        self.log.add(result.evidence)
        return list(result.messages)
