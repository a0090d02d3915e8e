"""Messages are processed once, whatever happens to workers; processes share work; verifications keep their rate."""

import asyncio
import contextlib
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import httpx
import msgspec
import pytest
from service_system import bearer, place, twin_file, unpacked, window

from servotwin.messages import encode
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import EvidenceRecord, MessageKind, StoredMessage
from servotwin.store.store import open_store
from servotwin.twin_service import dispatcher
from servotwin.twin_service.evidence_lines import _identifiers
from servotwin.twin_service.pace import VerificationQuota
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker_pool import WorkerPool

pytest_plugins = ("store_fixtures",)
WORKER = (sys.executable, str(Path(__file__).parents[1] / "support" / "scripted_worker.py"))
PATIENCE = 60.0


@contextlib.asynccontextmanager
async def working(path, url=None, workers=1, timeout=30.0):
    """A service with scripted workers, and a client."""
    twin = read_twin(path)
    store = open_store(url or twin.service.store)
    system = TwinService(twin, store, pool=WorkerPool(workers, twin.start, timeout, WORKER))
    app = system.http_app()
    try:
        async with app.lifespan():
            transport = httpx.ASGITransport(app)
            async with httpx.AsyncClient(transport=transport, base_url="http://twin") as client:
                yield system, client
    finally:
        store.close()


async def put(client, sequence, reason="work", servo="ax-1", token="token-of-ax-1", tries=1):
    """Send a window, as often as an edge would where the store may fail meanwhile."""
    sent = msgspec.structs.replace(window(sequence, servo, start=0.001 * sequence), reason=reason)
    for _ in range(tries):
        answer = await client.put(place(sent), content=encode(sent), headers=bearer(token))
        if answer.status_code != 503:
            break
    assert answer.status_code == 201, answer.text


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.02)


def done(system, servo="ax-1"):
    result = system.store.servo(servo)
    return result is not None and result.waiting == 0


def statuses(system, servo="ax-1"):
    """Of each window by its sequence: what was found of it."""
    links = system.store.audit(servo, limit=1000)
    return {link.window.sequence: [result.status[:8] for result in link.evidence] for link in links}


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["die", "hang", "raise"])
def test_a_message_that_kills_its_workers_is_isolated_and_all_others_are_processed_once(tmp_path, fault, caplog):
    async def body():
        async with working(twin_file(tmp_path), timeout=5.0 if fault == "hang" else 30.0) as (system, client):
            for sequence in range(6):
                await put(client, sequence, fault if sequence == 3 else "work")
                await put(client, sequence, servo="ax-2", token="token-of-ax-2")
            await until(lambda: done(system) and done(system, "ax-2"))
            result = statuses(system)
            assert result.pop(3) == ["failed: "]
            assert all(len(each) == 1 and each[0].startswith("at ") for each in result.values())
            assert len(result) == 5
            assert [len(each) for each in statuses(system, "ax-2").values()] == [1] * 6
            # The state holds one letter for each message: nothing counted twice.
            [posted] = {summary.posted for summary in system.store.servos()}
            assert posted == 6
            assert system.pool.lost >= (2 if fault != "raise" else 0)
            assert system.pool.alive == 1
            counted = (await client.get("/metrics")).text
            assert 'servotwin_evidence_total{kind="failed"} 1\n' in counted
            assert 'servotwin_evidence_total{kind="estimate"} 11\n' in counted
            [alarm] = [record for record in caplog.records if record.message == "failed"]
            assert (alarm.levelname, alarm.servo, alarm.window) == ("WARNING", "ax-1", "b/3")
            assert alarm.received < datetime.fromtimestamp(alarm.created, UTC).isoformat(timespec="milliseconds")
            assert "work failed" in caplog.messages
            assert ("worker replaced" in caplog.messages) == (fault != "raise")

    asyncio.run(body())


@pytest.mark.slow
def test_work_that_was_not_committed_is_repeated_when_the_store_is_back(tmp_path, caplog):
    async def body():
        async with working(twin_file(tmp_path)) as (system, client):
            write, failures = system.store.write, []

            def full(items, made, now):
                if made and len(failures) < 2:
                    failures.append(time.monotonic())
                    raise StoreUnavailable("the disk is full")
                return write(items, made, now)

            system.store.write = full
            # A window may be in one of the transactions that fail: it is refused and sent again.
            for sequence in range(5):
                await put(client, sequence, tries=3)
            await until(lambda: done(system))
            assert len(failures) == 2
            # Between two attempts there was a pause, on any machine, however many messages came meanwhile.
            assert failures[1] - failures[0] >= dispatcher._RETRY_S
            assert "result not committed" in caplog.messages
            assert {len(each) for each in statuses(system).values()} == {1}
            assert system.store.servo("ax-1").posted == 5

    asyncio.run(body())


@pytest.mark.slow
def test_windows_are_processed_and_the_edge_is_notified(tmp_path, new_address):
    async def body(url):
        async with working(twin_file(tmp_path, f'store = "{shown(url)}"'), url) as (system, client):
            request = client.get("/v1/servos/ax-1/outgoing?after=0&wait=30", headers=bearer())
            poll = asyncio.create_task(request)
            await asyncio.sleep(0.05)
            await put(client, 0)
            assert len(unpacked((await poll).content)) == 1
            await until(lambda: done(system))

    asyncio.run(body(new_address()))


def shown(url):
    """An address as a twin's file may name it: without a password."""
    head, _, rest = url.partition("://")
    who, at, where = rest.rpartition("@")
    return f"{head}://{who.split(':')[0]}{at}{where}"


@pytest.mark.slow
def test_processes_share_one_database_and_notify_each_other_s_edges(tmp_path, postgres_server):
    async def body(url):
        file = twin_file(tmp_path, f'store = "{shown(url)}"')
        async with working(file, url) as (one, here), working(file, url) as (two, there):
            poll = asyncio.create_task(
                there.get("/v1/servos/ax-2/outgoing?after=0&wait=30", headers=bearer("token-of-ax-2"))
            )
            for sequence in range(40):
                await put(here if sequence % 2 else there, sequence)
            await put(here, 0, servo="ax-2", token="token-of-ax-2")
            assert len(unpacked((await poll).content)) == 1
            await until(lambda: done(one))
            assert {len(each) for each in statuses(two).values()} == {1}
            assert one.store.servo("ax-1").posted == 40

    asyncio.run(body(postgres_server.database("shared")))


def test_at_most_two_verifications_start_at_once_and_then_at_their_rate():
    allowance = VerificationQuota(6.0)
    begun = []
    for tick in range(1, 6001):
        now = 0.01 * tick
        if allowance.refill(now):
            allowance.take()
            allowance.ended()
            begun.append(now)
    assert begun[:2] == [0.01, 0.02]
    assert len(begun) == 2 + 5
    assert not VerificationQuota(0.0).refill(1e6)


@pytest.mark.parametrize(("workers", "at_once"), [(1, 1), (2, 1), (3, 2), (9, 2)])
def test_a_worker_is_left_for_new_messages_while_others_verify(workers: int, at_once: int):
    """Both of two workers began with a verification of a second each: every new window waited for that long."""
    quota, running = VerificationQuota(6.0, workers), 0
    while quota.refill(0.01):
        quota.take()
        running += 1
    assert running == at_once
    quota.ended()
    assert quota.refill(1000.0)


def test_the_line_of_a_letter_tells_when_it_came() -> None:
    """The line itself comes at the servo's turn."""
    letter = StoredMessage(7, MessageKind.LETTER, b"", "", 90.0)
    fallen = EvidenceRecord("fallback", 7, b"", version=3, status="the twin is silent")
    told = _identifiers(fallen, letter)
    assert told["received"] == "1970-01-01T00:01:30.000+00:00"
    assert "window" not in told
    assert "received" not in _identifiers(fallen, None)
