"""Workers of the twin's service: start, and replacement of those that end meanwhile."""

import asyncio
import sys
from contextlib import closing

import pytest
from service_system import twin_file

from servotwin.store.engine import StoreUnavailable
from servotwin.store.store import open_store
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker import WorkerLost, WorkerPool

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
