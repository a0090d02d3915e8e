"""Full and read-only disks under running processes: no acknowledged window is lost, the controller keeps running."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from deployment import Fleet, Process, deployed, end_all, logs, until
from killing import by_boot, check_controllers_ticked, check_exactly_once
from records import count_stored, count_witnessed, dropped, pending, stored, witnessed
from smalldisk import Disk, small_disk

FAULT_S = 4.0
KINDS = ("read-only", "full")
"""In this order: for the first one the process is killed, and what a full disk left in memory would be lost."""


@contextmanager
def fault(kind: str, disk: Disk, process: Process) -> Iterator[None]:
    """A disk is of no use for a while; to become read-only it must not be in use, so that the process is killed."""
    if kind == "full":
        disk.fill()
    else:
        process.kill()
        disk.remount("ro")
        process.start()
    yield
    if kind == "full":
        disk.clear()
    else:
        disk.remount("rw")


def wait(fleet: Fleet, condition: Callable[[], bool]) -> None:
    """A twin that gave up on a read-only disk, at once or only now, is started again."""

    def holds() -> bool:
        if not fleet.twin.running:
            fleet.twin.start()
        return condition()

    until(holds, lambda: logs(fleet))


def reach(fleet: Fleet, count: Callable[[Fleet], int], more: int) -> None:
    """Wait for so many more windows."""
    number = count(fleet) + more
    wait(fleet, lambda: count(fleet) >= number)


def collect(fleet: Fleet, more: int) -> int:
    """Wait for so many more windows in the outboxes, with a twin or without; return their number."""
    number = count_witnessed(fleet) + more
    until(lambda: count_witnessed(fleet) >= number, lambda: logs(fleet))
    return number


def finish(fleet: Fleet) -> None:
    fleet.stop_machines()
    deliver(fleet)
    while pending(fleet) > 0:  # what was on its way to the disk when the edges were asked to end
        for edge in fleet.edges.values():
            edge.start()
        deliver(fleet)
    assert fleet.twin.end() == 0


def deliver(fleet: Fleet) -> None:
    """Wait until nothing is left to send, and end the edges."""
    wait(fleet, lambda: pending(fleet) == 0)
    assert set(end_all(fleet.edges.values())) == {0}


@pytest.mark.slow
def test_the_edges_disk(tmp_path: Path) -> None:
    """It goes on with what it has in memory, and delivers that too; what it has to give up it counts."""
    fleet = Fleet(tmp_path, ["control", "supervise"])
    url = f"http://127.0.0.1:{fleet.port}"
    with small_disk(tmp_path / "ax-0", 8) as disk, deployed(fleet, url):
        reach(fleet, count_witnessed, 4)
        for kind in KINDS:
            with fault(kind, disk, fleet.edges["ax-0"]):
                time.sleep(FAULT_S)
            reach(fleet, count_witnessed, 4)
        finish(fleet)
        check_controllers_ticked(fleet)
        kept, boots = Counter(stored(fleet)), by_boot(set(stored(fleet)))
        missing = sum(len(set(range(max(numbers) + 1)) - set(numbers)) for numbers in boots.values())
        assert max(kept.values()) == 1
        assert missing == sum(dropped(fleet).values())
        assert len(witnessed(fleet) - set(kept)) <= missing


@pytest.mark.slow
def test_the_twins_disk(tmp_path: Path) -> None:
    """It takes nothing that it cannot keep; the edges keep it meanwhile."""
    fleet = Fleet(tmp_path, ["control", "supervise"], store="store/twin.db")
    with small_disk(tmp_path / "store", 16) as disk, deployed(fleet, f"http://127.0.0.1:{fleet.port}"):
        for kind in KINDS:
            reach(fleet, count_stored, 4)
            with fault(kind, disk, fleet.twin):
                sufficient = collect(fleet, 6)
        finish(fleet)
        check_exactly_once(fleet, sufficient)
        check_controllers_ticked(fleet)
