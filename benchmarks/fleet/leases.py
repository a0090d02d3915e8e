"""Processor time of a worker for a window, in one process: `python -m benchmarks.fleet.leases`.

Each lease is of another servo, whose learnt numbers are its own: caches keyed by a machine's numbers do not help. The
digest of all results tells whether two versions of the code compute the same, bit for bit.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Iterator, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from benchmarks.fleet.setting import FleetScale, build_table, write_file
from benchmarks.fleet.stock import COMMISSIONED, CommissionedTwin, WindowSource, commissioned, readdressed, stock
from servotwin.messages import WindowMessage, encode
from servotwin.store.records import Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin.model_registry import ModelRegistry
from servotwin.twin.work import Urgency, work

_OFF = 0.3  # standard deviations of the learnt numbers by which a servo's differ from those of its place
_SEQUENCE, _FIRST = 1000, 2  # number of a servo's window; windows of a place that its twin has learnt from
_URGENCY = Urgency(0.05, 1e6, others_wait=True, defer=True)
_KINDS = {"glance": 0.95, "deferral": 0.05, "estimate": 0.05}
"""Turns of workers, and how many of each a window needs where 5 % of the windows have news."""


class TimedLease(NamedTuple):
    """A lease, the time at which it is processed (s), and its kind."""

    lease: Lease
    now: float
    kind: str


def leases(
    registry: ModelRegistry, places: Sequence[WindowSource], glances: int, news: int, seed: int
) -> Iterator[TimedLease]:
    """Leases of windows with nothing new, and of windows with news: those come again, for their estimates."""
    rng, chance = np.random.default_rng(seed), random.Random(seed)
    known = [commissioned(registry, "ax-00000", place) for place in places]
    moved = [True] * news + [False] * glances
    chance.shuffle(moved)
    for number, new in enumerate(moved):
        index = number % len(places)
        routine = places[index].windows[chance.randrange(_FIRST, len(places[index].windows))]
        lease, now = _lease(number, known[index], places[index].moved if new else routine, rng)
        result = work(registry, lease, now, _URGENCY)
        yield TimedLease(lease, now, "deferral" if result.deferred else "glance")
        if result.deferred:
            yield TimedLease(lease._replace(estimate=True), now, "estimate")


def _lease(number: int, twin: CommissionedTwin, window: WindowMessage, rng: np.random.Generator) -> tuple[Lease, float]:
    """Lease of a servo whose machine differs from that of the twin, and the time at which its window is processed."""
    name, start, learnt = f"ax-{number:05d}", COMMISSIONED + 0.01 * number, twin.state.wear.machine
    assert learnt is not None
    factors = np.array(learnt.factors)
    root = np.linalg.cholesky(np.array(learnt.covariance).reshape(factors.size, -1))
    own = replace(learnt, factors=tuple((factors + _OFF * root @ rng.standard_normal(factors.size)).tolist()))
    state = replace(twin.state, servo=name, wear=replace(twin.state.wear, machine=own))
    body = encode(readdressed(window, name, _SEQUENCE, start, twin.version))
    message = StoredMessage(number + 1, MessageKind.WINDOW, body, "", start + 2.1)
    return Lease(name, msgspec.msgpack.encode(state), 5, (message,)), start + 2.2


def digest(results: Sequence[WorkResult]) -> str:
    """Digest of results without their contexts, which name the version of the code."""
    hashed = blake2b(digest_size=8)
    for result in results:
        evidence = tuple(record._replace(context="") for record in result.evidence)
        hashed.update(msgspec.msgpack.encode(result._replace(evidence=evidence, contexts=())))
    return hashed.hexdigest()


def main() -> None:
    """Measure, and print the result."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet.leases", description=__doc__)
    parser.add_argument("--glances", type=int, default=400)
    parser.add_argument("--news", type=int, default=60)
    parser.add_argument("--places", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3, help="the least time of so many counts")
    parser.add_argument("--seed", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, scale = Path(name), FleetScale()
        build_table(folder, scale)
        registry = write_file(folder, scale)
        places = stock(registry.models[0], given.places, 8)
        turns = list(leases(registry, places, given.glances, given.news, given.seed))
        results = [work(registry, turn.lease, turn.now, _URGENCY) for turn in turns]
        # All of them before the first comes again: caches hold what belongs to the last few.
        spent = np.min([[_seconds(registry, turn) for turn in turns] for _ in range(given.rounds)], axis=0)
    of_kind = {kind: spent[[turn.kind == kind for turn in turns]] for kind in _KINDS}
    means = {kind: 1e3 * float(np.mean(seconds)) for kind, seconds in of_kind.items()}
    for kind, mean in means.items():
        print(f"{kind}: {mean:.3f} ms of processor time, mean of {of_kind[kind].size}")
    print(f"a window, 5 % with news: {sum(_KINDS[kind] * mean for kind, mean in means.items()):.2f} ms")
    print(f"digest of the results: {digest(results)}")


def _seconds(registry: ModelRegistry, turn: TimedLease) -> float:
    begin = time.thread_time()
    work(registry, turn.lease, turn.now, _URGENCY)
    return time.thread_time() - begin


if __name__ == "__main__":
    main()
