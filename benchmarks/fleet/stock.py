"""Windows simulated beforehand, of the deployed loop at several gaps, and the twin's state after some of them.

The loops have the twin of the bench itself, so that windows are recorded under the settings that it sends.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import msgspec

from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.messages import Reason, Receipt, Update, WindowMessage, decode, encode
from servotwin.plant.noise import Noise
from servotwin.plant.signals import SCurve
from servotwin.store.records import Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin.model_registry import ModelRegistry, ServoModel
from servotwin.twin.state import TwinState
from servotwin.twin.work import work

RATE = 1000.0
"""Hz: 2 s of five channels are 20 kB."""
PERIOD = 20.0
"""s from one change of the reference to the next: the paper's cadence."""
FIRST_GAP, GAP_STEP = math.radians(5.0), math.radians(1.0)
SETTLED = 4
"""Windows of a run that only the twin's commissioning sees: the first steps, and the first updates."""
NOISE = Noise(1e-6, (1.0, 400.0))
BOOT = "boot-1"
_MOVES_S = 5.0
"""s that the gap takes to move to the next place, while the loop rests before its last window."""
COMMISSIONED = 10 * PERIOD
"""s of sample time, at which a servo joins the bench; its twin has worked on the windows before."""


class WindowSource(NamedTuple):
    """One gap of the stock.

    Attributes
    ----------
    gap : float
        rad.
    first : tuple of Window
        From the loop's start on: the twin learns of the encoder's offset in these, if the later ones show one contact.
    windows : tuple of Window
        One after the other in the same steady loop; steps to one side and to the other take turns.
    moved : Window
        The next one, before which the gap moved to that of the next place: under the setting of this one.
    """

    gap: float
    first: tuple[WindowMessage, ...]
    windows: tuple[WindowMessage, ...]
    moved: WindowMessage


def stock(model: ServoModel, places: int, windows: int, seed: int = 0) -> list[WindowSource]:
    """Steady loops at `places` gaps, `windows` (an even number) of each, with a bias and a little noise."""
    gaps = [FIRST_GAP + number * GAP_STEP for number in range(places)]
    return [_place(model, gap, gaps[(n + 1) % places], windows, seed + n) for n, gap in enumerate(gaps)]


def _place(model: ServoModel, gap: float, after: float, windows: int, seed: int) -> WindowSource:
    base, count = Scenario.preset("certified"), SETTLED + windows
    scenario = base.replace(
        servo=model.servo,
        gap=SCurve(gap, after, _MOVES_S, PERIOD * count - 2.0 * _MOVES_S),
        seed=seed,
        duration=PERIOD * (count + 0.5),
        recording=replace(base.recording, sample_rate=RATE),
        noise=NOISE,
        twin=model.settings,
        name="axis",
    )
    recorded = cosimulate(scenario).windows
    return WindowSource(gap, tuple(recorded[:SETTLED]), tuple(recorded[SETTLED:count]), recorded[count])


def readdressed(window: WindowMessage, servo: str, sequence: int, start: float, version: int) -> WindowMessage:
    """Readdress measurements to another servo and time; the checksum, over the channels only, stays valid."""
    shift = start - window.start
    return msgspec.structs.replace(
        window,
        servo=servo,
        boot=BOOT,
        sequence=sequence,
        start=start,
        parameter_version=version,
        reference_changes=tuple((time + shift, value) for time, value in window.reference_changes),
    )


class CommissionedTwin(NamedTuple):
    """State of the twin of a servo that has run for a while, and the version of its parameters."""

    state: TwinState
    version: int


def commissioned(fleet: ModelRegistry, servo: str, place: WindowSource, zero: float = 0.0) -> CommissionedTwin:
    """Compute a twin's state after a servo's first windows, with its updates applied and verifications done.

    `zero`: s since the epoch at sample time 0. What a twin has learnt ages by the clock.
    """
    state, version = b"", 0
    learnt = (*place.first, *place.windows)[: SETTLED + 2]

    def process(kind: MessageKind, body: bytes, now: float) -> WorkResult:
        nonlocal state
        outcome = work(fleet, Lease(servo, state, 0, (StoredMessage(1, kind, body, "", now),)), now)
        state = outcome.state
        return outcome

    for number, recorded in enumerate(learnt):
        start = COMMISSIONED + (number - len(learnt)) * PERIOD
        window = readdressed(recorded, servo, number, start, version)
        outcome = process(MessageKind.WINDOW, encode(window), zero + start)
        for request in outcome.enqueue:
            process(MessageKind.VERIFICATION, request.body, zero + start)
        for update in (decode(body) for body in outcome.outgoing):
            if isinstance(update, Update):
                version = update.version
                process(MessageKind.LETTER, encode(_applied(update)), zero + start)
    return CommissionedTwin(msgspec.msgpack.decode(state, type=TwinState), version)


def _applied(update: Update) -> Receipt:
    return Receipt(update.servo, update.version, True, 1, Reason.APPLIED, update.version, BOOT)
