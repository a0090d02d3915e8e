"""Windows that never came, or that are still to come, as the service finds and asks for them."""

import asyncio

import msgspec
import pytest
from service_system import twin_file, window
from watched_store import posted, send, serve

from servotwin.messages import Resend
from servotwin.store.engine import StoreUnavailable
from servotwin.twin_service import missing_windows


def test_windows_that_never_came_are_asked_for_once(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(missing_windows, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(missing_windows, "_LOOK_S", 1e9)  # the service itself does not look

    async def body(system, client):
        await send(client, 0, 1, 4, 5)
        await system._missing.look()
        assert posted(system) == [Resend("ax-1", "b", 2, 3, "windows of this boot did not come")]
        await send(client, 8)
        await system._missing.look()
        await system._missing.look()
        assert [(asked.first, asked.last) for asked in posted(system)] == [(2, 3), (6, 7)]
        assert "servotwin_windows_missing_total 4\n" in (await client.get("/metrics")).text
        await send(client, 2, 3, 6, 7, 9)
        await system._missing.look()
        assert len(posted(system)) == 2

    serve(twin_file(tmp_path), body)
    assert caplog.messages.count("windows missing") == 2


@pytest.mark.slow
def test_a_hole_is_asked_for_by_itself_and_not_with_all_that_is_between(tmp_path, monkeypatch):
    monkeypatch.setattr(missing_windows, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(missing_windows, "_LOOK_S", 1e9)

    async def body(system, client):
        await send(client, 0, 1, 2, 4, 5, 6, 7, 9)
        await system._missing.look()
        assert [(asked.first, asked.last) for asked in posted(system)] == [(3, 3), (8, 8)]
        assert "servotwin_windows_missing_total 2\n" in (await client.get("/metrics")).text
        await send(client, *range(11, 51, 2))
        await system._missing.look()
        asked = [(asked.first, asked.last) for asked in posted(system)][2:]
        assert asked == [*((n, n) for n in range(10, 24, 2)), (24, 48)]

    serve(twin_file(tmp_path), body)


@pytest.mark.parametrize("failing", ["read", "post"])
def test_a_look_that_failed_is_made_again(tmp_path, monkeypatch, failing):
    monkeypatch.setattr(missing_windows, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(missing_windows, "_LOOK_S", 1e9)

    def fail(*_of):
        raise StoreUnavailable("the disk is full")

    async def body(system, client):
        await send(client, 0, 1, 3, 4, 6)
        with monkeypatch.context() as patched:
            if failing == "read":
                patched.setattr(missing_windows, "missing_windows", fail)
            else:
                patched.setattr(system.store, "post", fail)
            await system._missing.look()
            assert posted(system) == []
            assert "servotwin_windows_missing_total 0\n" in (await client.get("/metrics")).text
        await system._missing.look()
        assert [(asked.first, asked.last) for asked in posted(system)] == [(2, 2), (5, 5)]
        await system._missing.look()
        assert len(posted(system)) == 2

    serve(twin_file(tmp_path), body)


def test_a_hole_that_comes_during_a_look_is_found_by_the_next_one():
    now = [100.0]
    watch = missing_windows.SequenceWatch(lambda: now[0])
    boot = ("ax-1", "b")
    watch.note(window(0))
    now[0] += 30.0
    assert watch.due() == [boot]
    newest = watch.newest(boot)
    watch.note(window(5))
    watch.looked_at(boot, newest)
    assert watch.due() == []
    now[0] += 30.0
    assert watch.due() == [boot]
    watch.looked_at(boot, watch.newest(boot))
    now[0] += 1000.0
    assert watch.due() == []


def test_windows_that_were_only_overtaken_are_not_asked_for(tmp_path):
    async def body(system, client):
        await send(client, 2, 1, 0)
        await system._missing.look()  # patience is not over
        assert posted(system) == []
        for known in system._missing._sequences._boots.values():
            known.look_at = 0.0
        await system._missing.look()
        assert posted(system) == []

    serve(twin_file(tmp_path), body)


def test_a_backlog_behind_the_newest_window_is_not_missing_while_it_comes():
    now = [0.0]
    watch = missing_windows.SequenceWatch(lambda: now[0])
    watch.note(window(0))
    watch.looked_at(("ax-1", "b"), 0)
    for number in (20, *range(1, 9)):
        watch.note(window(number))
        now[0] += 20.0
        assert watch.due() == []
    now[0] += 15.0
    assert watch.due() == [("ax-1", "b")]


def test_what_is_still_to_come_behind_a_window_of_the_look_itself_is_not_missing(tmp_path, monkeypatch):
    """The first windows after an outage come while the twin looks for holes of before."""
    monkeypatch.setattr(missing_windows, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(missing_windows, "_LOOK_S", 1e9)

    async def body(system, client):
        await send(client, 0, 2)
        read = missing_windows.missing_windows
        sent = asyncio.Event()

        def late(*arguments):
            asyncio.run_coroutine_threadsafe(sending(), loop).result()
            return read(*arguments)

        async def sending():
            if not sent.is_set():
                sent.set()
                await send(client, 9)

        loop = asyncio.get_running_loop()
        monkeypatch.setattr(missing_windows, "missing_windows", late)
        await system._missing.look()
        assert [(asked.first, asked.last) for asked in posted(system)] == [(1, 1)]
        await send(client, 3, 4, 5, 6, 7, 8)
        await system._missing.look()
        assert len(posted(system)) == 1

    serve(twin_file(tmp_path), body)


@pytest.mark.parametrize("selected", [None, 0])
def test_an_edge_that_selects_its_windows_leaves_no_holes(selected):
    now = [0.0]
    watch = missing_windows.SequenceWatch(lambda: now[0])
    for number in (0, 5):
        watch.note(msgspec.structs.replace(window(number), response_version=selected))
    assert watch.due() == []
    now[0] = 100.0
    assert watch.due() == ([("ax-1", "b")] if selected is None else [])
