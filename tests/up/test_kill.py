"""Processes are killed at random, again and again, over a bad network; then the disks are checked."""

from pathlib import Path

import pytest
from deployment import Fleet, deployed, end_all, logs, until
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
BAD = Chances(lost_before=0.05, lost_after=0.05, twice=0.05, held=0.05, delay_s=(0.1, 0.5), hold_s=2.0)
"""Each way: 0.2 to 1.0 s there and back."""
CUTS_S = (4.0, 8.0)


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


@pytest.mark.slow
def test_kills_and_a_bad_network_lose_no_window(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, ["control"] * 2 + ["supervise"] * 6)
    killer = Killer(fleet, SEED, {"twin": 2, "edge": 5, "link": 2})
    bad_link = HttpRelay(fleet.port, BAD, SEED, Weather(cut_s=CUTS_S))
    with bad_link as relay, deployed(fleet, f"http://127.0.0.1:{relay.port}"):
        strike_until(fleet, killer, 450, SEED)
        relay.clear()
        finish(fleet)
    check(fleet, 450, killer, relay.counts)
    assert min(killer.kills[what] for what in ("twin", "edge", "link")) > 0
    assert min(relay.counts[what] for what in ("lost before", "lost after", "twice", "held", "cut")) > 0


@pytest.mark.slow
def test_kills_of_the_broker_too_lose_no_window(tmp_path: Path) -> None:
    with broker(tmp_path / "broker") as server:
        fleet = Fleet(tmp_path, ["control"] * 2 + ["supervise"] * 6, f'[service.mqtt]\nurl = "{server.url}"')
        killer = Killer(fleet, SEED, {"twin": 2, "edge": 3, "link": 1, "broker": 2}, server)
        bad_link = Relay(server.port, Weather(delay_s=(0.1, 0.5), cut_s=(6.0, 12.0)), SEED)
        with bad_link as relay, deployed(fleet, f"mqtt://127.0.0.1:{relay.port}"):
            strike_until(fleet, killer, 250, SEED)
            relay.clear()
            finish(fleet)
    check(fleet, 250, killer, relay.counts)
    assert min(killer.kills[what] for what in ("twin", "edge", "broker")) > 0
    assert relay.counts["cut"] > 0
