"""Processes are killed at random, again and again, over a bad network; then the disks are checked.

The suite kills each kind of process a few times; `make fuzz` explores with more machines, windows and kills.
"""

from collections.abc import Sequence
from pathlib import Path

import pytest
from deployment import Fleet, deployed, end_all, logs, until
from exploration import extent
from httprelay import Chances, HttpRelay
from killing import (
    Killer,
    check_controllers_ticked,
    check_exactly_once,
    check_kills_cost_little,
    check_updates,
    strike_until,
)
from mosquitto import broker
from records import pending, witnessed
from relay import Relay, Weather

SEED = 20
ROLES = ["control"] + ["supervise"] * extent(2, 7)
BAD = Chances(lost_before=0.08, lost_after=0.08, twice=0.08, held=0.08, delay_s=(0.1, 0.5), hold_s=2.0)
"""Each way: 0.2 to 1.0 s there and back."""
CUTS_S = (3.0, 6.0)


def finish(fleet: Fleet) -> None:
    """One update at least, which on a busy machine comes after the kills; no more windows; all end well."""
    until(lambda: check_updates(fleet) > 0, lambda: logs(fleet))
    fleet.stop_machines()
    deliver(fleet)
    while pending(fleet) > 0:  # what was on its way to the disk when the edges were asked to end
        for edge in fleet.edges.values():
            edge.start()
        deliver(fleet)
    assert fleet.twin.end() == 0


def deliver(fleet: Fleet) -> None:
    """Wait until nothing is left to send, and end the edges."""
    until(lambda: pending(fleet) == 0, lambda: logs(fleet))
    assert set(end_all(fleet.edges.values())) == {0}


def check(fleet: Fleet, sufficient: int, killer: Killer, counts: dict[str, int]) -> None:
    check_exactly_once(fleet, sufficient)
    check_kills_cost_little(fleet)
    check_controllers_ticked(fleet)
    applied = check_updates(fleet)
    observed = {kind: number for kind, number in counts.items() if "/" not in kind}
    print({"windows": len(witnessed(fleet)), "applied": applied, **killer.kills, **observed})
    assert applied > 0


def met(killer: Killer, relay: Relay, bad: Sequence[str]) -> bool:
    """True once each kind of process was killed and each kind of bad network was met."""
    return killer.dealt and all(relay.counts[kind] > 0 for kind in bad)


@pytest.mark.slow
@pytest.mark.random
def test_kills_and_a_bad_network_lose_no_window(tmp_path: Path) -> None:
    fleet, windows = Fleet(tmp_path, ROLES), extent(60, 450)
    killer = Killer(fleet, SEED, {"twin": 1, "edge": 2, "link": 1})
    bad_link = HttpRelay(fleet.port, BAD, SEED, Weather(cut_s=CUTS_S))
    with bad_link as relay, deployed(fleet, f"http://127.0.0.1:{relay.port}"):
        bad = ("lost before", "lost after", "twice", "held", "cut")
        strike_until(fleet, killer, windows, SEED, lambda: met(killer, relay, bad))
        relay.clear()
        finish(fleet)
    check(fleet, windows, killer, relay.counts)


@pytest.mark.slow
@pytest.mark.exploration
def test_kills_of_the_broker_too_lose_no_window(tmp_path: Path) -> None:
    windows = 250
    with broker(tmp_path / "broker") as server:
        fleet = Fleet(tmp_path, ROLES, f'[service.mqtt]\nurl = "{server.url}"')
        killer = Killer(fleet, SEED, {"twin": 1, "edge": 1, "link": 1, "broker": 1}, server)
        bad_link = Relay(server.port, Weather(delay_s=(0.1, 0.5), cut_s=CUTS_S), SEED)
        with bad_link as relay, deployed(fleet, f"mqtt://127.0.0.1:{relay.port}"):
            strike_until(fleet, killer, windows, SEED, lambda: met(killer, relay, ("cut",)))
            relay.clear()
            finish(fleet)
    check(fleet, windows, killer, relay.counts)
