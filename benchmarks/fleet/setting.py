"""Preparation of a bench: the twin's file, its table of certificates, a store with commissioned servos."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path

import msgspec

from benchmarks.fleet.stock import BOOT, COMMISSIONED, RATE, CommissionedTwin, WindowSource, commissioned
from servotwin.config.table import parse_toml
from servotwin.messages import Hello, Setting, encode
from servotwin.redesign.certified.lookup import Grid
from servotwin.redesign.certified.lookup_file import build
from servotwin.redesign.registry import certified_policy
from servotwin.store.records import Incoming, MessageKind, WorkResult
from servotwin.store.store import Store, open_store
from servotwin.twin.model_registry import ModelRegistry, models_of
from servotwin.twin.state import TwinState

STORE, TABLE = "fleet.db", "axis.table"
GRID = Grid(math.radians(4.0), (1e-3, 1e-2), (0.0,))
_TOGETHER = 256
_FILE = """
[service]
port = 0
store = "sqlite:///{store}"
workers = {workers}
verifications_per_minute = {verifications}
speed = 1e6
rate_limit_per_s = 1000.0
log_level = "warning"

[models.axis]
servo = "paper"

[models.axis.controller]
sample_rate_hz = {rate}

[models.axis.twin]
enabled = {enabled}
retry_s = {retry}
table = "{table}"

[models.axis.twin.uncertainty]
gap_deg = [0.0, 30.0]

[models.axis.twin.triage]
every = {every}

[servos]
"ax-*" = "axis"
"""


@dataclass(frozen=True)
class FleetScale:
    """Size of a bench.

    Attributes
    ----------
    servos : int
    rate : float
        Windows/s of all of them: each servo sends one every servos / rate s.
    news : float
        Share of windows with which the gap has moved.
    steady, outage, after : float
        s, length of the phases: undisturbed, without the link, and with it again.
    ingest : float
        s, for the rate of ingest alone.
    places, windows : int
        Of the stock: gaps, and windows of each.
    workers, connections : int
    verifications : float
        Verifications per minute, at most.
    every : int
        At least every so many windows of a servo one is estimated.
    """

    servos: int = 10_000
    rate: float = 500.0
    news: float = 0.05
    steady: float = 60.0
    outage: float = 20.0
    after: float = 40.0
    ingest: float = 10.0
    places: int = 12
    windows: int = 16
    workers: int = 2
    connections: int = 64
    verifications: float = 6.0
    every: int = 50

    def full(self) -> FleetScale:
        """The full bench: five minutes, and an outage of ten."""
        return replace(self, steady=300.0, outage=600.0, after=600.0)

    def of(self, servos: int) -> FleetScale:
        """The same of another number of servos, each of which sends as often."""
        return replace(self, servos=servos, rate=self.rate * servos / self.servos)


QUICK = FleetScale(200, 20.0, 0.1, 3.0, 1.0, 2.0, 1.0, 2, 2, 1, 4)


def build_table(folder: Path, scale: FleetScale) -> None:
    """Write the table of certificates that every twin of the bench uses."""
    text = _text(scale, enabled=True)
    (model,) = models_of(parse_toml(text, "twin.toml"), folder, checked=False)
    for _ in build(folder / TABLE, certified_policy(model.servo, model.settings), GRID):
        pass


def write_file(folder: Path, scale: FleetScale, enabled: bool = True) -> ModelRegistry:
    """Write the twin's file beside the table; return the models in it."""
    text = _text(scale, enabled)
    (folder / "twin.toml").write_text(text, encoding="utf-8")
    return ModelRegistry.loads(text, "twin.toml", folder)


def commission(
    folder: Path, fleet: ModelRegistry, scale: FleetScale, places: Sequence[WindowSource]
) -> list[CommissionedTwin]:
    """Fill a store with twins that know their servos.

    One twin of each place learns, and is returned; the others get a copy of its state.
    """
    zero = time.time() - COMMISSIONED
    known = [commissioned(fleet, "ax-00000", place, zero) for place in places]
    store = open_store(f"sqlite:///{folder / STORE}")
    try:
        for first in range(0, scale.servos, _TOGETHER):
            _introduce(store, range(first, min(first + _TOGETHER, scale.servos)), scale, known)
    finally:
        store.close()
    return known


def _introduce(store: Store, numbers: range, scale: FleetScale, known: Sequence[CommissionedTwin]) -> None:
    """Store the hello of some servos and the states of their twins."""
    now = time.time()
    states = {f"ax-{n:05d}": known[n % len(known)].state for n in numbers}
    ages = _ages(scale, numbers)
    store.put([_hello(servo, now) for servo in states])
    claims = store.lease("bench", len(states), 60.0, now)
    made = [
        WorkResult(
            claim.servo,
            claim.serial,
            _named(states[claim.servo], claim.servo, ages[claim.servo]),
            None,
            tuple(message.id for message in claim.messages),
        )
        for claim in claims
    ]
    if not all(store.commit(made, now)) or len(made) < len(states):
        raise RuntimeError("servos could not be commissioned")


def _ages(scale: FleetScale, numbers: range) -> dict[str, int]:
    """Number of glances of each servo since its last estimate, as if the bench had run for hours."""
    chance, since = random.Random(numbers.start), range(scale.every - 1)
    likely = [(1.0 - scale.news) ** count for count in since]
    return {f"ax-{n:05d}": chance.choices(since, likely)[0] for n in numbers}


def _named(state: TwinState, servo: str, glances: int) -> bytes:
    """Copy a twin's state for another servo."""
    assert state.triage is not None
    triage = msgspec.structs.replace(state.triage, glances=glances)
    return msgspec.msgpack.encode(msgspec.structs.replace(state, servo=servo, triage=triage))


def _hello(servo: str, now: float) -> Incoming:
    body = encode(Hello(servo, BOOT, COMMISSIONED, RATE, 0, Setting(0.0), "axis"))
    digest = blake2b(body, digest_size=16).digest()
    return Incoming(servo, MessageKind.LETTER, digest.hex(), body, "", digest, now)


def _text(scale: FleetScale, enabled: bool) -> str:
    values = {
        "store": STORE,
        "table": TABLE,
        "workers": scale.workers,
        "verifications": scale.verifications,
        "every": scale.every,
        "rate": RATE,
        # A servo polls once in a period: an update that is sent again before is sent in vain.
        "retry": 1.5 * scale.servos / scale.rate,
    }
    return _FILE.format(**values, enabled=str(enabled).lower())
