"""A fleet in a store, for tests of the dashboard: one machine that wears, worked on by a real twin, and others around it."""

import hashlib
import math
from pathlib import Path

from service_system import twin_file
from store_cases import outcome
from twin_messages import message_of

import servotwin as st
from servotwin import messages
from servotwin.messages import Hello, Reason, Receipt, Setting, Update, encode
from servotwin.store.records import EvidenceRecord, Incoming, MessageKind
from servotwin.store.store import Store, open_store
from servotwin.twin.evidence import plain
from servotwin.twin.work import work
from servotwin.twin_service.twin_file import read_twin

WEARING, SILENT = "ax-1", "ax-2"
"""A machine that wears, with the evidence of a real twin; one whose edge said hello and sent no window."""
PERIOD, WINDOW_S, RATE = 20.0, 1.5, 1000.0
SERVOS = """
[models.axis]
servo = "paper"
[models.axis.twin]
policy = "hysteresis"
gap_limit_deg = 20.0
[models.axis.twin.trend]
wear_deg = 10.0
over_s = 200.0
[servos]
"ax-*" = "axis"
"m-*" = "axis"
"""


def wearing_fleet(folder: Path, begun: float, steps: int = 6, others: int = 0) -> Path:
    """Make the twin's file with its store: windows of `WEARING` up to the time `begun`, s since the epoch."""
    path = twin_file(folder, servos=SERVOS)
    store = open_store(f"sqlite:///{folder}/twin.db")
    try:
        _wear(path, store, begun, steps)
        _say_hello(store, SILENT, begun - 3600.0)
        if others:
            add_machines(store, others, begun)
    finally:
        store.close()
    return path


def _wear(path: Path, store: Store, begun: float, steps: int) -> None:
    """Simulate, cut a window after each step, and let the twin work on each; every update is applied."""
    fleet, servo = read_twin(path).fleet, st.Servo.preset("paper")
    duration = steps * PERIOD / 2.0
    run = st.simulate(
        servo,
        duration=duration,
        reference=st.SquareWave(amplitude=1e-3, period=PERIOD),
        gap=st.SCurve(0.0, math.radians(12.0), duration=duration, begin=0.0),
        tolerance=servo.tolerance_for(math.radians(6.0)),
        sample_rate=RATE,
    )
    _say_hello(store, WEARING, begun - duration)
    version = 0
    for number in range(steps):
        start = number * PERIOD / 2.0 + 0.5
        cut = st.Window.from_run(run, start=start, duration=WINDOW_S)
        now = begun - duration + start + WINDOW_S
        sent = message_of(cut, number, servo=WEARING, version=version)
        body = encode(sent)
        key = f"{sent.boot}/{sent.sequence}"
        store.put([_incoming(MessageKind.WINDOW, key, body, now, WEARING, sent.boot, sent.sequence, sent.start)])
        for message in _worked(store, fleet, now):
            if isinstance(message, Update):
                version = message.version
                _answer(store, message, now + 0.5)
                _worked(store, fleet, now + 0.5)


def _worked(store: Store, fleet, now: float) -> list[messages.Message]:
    """Let the twin work on what is pending; its messages to the edge."""
    sent: list[messages.Message] = []
    for lease in store.lease("me", 10, 60.0, now):
        result = work(fleet, lease, now)
        assert store.commit([result], now) == [True]
        sent += [messages.decode(body) for body in result.outgoing]
    return sent


def _answer(store: Store, update: Update, now: float) -> None:
    receipt = Receipt(update.servo, update.version, True, 100, Reason.APPLIED, update.version, "b")
    _letter(store, update.servo, encode(receipt), now)


def _say_hello(store: Store, servo: str, now: float) -> None:
    _letter(store, servo, encode(Hello(servo, "b", 0.0, RATE, 0, Setting(0.0), "m")), now)


def _letter(store: Store, servo: str, body: bytes, now: float) -> None:
    store.put([_incoming(MessageKind.LETTER, hashlib.sha256(body).hexdigest(), body, now, servo)])


def _incoming(kind, key, body, now, servo, boot="", sequence=0, start=0.0) -> Incoming:
    plain_letter = Incoming(servo, kind, key, body, "", hashlib.sha256(body).digest(), now)
    return plain_letter._replace(boot=boot, sequence=sequence, start=start)


def add_machines(store: Store, count: int, now: float) -> None:
    """Add machines with one made-up estimate and trend each: only their number matters."""
    names = [f"m-{number:04d}" for number in range(count)]
    store.put([_incoming(MessageKind.WINDOW, "b/1", b"none", now - i, name, "b", 1) for i, name in enumerate(names)])
    while leases := store.lease("me", 1000, 60.0, now):
        store.commit([_made_up(lease, int(lease.servo[2:])) for lease in leases if lease.servo.startswith("m-")], now)


def _made_up(lease, number: int):
    gap, std = math.radians(2.0 + number % 17), math.radians(0.05)
    trend = {"time": 0.0, "mean": [gap, 1e-6 * (number % 5), 0.0], "covariance": [std**2, 0, 0, 0, 1e-14, 0, 0, 0, 0]}
    return outcome(
        lease,
        EvidenceRecord("estimate", lease.messages[0].id, plain({}), 1, gap, std, "ok"),
        EvidenceRecord("trend", lease.messages[0].id, plain(trend), gap=gap, std=std),
    )
