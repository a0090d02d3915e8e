"""Full and read-only disks under running processes: no acknowledged window is lost, the controller keeps running."""

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from deployment import Fleet, Process, deployed, end_all, logs, until
from killing import by_boot, check_controllers_ticked, check_exactly_once
from records import count_stored, count_witnessed, dropped, pending, stored, witnessed
from smalldisk import Disk, small_disk

FAULT_S = 6.0


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


def delivered(fleet: Fleet) -> bool:
    """True once no window waits; a twin that gave up on a read-only disk, at once or only now, is started again."""
    if not fleet.twin.running:
        fleet.twin.start()
    return pending(fleet) == 0


def finish(fleet: Fleet) -> None:
    fleet.stop_machines()
    until(lambda: delivered(fleet), lambda: logs(fleet))
    assert set(end_all(fleet.edges.values())) == {0}
    assert fleet.twin.end() == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["full", "read-only"])
def test_the_edges_disk(tmp_path: Path, kind: str) -> None:
    """It goes on with what it has in memory, and delivers that too; what it has to give up it counts."""
    fleet = Fleet(tmp_path, ["control", "supervise"])
    url = f"http://127.0.0.1:{fleet.port}"
    with small_disk(tmp_path / "ax-0", 8) as disk, deployed(fleet, url):
        until(lambda: count_witnessed(fleet) >= 6, lambda: logs(fleet))
        with fault(kind, disk, fleet.edges["ax-0"]):
            time.sleep(FAULT_S)
        before = count_witnessed(fleet)
        until(lambda: count_witnessed(fleet) >= before + 6, lambda: logs(fleet))
        finish(fleet)
        check_controllers_ticked(fleet)
        kept, boots = Counter(stored(fleet)), by_boot(set(stored(fleet)))
        missing = sum(len(set(range(max(numbers) + 1)) - set(numbers)) for numbers in boots.values())
        assert max(kept.values()) == 1
        assert missing == sum(dropped(fleet).values())
        assert len(witnessed(fleet) - set(kept)) <= missing


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["full", "read-only"])
def test_the_twins_disk(tmp_path: Path, kind: str) -> None:
    """It takes nothing that it cannot keep; the edges keep it meanwhile."""
    fleet = Fleet(tmp_path, ["control", "supervise"], store="store/twin.db")
    with small_disk(tmp_path / "store", 16) as disk, deployed(fleet, f"http://127.0.0.1:{fleet.port}"):
        until(lambda: count_stored(fleet) >= 6, lambda: logs(fleet))
        with fault(kind, disk, fleet.twin):
            before = count_witnessed(fleet)
            until(lambda: count_witnessed(fleet) >= before + 8, lambda: logs(fleet))
        finish(fleet)
        check_exactly_once(fleet, before + 8)
        check_controllers_ticked(fleet)
