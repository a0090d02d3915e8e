"""A fleet in a store, for tests of the dashboard: a machine that wears, worked on by a real twin, and others."""

import hashlib
from pathlib import Path

from service_system import twin_file
from store_cases import outcome

import servotwin as st
from servotwin.messages import Hello, Receipt, Setting, WindowMessage, encode
from servotwin.store.records import EvidenceRecord, Incoming, MessageKind
from servotwin.store.store import Store, open_store
from servotwin.twin.evidence_rows import plain
from servotwin.twin.work import work
from servotwin.twin_service.twin_file import read_twin

WEARING, SILENT = "ax-1", "ax-2"
"""A machine that wears, with the evidence of a real twin; one whose edge said hello and sent no window."""
SECONDS = 40.0
TWIN = """
policy = "hysteresis"
gap_limit_deg = 20.0
validity_s = 60.0
initial_gap_deg = 4.0
"""
TREND = "wear_deg = 4.0\nover_s = 80.0"
SERVOS = f"""
[models.axis]
servo = "paper"
[models.axis.controller]
sample_rate_hz = 1000.0
[models.axis.twin]{TWIN}
[models.axis.twin.trend]
{TREND}
[servos]
"ax-*" = "axis"
"m-*" = "axis"
"""
SCENARIO = f"""
servo = "paper"
name = "{WEARING}"
duration_s = {SECONDS}
reference = {{ kind = "square", amplitude_mm = 1.0, period_s = 20.0 }}
gap = {{ from_deg = 4.0, to_deg = 6.0, over_s = {SECONDS} }}
controller = {{ sample_rate_hz = 1000.0 }}
recording = {{ sample_rate_hz = 1000.0 }}
link = {{ delay_s = 0.1 }}
[twin]{TWIN}
[twin.trend]
{TREND}
"""


def wearing_fleet(folder: Path, ended: float, others: int = 0, service: str = "") -> Path:
    """Make the twin's file with its store; `ended`: end of what `WEARING` sent, s since the epoch."""
    path = twin_file(folder, service, servos=SERVOS)
    store = open_store(f"sqlite:///{folder}/twin.db")
    try:
        _wear(path, store, ended - SECONDS)
        say_hello(store, SILENT, ended - 3600.0)
        if others:
            add_machines(store, others, ended)
    finally:
        store.close()
    return path


def recorded_windows(folder: Path, seconds: float) -> tuple[WindowMessage, ...]:
    """Windows of `WEARING`, also of the time after what `wearing_fleet` stores."""
    scenario = folder / "longer.toml"
    scenario.write_text(SCENARIO)
    return st.cosimulate(st.Scenario.load(scenario).replace(duration=seconds)).windows


def _wear(path: Path, store: Store, begun: float) -> None:
    """Let a deployed twin work on what the edge of a co-simulation sent."""
    scenario = path.parent / "scenario.toml"
    scenario.write_text(SCENARIO)
    loop, fleet = st.cosimulate(st.Scenario.load(scenario)), read_twin(path).fleet
    say_hello(store, WEARING, begun, "boot-1")
    for sent in (copy for copy in loop.messages if copy.direction == "up"):
        message, now = sent.message, begun + sent.arrival
        if isinstance(message, WindowMessage):
            key = f"{message.boot}/{message.sequence}"
            placed = (WEARING, message.boot, message.sequence, message.start)
            store.put([_incoming(MessageKind.WINDOW, key, sent.data, now, *placed)])
        elif isinstance(message, Receipt):
            _letter(store, WEARING, sent.data, now)
        for lease in store.lease("me", 10, 60.0, now):
            assert store.commit([work(fleet, lease, now)], now) == [True]


def say_hello(store: Store, servo: str, now: float, boot: str = "b") -> None:
    """Store the first word of an edge."""
    _letter(store, servo, encode(Hello(servo, boot, 0.0, 1000.0, 0, Setting(0.0), "m")), now)


def _letter(store: Store, servo: str, body: bytes, now: float) -> None:
    store.put([_incoming(MessageKind.LETTER, hashlib.sha256(body).hexdigest(), body, now, servo)])


def _incoming(kind, key, body, now, servo, boot="", sequence=0, start=0.0) -> Incoming:
    bare = Incoming(servo, kind, key, body, "", hashlib.sha256(body).digest(), now)
    return bare._replace(boot=boot, sequence=sequence, start=start)


def add_machines(store: Store, count: int, now: float) -> None:
    """Add machines with one made-up estimate and trend each: only their number matters."""
    names = [f"m-{number:04d}" for number in range(count)]
    store.put([_incoming(MessageKind.WINDOW, "b/1", b"none", now - i, name, "b", 1) for i, name in enumerate(names)])
    while leases := store.lease("me", 1000, 60.0, now):
        made = [_made_up(lease, int(lease.servo[2:])) for lease in leases if lease.servo.startswith("m-")]
        assert all(store.commit(made, now))


def _made_up(lease, number: int):
    gap, std = 0.035 + 0.0175 * (number % 17), 9e-4
    trend = {"time": 0.0, "mean": [gap, 1e-6 * (number % 5), 0.0], "covariance": [std**2, 0, 0, 0, 1e-14, 0, 0, 0, 0]}
    window = lease.messages[0].id
    return outcome(
        lease,
        EvidenceRecord("estimate", window, plain({}), 1, gap, std, "ok"),
        EvidenceRecord("trend", window, plain(trend), gap=gap, std=std),
    )
