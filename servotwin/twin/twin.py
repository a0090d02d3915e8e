"""The twin of one servo: messages and time in, messages out."""

from __future__ import annotations

import math
from functools import partial

from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import Disturbance, disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.messages import (
    Acknowledge,
    Answer,
    Fallback,
    Hello,
    InvalidMessage,
    Message,
    Receipt,
    Setting,
    Update,
)
from servotwin.messages import Window as WindowMessage
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.evidence import Evidence
from servotwin.redesign.policy import Policy, Redesign
from servotwin.twin.delivery import Delivery
from servotwin.twin.drafting import draft
from servotwin.twin.estimating import UNUSABLE, Estimator, Observer, estimate_from, estimator_of, observed
from servotwin.twin.in_force import Settings
from servotwin.twin.lookups import Lookups, Question, question_of
from servotwin.twin.policies import policy_of
from servotwin.twin.requests import Requests, requests_of
from servotwin.twin.settings import TwinSettings
from servotwin.twin.state import Knowledge, pack, unpack
from servotwin.twin.store import Store
from servotwin.twin.triage import Triage
from servotwin.twin.versions import Versions
from servotwin.twin.wear import Wear

_STALE = "the window is not newer than what the parameters stand on, or of an earlier boot"


class Twin:
    """Turns windows into estimates and estimates into updates.

    A window is committed to the store, then acknowledged, then estimated, once: a second copy is only acknowledged.
    Windows may come in any order; every one is estimated, but only one that is newer than all before moves the
    parameters, the trend and the starting point of the next estimate. Only an estimate whose status is OK moves the
    trend, and one that does not fit it only once others agree. Of a window with another status a policy may use the
    rest, its input bias and noise, with the gap as the trend knows it.

    Parameters
    ----------
    servo : str
        Whose messages it takes.
    estimator : callable
        (identify.Window, Expectation) -> GapEstimate.
    policy : Policy
        Makes a setting of the evidence; where it raises InvalidInput, there is none.
    store : Store
        Evidence; `add_window` has to return only when the window is safe.
    settings : TwinSettings
    observer : callable, optional
        identify.Window -> Disturbance; None: nobody looks.
    start : Setting, optional
        In force at the edge before the first update; None: not known.
    requests : Requests, optional
        Asks for windows that tell more.
    triage : Triage, optional
        Says of which windows a glance is enough.
    """

    def __init__(
        self,
        servo: str,
        estimator: Estimator,
        policy: Policy,
        store: Store,
        settings: TwinSettings | None = None,
        observer: Observer | None = None,
        start: Setting | None = None,
        requests: Requests | None = None,
        triage: Triage | None = None,
    ) -> None:
        self.servo, self._requests = servo, requests
        self.settings = settings or TwinSettings()
        self._policy = Lookups(policy) if isinstance(policy, TablePolicy) else policy
        self._estimator, self._store, self._observer = estimator, store, observer
        self._versions, self._known = Versions(), Settings({} if start is None else {0: start})
        self._wear = Wear(self.settings.initial_gap, self.settings.trend)
        self._delivery = Delivery(self.settings.retry, self.settings.attempts)
        self._tuned_for: float | None = None
        self._triage = triage

    @classmethod
    def of(
        cls,
        name: str,
        servo: Servo,
        store: Store,
        settings: TwinSettings,
        estimator: Estimator | None = None,
        start: Setting | None = None,
        state: bytes | None = None,
        policy: Policy | None = None,
    ) -> Twin:
        """The twin that `settings` describe, for a servo of that name and model; `estimator`, `policy` replace theirs.

        The model's controller is the one that runs: policies design for it. With the `state` of an
        earlier twin of that servo it goes on where that one was.

        Raises
        ------
        InvalidInput
            The state is not understood, or another servo's.
        """
        redesigns = policy or policy_of(servo, settings)
        chosen = estimator or estimator_of(servo, settings)
        asks = requests_of(name, servo, settings)
        triage = None if settings.triage is None else Triage(servo, settings.triage)
        twin = cls(name, chosen, redesigns, store, settings, partial(disturbance, servo=servo), start, asks, triage)
        if state:
            twin.restore(state)
        return twin

    @property
    def trend(self) -> Trend | None:
        """Gap and rate of wear as known from all windows that counted, on the sample time of the edge's boot."""
        return self._wear.trend

    def state(self) -> bytes:
        """Everything that it knows, as `restore` takes it; equal twins give equal bytes."""
        return pack(self.servo, self._knowledge())

    def restore(self, state: bytes) -> None:
        """Know what an earlier twin of this servo knew, bit for bit; the settings stay its own.

        Raises
        ------
        InvalidInput
            The state is not understood, or another servo's.
        """
        knows = unpack(self.servo, state, self._knowledge())
        self._versions, self._known, self._wear, self._requests, self._delivery, self._tuned_for, self._triage, _ = (
            knows
        )

    def receive(self, message: Message, now: float) -> list[Message]:
        """What to send after a message that arrived at `now` (s, a clock of the twin's own).

        A window is stored, acknowledged and learnt from, unless the store has it already.

        Raises
        ------
        InvalidMessage
            The message is for another servo, or of a kind that only an edge receives.
        """
        self._check(message)
        if isinstance(message, WindowMessage):
            said: list[Message] = [Acknowledge(message.servo, message.boot, message.sequence)]
            return said + self.learn(message, now) if self._store.add_window(message) else said
        self._steady(now)
        if isinstance(message, Receipt):
            self._store.add_receipt(message)
            return self._send(self._versions.settle(message), now)
        if isinstance(message, Fallback):
            return self._fallen_back(message)
        if isinstance(message, Answer):
            self._store.add_answer(message)
            return [] if self._requests is None else [*self._requests.answered(message, self._store, now)]
        if isinstance(message, Hello):
            return self._greeted(message)
        raise InvalidMessage(f"a twin does not receive {type(message).__name__} messages")

    def next_wake(self) -> float | None:
        """When `wake` is due, s; None: nothing is waited for."""
        sent = self._delivery.next_wake(self._versions)
        asked = None if self._requests is None else self._requests.next_wake()
        return min((due for due in (sent, asked) if due is not None), default=None)

    def wake(self, now: float) -> list[Message]:
        """The pending update and request once more when their answers are overdue; given up after `attempts`."""
        self._steady(now)
        asked = [] if self._requests is None else self._requests.wake(now)
        return [*self._delivery.wake(self._versions, now), *asked]

    def learn(self, message: WindowMessage, now: float, arrived: float | None = None) -> list[Message]:
        """What to send after a window that is safe already, and new.

        Of a window that says nothing new at a glance, that is all that is made: it moves nothing.

        Parameters
        ----------
        message : messages.Window
        now : float
            s, a clock of the twin's own.
        arrived : float, optional
            When it arrived, on the same clock; `now` unless given. What passed between two boots of the edge is
            taken from it.

        Raises
        ------
        InvalidMessage
            The window is another servo's.
        """
        self._check(message)
        self._steady(now)
        self._versions.hear(message.boot, message.parameter_version)
        heard = now if arrived is None else arrived
        if self._triage is not None and self._triage.spares(message, self.trend, self._requests, self._store):
            return []
        expected = self._wear.expect(message.boot, message.middle, heard)
        estimate, disturbed = estimate_from(message, self._estimator, expected), observed(message, self._observer)
        self._store.add_estimate(message, estimate, expected)
        self._store.add_disturbance(message, disturbed)
        stale = not self._versions.admits(message)
        why_not = _STALE if stale else self._wear.refusal(message.boot, estimate, heard)
        self._store.add_trend(message, self.trend)
        if self._triage is not None and not stale:
            self._triage.learn(message, estimate, self.trend, why_not)
        unasked = stale or (why_not and self._policy.needs_estimate)
        redesign = Redesign(None, math.nan, why_not) if unasked else self._redesign(estimate, disturbed, why_not)
        self._store.add_redesign(message, redesign)
        asked = [] if stale else self._ask(message, estimate, now, heard)
        if redesign.setting is None:
            return asked
        self._tuned_for = redesign.gap
        update = self._versions.issue(draft(message, estimate, redesign, self.settings.validity))
        sent = self._send(update, now)
        if redesign.to_verify is not None:
            self._store.add_question(question_of(update, redesign))
        return sent + asked

    def prove(self, question: Question) -> None:
        """Prove what was looked up, and withdraw it where that fails: then the next update is the fallback set."""
        if not isinstance(self._policy, Lookups):
            raise InvalidInput("nothing is to be proved, as no table is used any more")
        why = self._policy.settle(question, [self._known.of(each) for each in self._versions.running], self._store)
        if why:
            self._versions.give_up()
            if self._triage is not None:
                self._triage.doubt(why)

    def _ask(self, message: WindowMessage, estimate: GapEstimate, now: float, heard: float) -> list[Message]:
        """A request, where windows tell too little."""
        if self._requests is None or estimate.method == UNUSABLE:
            return []
        expected = self._wear.expect(message.boot, estimate.time, heard)
        runs = self._known.of(self._versions.in_force)
        return [*self._requests.after(message, estimate, expected.widest, runs, self._store, now)]

    def _redesign(self, estimate: GapEstimate, disturbed: Disturbance, why_not: str) -> Redesign:
        now = self._known.of(self._versions.in_force)
        evidence = Evidence(estimate, disturbed, self.trend, now, self._tuned_for, why_not)
        try:
            return self._policy.redesign(evidence)
        except InvalidInput as error:
            return Redesign(None, math.nan, str(error))

    def _greeted(self, message: Hello) -> list[Message]:
        """The edge started, or came back."""
        self._store.add_hello(message)
        if self._versions.hear(message.boot, message.parameter_version):
            self._known.hear(message)
        return []

    def _fallen_back(self, message: Fallback) -> list[Message]:
        """The edge has left what this twin gave it: nothing made before is sent again."""
        self._store.add_fallback(message)
        if self._versions.hear(message.boot, message.parameter_version):
            self._versions.give_up()
            self._known.fall_back(message)
            self._tuned_for = None
            if self._triage is not None:
                self._triage.doubt("the edge has fallen back")
        return []

    def _send(self, update: Update | None, now: float) -> list[Message]:
        if update is None:
            return []
        self._store.add_update(update)
        self._known.issue(update, self._versions.in_force)
        return [*self._delivery.first(self._versions, now)]

    def _check(self, message: Message) -> None:
        if message.servo != self.servo:
            raise InvalidMessage(f"message of servo {message.servo!r} came to the twin of {self.servo!r}")

    def _steady(self, now: float) -> None:
        """Nothing happened later than now: a clock that was put back must not make anything wait for it."""
        self._delivery.steady(now)
        if self._requests is not None:
            self._requests.steady(now)

    def _knowledge(self) -> Knowledge:
        parts = self._versions, self._known, self._wear, self._requests, self._delivery
        return Knowledge(*parts, self._tuned_for, self._triage, self._policy)
