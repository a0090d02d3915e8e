"""Windows simulated beforehand, of the deployed loop at several gaps, and the twin's state after some of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import msgspec

from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.messages import Update, WindowMessage, decode, encode
from servotwin.plant.noise import Noise
from servotwin.store.records import Lease, MessageKind, StoredMessage
from servotwin.twin.model_registry import ModelRegistry
from servotwin.twin.settings import TriageSettings
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
    """

    gap: float
    first: tuple[WindowMessage, ...]
    windows: tuple[WindowMessage, ...]


def stock(places: int, windows: int, seed: int = 0) -> list[WindowSource]:
    """Steady loops at `places` gaps, `windows` (an even number) of each, with a bias and a little noise."""
    return [_place(number, windows, seed + number) for number in range(places)]


def _place(number: int, windows: int, seed: int) -> WindowSource:
    base = Scenario.preset("certified")
    gap = FIRST_GAP + number * GAP_STEP
    scenario = base.replace(
        gap=gap,
        seed=seed,
        duration=PERIOD * (SETTLED + windows) - 0.5 * PERIOD,
        recording=replace(base.recording, sample_rate=RATE),
        controller=base.law.replace(sample_rate=RATE),
        noise=NOISE,
        twin=base.twin.replace(triage=TriageSettings()),
        name="axis",
    )
    recorded = cosimulate(scenario).windows
    return WindowSource(gap, tuple(recorded[:SETTLED]), tuple(recorded[SETTLED : SETTLED + windows]))


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


def commissioned(fleet: ModelRegistry, servo: str, place: WindowSource) -> CommissionedTwin:
    """Compute a twin's state after a servo's first windows, with its updates applied and verifications done."""
    state, version = b"", 0
    learnt = (*place.first, *place.windows)[: SETTLED + 2]
    for number, recorded in enumerate(learnt):
        start = COMMISSIONED + (number - len(learnt)) * PERIOD
        window = readdressed(recorded, servo, number, start, version)
        outcome = work(fleet, _claim(servo, state, number, MessageKind.WINDOW, encode(window)), start)
        state = outcome.state
        sent = [decode(body) for body in outcome.outgoing]
        # No receipt is needed: the next window, cut under the update, confirms it to the twin.
        version = max([version, *(update.version for update in sent if isinstance(update, Update))])
        for request in outcome.enqueue:
            state = work(fleet, _claim(servo, state, number, MessageKind.VERIFICATION, request.body), start).state
    return CommissionedTwin(msgspec.msgpack.decode(state, type=TwinState), version)


def _claim(servo: str, state: bytes, serial: int, kind: MessageKind, body: bytes) -> Lease:
    return Lease(servo, state, serial, (StoredMessage(serial + 1, kind, body, "", 0.0),))
