"""Workers of the twin's service: start, and replacement of those that end meanwhile."""

import asyncio
import sys
import time
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
from service_system import twin_file, window

from servotwin.messages import encode
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import Lease, MessageKind, StoredMessage, WorkResult
from servotwin.store.store import open_store
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker import WorkerJob, WorkerLost, _results
from servotwin.twin_service.worker_pool import WorkerPool

SCRIPTED = Path(__file__).parents[1] / "support" / "scripted_worker.py"
WORKER = """
import os, sys, pathlib
starts = pathlib.Path({starts!r})
before = len(starts.read_text()) if starts.exists() else 0
starts.write_text("x" * (before + 1))
if before < {deaths}:
    os._exit(9)
from servotwin.twin_service import worker
worker._load_work = lambda _: None
worker.main(int(sys.argv[1]))
"""


async def started(pool: WorkerPool) -> int:
    await pool.start()
    alive = pool.alive
    await pool.stop()
    return alive


@pytest.mark.parametrize("deaths", [1, 3])
def test_a_worker_that_is_killed_while_the_service_starts_is_replaced(tmp_path, deaths):
    """The first ones end before they are ready, as by `kill -9`; three in a row are no chance."""
    twin = read_twin(twin_file(tmp_path))
    code = WORKER.format(starts=str(tmp_path / "starts"), deaths=deaths)
    pool = WorkerPool(1, twin.start, 5.0, (sys.executable, "-c", code))
    with pool.launched():
        if deaths == 3:
            with pytest.raises(WorkerLost, match="the worker ended"):
                asyncio.run(started(pool))
        else:
            assert asyncio.run(started(pool)) == 1
    assert (pool.alive, len((tmp_path / "starts").read_text())) == (0, min(3, deaths + 1))


def test_a_service_starts_while_its_disk_is_full(tmp_path):
    """Leases of the last process cannot be released: they end by themselves, and edges keep what is refused."""
    twin = read_twin(twin_file(tmp_path))
    tried = []

    def full(owner, *_):
        tried.append(owner)
        raise StoreUnavailable("the disk is full")

    async def run(service):
        await service.start()
        dispatching = service.dispatching
        await service.stop()
        return dispatching

    with closing(open_store(twin.service.store)) as store:
        store.release = full
        service = TwinService(twin, store, pool=WorkerPool(0, twin.start, 1.0))
        assert asyncio.run(run(service))
    assert tried


def test_a_message_that_needs_more_memory_than_a_worker_may_have_fails_alone(tmp_path):
    """Its worker lives on: one window cannot take the memory of the machine."""
    twin = read_twin(twin_file(tmp_path))

    async def body():
        pool = WorkerPool(1, twin.start, 30.0, (sys.executable, str(SCRIPTED)), memory=400e6)
        with pool.launched():
            await pool.start()
            worker = await pool.acquire()
            asked = [lease(n, reason) for n, reason in enumerate(("work", "fill", "work"))]
            found = [done async for done in worker.work(asked, 1.0)]
            assert [each.error for each in found] == ["", "MemoryError: ", ""]
            assert pool.alive == 1
            pool.release(worker)
            await pool.stop()

    asyncio.run(body())


def test_a_later_lease_of_a_job_begins_later_and_is_expected_to_take_as_long_as_one_before_it():
    seen = []

    def work(lease, now, urgency):
        seen.append((lease.servo, now, urgency))
        time.sleep(0.05 if lease.servo == "ax-1" else 0.0)
        return WorkResult(lease.servo, 0, b"", None, ())

    leases = tuple(lease(number, "work") for number in range(3))
    job = WorkerJob(leases, 1e3, ((0.0, 1.0, True, False), (0.02, 1.0, True, False), (0.03, 0.5, False, True)))
    assert len(list(_results(work, job))) == 3
    (first, second, third) = (urgency for _, _, urgency in seen)
    assert (first, second) == job.urgency[:2]
    assert third[0] >= 0.05
    assert third[1:] == job.urgency[2][1:]
    assert seen[2][1] - seen[0][1] >= 0.05
    seen.clear()
    assert len(list(_results(work, job._replace(urgency=())))) == 3
    assert {(now, urgency) for _, now, urgency in seen} == {(1e3, None)}


def lease(number, reason):
    body = encode(msgspec.structs.replace(window(number), reason=reason))
    stored = StoredMessage(number, MessageKind.WINDOW, body, "", 0.0, f"b/{number}")
    return Lease(f"ax-{number}", b"", 0, (stored,), 1)
