"""Leases of one servo, whose windows a simulated loop recorded, for tests of a worker."""

from functools import cache

from servotwin.control.gains import gains_of
from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.messages import (
    Reason,
    Receipt,
    Setting,
    Update,
    WindowMessage,
    encode,
)
from servotwin.store.records import Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin.model_registry import ModelRegistry, ServoModel

SCENARIO = Scenario.preset("fig15-sampled").replace(duration=45.0, name="axis")
START = Setting(SCENARIO.start_tolerance, gains_of(SCENARIO.start_law))
# Without drift, what is learnt does not depend on when the windows arrive.
QUICK = SCENARIO.twin.replace(
    method="whitened", estimator=None, retry=5.0, attempts=3, learning=LearningSettings(k_drift=0.0, c_drift=0.0)
)


def fleet(**changes) -> ModelRegistry:
    return ModelRegistry((ServoModel("m", SCENARIO.model, QUICK.replace(**changes), START),), (("axis", "m"),))


@cache
def loop() -> Loop:
    return cosimulate(SCENARIO.replace(twin=QUICK))


def windows() -> tuple[WindowMessage, ...]:
    return loop().windows


def claim(*sent, state=b"", received=None, serial=0, attempts=1) -> Lease:
    """Messages, or bytes, or (bytes, encoding), as the store would lend them; ids from 1 on."""
    bodies = [each if isinstance(each, tuple) else (each, "") for each in sent]
    bodies = [(body if isinstance(body, bytes) else encode(body), encoding) for body, encoding in bodies]
    times = received or [float(k) for k in range(len(bodies))]
    stored = [StoredMessage(k + 1, MessageKind.WINDOW, *each, times[k]) for k, each in enumerate(bodies)]
    return Lease("axis", state, serial, tuple(stored), attempts)


def kinds(outcome: WorkResult, message: int) -> list[str]:
    return [row.kind for row in outcome.evidence if row.message == message]


def statuses(outcome: WorkResult, kind: str = "estimate") -> list[str]:
    return [row.status for row in outcome.evidence if row.kind == kind]


def receipt(update: Update, reason=Reason.APPLIED, in_force=None) -> Receipt:
    in_force = update.version if in_force is None else in_force
    return Receipt("axis", update.version, reason is Reason.APPLIED, 10, reason, in_force, update.window[0])
