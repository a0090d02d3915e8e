"""A twin that is stopped for a while, as by SIGSTOP or a closed lid: what it held, and by which clock it goes on."""

import time
from contextlib import closing

import pytest
from postgres import Server
from store_cases import claim, outcome, postgresql_addresses, window

from servotwin.store import engine
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import PutResult
from servotwin.store.store import Store, open_store
from servotwin.twin_service.ingest import Clocks

pytest_plugins = ("store_fixtures",)


def stop(stopped: Store, other: Store) -> None:
    with stopped.writing() as connection:
        connection.exec_driver_sql("UPDATE twins SET attempts = 7")
        assert other.put([window(sequence=1)]) == [PutResult.NEW]
        connection.exec_driver_sql("UPDATE twins SET attempts = 8")


@pytest.mark.slow
def test_a_twin_stopped_in_a_transaction_does_not_keep_others_from_its_servos(
    postgres_server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "_BUSY_S", 3.0)
    address = postgresql_addresses(postgres_server)()
    with closing(open_store(address)) as stopped, closing(open_store(address)) as other:
        stopped.put([window(sequence=0)])
        with pytest.raises(StoreUnavailable, match="idle-in-transaction"):
            stop(stopped, other)
        assert stopped.put([window(sequence=2)]) == [PutResult.NEW]
        assert stopped.servo("a").windows == 3


def test_a_clock_goes_on_while_the_machine_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A twin behind by its sleep would take all leases of others for ones from before a clock was set back."""
    slept = [0.0]
    wall, boot = time.time, time.clock_gettime
    monkeypatch.setattr(time, "time", lambda: wall() + slept[0])
    monkeypatch.setattr(time, "clock_gettime", lambda number: boot(number) + slept[0] * (number == time.CLOCK_BOOTTIME))
    clocks = Clocks.of_machine()
    slept[0] = 3600.0
    assert clocks.wall() == pytest.approx(time.time(), abs=1.0)


def test_what_a_stopped_twin_had_leased_is_done_by_another_one_and_its_own_result_is_void(new_address) -> None:
    with closing(open_store(new_address())) as store:
        store.put([window(sequence=0)])
        (lost,) = claim(store, "stopped", 200.0, lease_s=10.0)
        assert claim(store, "other", 209.0) == []
        (taken,) = claim(store, "other", 211.0)
        store.renew("stopped", ["a"], 300.0)
        store.release("stopped", ["a"])
        store.hold("a", 400.0)
        assert claim(store, "third", 220.0) == []  # neither extended nor ended by whoever had lost it
        assert store.commit([outcome(taken)], 212.0) == [True]
        assert store.commit([outcome(lost)], 213.0) == [False]
        assert store.servo("a").serial == 1
