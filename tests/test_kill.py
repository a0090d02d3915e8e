"""Everything is killed at random, again and again, over a bad network; then the disks are asked what became of it."""

import itertools
import os
import signal
import time
from collections import Counter
from pathlib import Path
from random import Random

import pytest
from deployment import (
    EVERY,
    PATIENCE,
    RATE,
    WINDOW_S,
    Fleet,
    count_witnessed,
    deployed,
    dropped,
    pending,
    receipts,
    stored,
    until,
    witnessed,
)
from httprelay import Chances, HttpRelay
from relay import Weather

SEED = 20
SUFFICIENT = 2000
APART_S = 8.0
"""Kills of one edge: the second of two in one window's time would take a window of its own."""
BAD = Chances(lost_before=0.05, lost_after=0.05, twice=0.05, held=0.05, delay_s=(0.1, 0.5), hold_s=2.0)
"""Each way: 0.2 to 1.0 s there and back."""


def boot_number(boot: str) -> int:
    return int(boot.split("-")[0][1:])


def by_boot(found: set[tuple[str, str, int]]) -> dict[tuple[str, str], list[int]]:
    boots: dict[tuple[str, str], list[int]] = {}
    for servo, boot, sequence in sorted(found):
        boots.setdefault((servo, boot), []).append(sequence)
    return boots


def complete_windows(first: int, last: int) -> int:
    """How many windows samples first .. last - 1 hold: each begins with a change of the reference outside another."""
    length, number, begin = round(WINDOW_S * RATE), 0, first
    while begin + length <= last:
        number += 1
        begin = -(-(begin + length) // EVERY) * EVERY
    return number


class Killer:
    """Kills what is there, one at a time, and lets it be started again after a while."""

    def __init__(self, fleet: Fleet, seed: int) -> None:
        self._fleet, self._random = fleet, Random(seed)
        self._spared = {servo: time.monotonic() for servo in fleet.roles}
        self.kills: Counter[str] = Counter()

    def strike(self) -> None:
        what = self._random.choices(("twin", "edge", "link"), (2, 5, 2))[0]
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

    def _victim(self) -> str:
        servo = self._random.choice(list(self._fleet.roles))
        while time.monotonic() - self._spared[servo] < APART_S:
            servo = self._random.choice(list(self._fleet.roles))
            time.sleep(0.01)
        self._spared[servo] = time.monotonic()
        return servo


def is_link(process: int) -> bool:
    """Whether that number is still the link process's."""
    try:
        return b"servotwin.gateway.linkprocess" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def strike_until(fleet: Fleet, killer: Killer, windows: int) -> None:
    random = Random(SEED)
    end = time.monotonic() + 3.0 * PATIENCE
    while count_witnessed(fleet) < windows:
        assert time.monotonic() < end, fleet.twin.log
        time.sleep(random.uniform(0.5, 2.5))
        killer.strike()


def check_exactly_once(fleet: Fleet, sufficient: int) -> None:
    """Every window that was ever in an outbox is in the store, once; nothing was dropped."""
    committed, kept = witnessed(fleet), Counter(stored(fleet))
    assert len(committed) >= sufficient
    assert dropped(fleet) == {}
    assert set(kept) == committed
    assert max(kept.values()) == 1


def check_kills_cost_little(fleet: Fleet) -> None:
    """No window is missing before the last one of a boot, and of that at most the one that was being cut."""
    boots = by_boot(witnessed(fleet))
    assert all(numbers == list(range(len(numbers))) for numbers in boots.values())
    for servo, entries in fleet.connections().items():
        found = {boot_number(boot): len(numbers) for (name, boot), numbers in boots.items() if name == servo}
        assert len(entries) >= max(found)
        for number, entry in enumerate(entries, 1):
            possible = complete_windows(entry["first"], entry["last"])
            assert possible - 1 <= found.get(number, 0) <= possible, (servo, number, entry, found)


def check_controllers_ticked(fleet: Fleet) -> None:
    """Whenever there was an edge it answered every sample; only kills of its own ended a connection."""
    entries = [entry for entries in fleet.connections().values() for entry in entries]
    assert sum(entry["last"] - entry["first"] for entry in entries) > 0
    assert sum(entry["missed"] for entry in entries) == 0


def check_updates(fleet: Fleet) -> int:
    """Each version was applied once, and none after a newer one; how many there were."""
    applied = 0
    for servo, found in receipts(fleet).items():
        ordered = sorted(found, key=lambda receipt: (boot_number(receipt.boot), receipt.sample))
        versions = [receipt.version for receipt in ordered if receipt.applied]
        assert versions == sorted(set(versions)), (servo, versions)
        for before, after in itertools.pairwise(ordered):
            assert before.boot != after.boot or before.parameter_version <= after.parameter_version
        applied += len(versions)
    return applied


@pytest.mark.slow
def test_kills_and_a_bad_network_lose_no_window(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, ["control"] * 4 + ["supervise"] * 20)
    with HttpRelay(fleet.port, BAD, SEED, Weather(cut_s=(4.0, 8.0))) as relay:
        with deployed(fleet, f"http://127.0.0.1:{relay.port}"):
            killer = Killer(fleet, SEED)
            strike_until(fleet, killer, SUFFICIENT)
            relay.clear()
            fleet.stop_machines()
            until(lambda: pending(fleet) == 0, f"outboxes empty: {fleet.twin.log}")
            assert [edge.end() for edge in fleet.edges.values()] == [0] * len(fleet.edges)
            assert fleet.twin.end() == 0
        counts = relay.counts
    check_exactly_once(fleet, SUFFICIENT)
    check_kills_cost_little(fleet)
    check_controllers_ticked(fleet)
    applied = check_updates(fleet)
    print(
        dict(windows=len(witnessed(fleet)), applied=applied, **killer.kills),
        {k: v for k, v in counts.items() if "/" not in k},
    )
    assert min(killer.kills[what] for what in ("twin", "edge", "link")) > 0
    assert min(counts[what] for what in ("lost before", "lost after", "twice", "held", "cut")) > 0
    assert applied > 0
