"""Random kills of the processes of a fleet, and the invariants that must hold afterwards."""

import itertools
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

from deployment import EVERY, PATIENCE, RATE, WINDOW_S, Fleet
from mosquitto import Mosquitto
from records import count_witnessed, dropped, receipts, stored, witnessed

APART_S = 8.0
"""Kills of one edge: the second of two in one window's time would take a window of its own."""


def boot_number(boot: str) -> int:
    return int(boot.split("-")[0][1:])


def by_boot(result: set[tuple[str, str, int]]) -> dict[tuple[str, str], list[int]]:
    boots: dict[tuple[str, str], list[int]] = {}
    for servo, boot, sequence in sorted(result):
        boots.setdefault((servo, boot), []).append(sequence)
    return boots


def complete_windows(first: int, last: int) -> int:
    """Number of windows in samples first .. last - 1: each begins with a change of the reference outside another."""
    length, number, begin = round(WINDOW_S * RATE), 0, first
    while begin + length <= last:
        number += 1
        begin = -(-(begin + length) // EVERY) * EVERY
    return number


class Killer:
    """Kills what is there, one at a time, and starts it again after a while.

    The kinds come like cards of a deck that is shuffled again and again: even a few strikes meet all of them.

    Parameters
    ----------
    fleet : Fleet
    seed : int
    deck : mapping of str to int
        Cards of each kind: "twin", "edge", "link" (process of an edge) and "broker".
    broker : Mosquitto, optional
    """

    def __init__(self, fleet: Fleet, seed: int, deck: Mapping[str, int], broker: Mosquitto | None = None) -> None:
        self._fleet, self._random, self._deck, self._broker = fleet, Random(seed), deck, broker
        self._spared = {servo: time.monotonic() for servo in fleet.roles}
        self._cards: list[str] = []
        self.kills: Counter[str] = Counter()

    @property
    def dealt(self) -> bool:
        """True once every kind was struck."""
        return self._deck.keys() <= self.kills.keys()

    def strike(self) -> None:
        if not self._cards:
            self._cards = [kind for kind, number in self._deck.items() for _ in range(number)]
            self._random.shuffle(self._cards)
        what = self._cards.pop()
        getattr(self, what)()
        self.kills[what] += 1

    def twin(self) -> None:
        self._fleet.twin.kill()
        time.sleep(self._random.uniform(0.0, 1.5))
        self._fleet.twin.start()

    def edge(self) -> None:
        servo = self._victim()
        self._fleet.edges[servo].kill()
        time.sleep(self._random.uniform(0.0, 0.5))
        self._fleet.edges[servo].start()

    def link(self) -> None:
        """Only the process that speaks with the twin."""
        process = self._fleet.status(self._victim()).get("link_process")
        if process is not None and is_link(process):
            os.kill(process, signal.SIGKILL)

    def broker(self) -> None:
        assert self._broker is not None
        self._broker.kill()
        time.sleep(self._random.uniform(0.0, 1.0))
        self._broker.start()

    def _victim(self) -> str:
        servo = self._random.choice(list(self._fleet.roles))
        while time.monotonic() - self._spared[servo] < APART_S:
            servo = self._random.choice(list(self._fleet.roles))
            time.sleep(0.01)
        self._spared[servo] = time.monotonic()
        return servo


def is_link(process: int) -> bool:
    """True while that process id is still the link process's."""
    try:
        return b"servotwin.edge_process.link_process" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def strike_until(fleet: Fleet, killer: Killer, windows: int, seed: int, enough: Callable[[], bool]) -> None:
    """Strike until so many windows were recorded and `enough` else has happened too."""
    random = Random(seed)
    end = time.monotonic() + 3.0 * PATIENCE
    while count_witnessed(fleet) < windows or not enough():
        assert time.monotonic() < end, fleet.twin.log
        time.sleep(random.uniform(0.5, 2.5))
        killer.strike()


def check_exactly_once(fleet: Fleet, sufficient: int) -> None:
    """Every window that was ever in an outbox is in the store, once; nothing was dropped."""
    committed, kept = witnessed(fleet), Counter(stored(fleet))
    assert len(committed) >= sufficient
    assert dropped(fleet) == {}
    assert set(kept) == committed, sorted(set(kept) ^ committed)
    assert max(kept.values()) == 1


def check_kills_cost_little(fleet: Fleet) -> None:
    """No window is missing before the last ones of a boot: the one that was being cut, and the one before it, which may
    have been on its way to the outbox when the edge ended."""
    boots = by_boot(witnessed(fleet))
    assert all(numbers == list(range(len(numbers))) for numbers in boots.values())
    for servo, entries in fleet.connections().items():
        result = {boot_number(boot): len(numbers) for (name, boot), numbers in boots.items() if name == servo}
        assert len(entries) >= max(result)
        for number, entry in enumerate(entries, 1):
            possible = complete_windows(entry["first"], entry["last"])
            assert possible - 2 <= result.get(number, 0) <= possible, (servo, number, entry, result)


def check_controllers_ticked(fleet: Fleet) -> None:
    """Whenever there was an edge it answered every sample; only kills of its own ended a connection."""
    entries = [entry for entries in fleet.connections().values() for entry in entries]
    assert sum(entry["last"] - entry["first"] for entry in entries) > 0
    assert sum(entry["missed"] for entry in entries) == 0


def check_updates(fleet: Fleet) -> int:
    """Each version was applied once, and none after a newer one; how many there were."""
    applied = 0
    for servo, result in receipts(fleet).items():
        ordered = sorted(result, key=lambda receipt: (boot_number(receipt.boot), receipt.sample))
        versions = [receipt.version for receipt in ordered if receipt.applied]
        assert versions == sorted(set(versions)), (servo, versions)
        for before, after in itertools.pairwise(ordered):
            assert before.boot != after.boot or before.parameter_version <= after.parameter_version
        applied += len(versions)
    return applied
