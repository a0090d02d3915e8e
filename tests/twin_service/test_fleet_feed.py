"""Stream of the fleet's changes to the pages that watch it."""

import asyncio
import contextlib
import os
import signal

import msgspec
import pytest
from dashboard_fleet import say_hello
from service_system import MSGPACK, OPERATOR, bearer, place, window, with_service

from servotwin.messages import encode
from servotwin.store import overview
from servotwin.store.engine import StoreUnavailable
from servotwin.twin_service import fleet_feed, http_messages
from servotwin.twin_service.fleet_feed import FleetFeed, position_of
from servotwin.twin_service.fleet_process import ChangeReader, ChangesQuestion
from servotwin.twin_service.http_messages import ABORT, HttpRequest, HttpStream
from servotwin.twin_service.limits import RequestRejected


def position(system):
    return system.store.reading(overview.position)


async def first_events(feed, count, after=None, allowed=lambda: None):
    """The first events of a stream, and what is left of it."""
    stream, found = feed.watch(after, allowed), []
    async with asyncio.timeout(20.0):
        while len(found) < count:
            part = await anext(stream)
            if part.startswith((b"id:", b"event:")) and not part.startswith((b"event: alive", b"event: links")):
                found.append(dict(line.split(b": ", 1) for line in part.strip().split(b"\n")))
    return found, stream


@pytest.mark.slow
def test_events_tell_what_changed_and_resume_where_a_stream_broke(tmp_path):
    async def body(system, client):
        begun = position(system)
        sent = window(0)
        await client.put(place(sent), content=encode(sent), headers=MSGPACK | bearer())
        (event,), stream = await first_events(system.pages.feed, 1, begun)
        assert event[b"event"] == b"rows"
        assert [row["servo"] for row in msgspec.json.decode(event[b"data"])] == ["ax-1"]
        await asyncio.to_thread(say_hello, system.store, "ax-2", 5.0)
        async with asyncio.timeout(20.0):
            while not (part := await anext(stream)).startswith(b"id:"):
                pass
        assert b'"servo":"ax-2"' in part
        await stream.aclose()
        resumed, stream = await first_events(system.pages.feed, 1, position_of(event[b"id"].decode()))
        assert [row["servo"] for row in msgspec.json.decode(resumed[0][b"data"])] == ["ax-2"]
        await stream.aclose()
        assert system.pages.feed.watchers == 0

    with_service(tmp_path, body)


def test_watchers_are_few_and_leave_when_they_may_no_longer_read(tmp_path):
    async def body(system, client):
        streams = [system.pages.feed.watch(None, lambda: None) for _ in range(2)]
        for stream in streams:
            await anext(stream)
        answer = await client.get("/v1/fleet/events", headers=bearer(OPERATOR))
        assert answer.status_code == 429
        await streams[0].aclose()

        def revoked():
            raise RequestRejected("bad_token", "no", 401)

        (event,), stream = await first_events(system.pages.feed, 1, position(system), revoked)
        assert event[b"event"] == b"rows"
        await system.pages.feed._send(b"event: rows\n\n")
        assert (await anext(stream)).startswith(b"event: ended")
        with pytest.raises(StopAsyncIteration):
            await anext(stream)
        system.pages.feed.close()
        with contextlib.suppress(StopAsyncIteration):
            async with asyncio.timeout(5.0):
                while True:
                    await anext(streams[1])

    with_service(tmp_path, body, "watchers = 2")


def test_a_slow_watcher_holds_nothing_up(tmp_path):
    async def body(system, _client):
        stream = system.pages.feed.watch(None, lambda: None)
        await anext(stream)
        for number in range(100):
            await system.pages.feed._send(b"event: %d\n\n" % number)
        async with asyncio.timeout(10.0):
            found = [part async for part in stream]
        assert found[0].startswith(b"event: links")
        assert found[1:] == [b"event: %d\n\n" % k for k in range(16)]

    with_service(tmp_path, body)


def test_an_event_goes_to_one_watcher_at_a_time(tmp_path):
    async def body(system, _client):
        streams = [system.pages.feed.watch(None, lambda: None) for _ in range(30)]
        for stream in streams:
            await anext(stream)
            await anext(stream)
        got = []

        async def take(stream):
            got.append(await anext(stream))

        waiting = [asyncio.create_task(take(stream)) for stream in streams]
        await asyncio.sleep(0)
        sending = asyncio.create_task(system.pages.feed._send(b"event: x\n\n"))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert len(got) <= 1  # whoever else waits for the loop has had a turn
        await asyncio.gather(sending, *waiting)
        assert got == [b"event: x\n\n"] * 30
        for stream in streams:
            await stream.aclose()

    with_service(tmp_path, body)


def feed_of(system):
    """A feed that looks only when it is told to."""
    changes, presence = ChangeReader(system.pages.fleet, system.executor), system.pages.fleet._presence
    return FleetFeed(changes, presence, 2, False, lambda: system.watch.fault)


@pytest.mark.parametrize("fault", [StoreUnavailable("locked"), ValueError("unforeseen")])
def test_a_look_that_fails_is_told_and_repeated_from_the_same_place(tmp_path, monkeypatch, fault):
    async def body(system, _client):
        feed, rows = feed_of(system), system.pages.fleet.rows
        await feed._changed()
        await asyncio.to_thread(say_hello, system.store, "ax-2", 5.0)

        def fail(_servos):
            raise fault

        monkeypatch.setattr(system.pages.fleet, "rows", fail)
        assert b"event: trouble" in (await feed._look())[0]
        assert await feed._look() == []
        monkeypatch.setattr(system.pages.fleet, "rows", rows)
        assert b'"servo":"ax-2"' in (await feed._look())[0]
        assert await feed._look() == []

    with_service(tmp_path, body)


def test_pages_are_told_that_the_store_is_damaged_although_it_can_be_read(tmp_path):
    async def body(system, _client):
        await asyncio.to_thread(say_hello, system.store, "ax-1", 5.0)
        feed, begun = feed_of(system), position(system)
        await feed._changed()
        system.watch.fault = "page 3 is noise"
        assert b"event: trouble" in (told := (await feed._look())[0])
        assert b"The twin's store is damaged" in told
        assert await feed._since(begun) == [told]  # a page that comes now
        assert await feed._look() == []  # said once
        system.watch.fault = ""
        assert b"event: rows" in (await feed._look())[0]

    with_service(tmp_path, body)


def test_the_first_look_tells_which_edges_came(tmp_path, monkeypatch):
    async def body(system, _client):
        await asyncio.to_thread(say_hello, system.store, "ax-1", 5.0)
        monkeypatch.setattr(system.polls, "_waiting", {"ax-1": {}})
        assert b'"connected":true' in (await feed_of(system)._changed())[0]

    with_service(tmp_path, body)


def test_a_watcher_learns_at_once_which_edges_are_connected(tmp_path, monkeypatch):
    async def body(system, _client):
        monkeypatch.setattr(system.polls, "_waiting", {"ax-1": {}})
        stream = system.pages.feed.watch(None, lambda: None)
        assert [part async for part in aiter_of(stream, 2)][1] == (
            b'event: links\ndata: {"connected":["ax-1"],"sole":true}\n\n'
        )
        await stream.aclose()

    with_service(tmp_path, body)


async def aiter_of(stream, count):
    for _ in range(count):
        yield await anext(stream)


def test_many_changes_come_in_parts_and_too_many_are_read_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(fleet_feed, "_ROWS", 2)
    monkeypatch.setattr(fleet_feed, "_MOST", 5)

    async def body(system, _client):
        feed = feed_of(system)
        await feed._changed()
        for name in "abcde":
            await asyncio.to_thread(say_hello, system.store, f"ax-{name}", 5.0)
        parts = await feed._changed()
        assert [part.count(b'"servo"') for part in parts] == [2, 2, 1]
        assert [part.startswith(b"id:") for part in parts] == [False, False, True]
        for name in "fghijk":
            await asyncio.to_thread(say_hello, system.store, f"ax-{name}", 5.0)
        (event,) = await feed._changed()
        assert b"event: reload" in event

    with_service(tmp_path, body)


class Unread:
    """A connection whose client takes the head of an answer and nothing more."""

    def __init__(self):
        self.aborted = asyncio.Event()

    async def send(self, event):
        if event["type"] == "http.response.body":
            await asyncio.Event().wait()

    async def receive(self):
        await asyncio.Event().wait()

    def request(self):
        scope = {"method": "GET", "headers": [], "query_string": b"", "extensions": {ABORT: self.aborted.set}}
        return HttpRequest(scope, self.receive, {})


@pytest.mark.parametrize("ends", [True, False])
def test_a_page_that_does_not_read_counts_and_is_cut_off(tmp_path, monkeypatch, ends):
    monkeypatch.setattr(http_messages, "_STALL_S", 60.0 if ends else 0.01)
    monkeypatch.setattr(http_messages, "_LAST_S", 0.01)

    async def body(system, _client):
        page = Unread()
        stream = HttpStream(
            system.pages.feed.watch(None, lambda: None), "text/event-stream", page.request(), system.pages.feed.closing
        )
        sending = asyncio.create_task(stream.send(page.send))
        if ends:
            await asyncio.sleep(0.02)
            for _ in range(40):
                await system.pages.feed._send(b"event: rows\n\n")  # its queue overflows
            assert system.pages.feed.watchers == 1
            system.pages.feed.close()
        await asyncio.wait_for(page.aborted.wait(), 20.0)
        await sending
        assert system.pages.feed.watchers == 0

    with_service(tmp_path, body)


@pytest.mark.slow
def test_a_process_of_its_own_reads_what_changed_and_a_thread_where_it_is_lost(tmp_path):
    async def body(system, client):
        await asyncio.to_thread(say_hello, system.store, "ax-1", 5.0)
        begun, changes = position(system), system.pages.changes
        changes.start()
        async with asyncio.timeout(60.0):
            while changes.pid is None:
                await asyncio.sleep(0.05)
        await asyncio.to_thread(say_hello, system.store, "ax-2", 5.0)
        question = ChangesQuestion(begun, ("ax-1",), ("ax-1",), True)
        found = await changes.read(question)
        rows = {row["servo"]: row["connected"] for row in msgspec.json.decode(found.parts[0])}
        assert rows == {"ax-1": True, "ax-2": False}
        assert os.getpriority(os.PRIO_PROCESS, changes.pid) > os.getpriority(os.PRIO_PROCESS, 0)
        killed = changes.pid
        os.kill(killed, signal.SIGKILL)
        assert (await changes.read(question)).position == found.position
        assert changes.pid is None
        changes.start()
        async with asyncio.timeout(60.0):
            while changes.pid is None:
                await asyncio.sleep(0.05)
        assert changes.pid != killed

    with_service(tmp_path, body)
