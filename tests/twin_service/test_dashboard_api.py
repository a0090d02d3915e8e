"""HTTP API of the dashboard: sessions, pages of other sites, files, events."""

import asyncio
import contextlib
import os
import signal

import msgspec
import pytest
from dashboard_fleet import say_hello
from service_system import MSGPACK, OPERATOR, OTHER, TOKEN, bearer, place, served, twin_file, window

from servotwin.messages import encode
from servotwin.store import overview
from servotwin.store.engine import StoreUnavailable
from servotwin.twin_service import fleet_feed, http_app
from servotwin.twin_service.auth import Verifiers
from servotwin.twin_service.fleet_feed import FleetFeed, position_of
from servotwin.twin_service.fleet_process import ChangeReader, ChangesQuestion
from servotwin.twin_service.fleet_reader import EdgePresence
from servotwin.twin_service.http_app import ABORT, HttpRequest, HttpStream
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.sessions import COOKIE, SESSION_S


def with_service(folder, body, service=""):
    async def run():
        async with served(twin_file(folder, service)) as (system, client):
            await body(system, client)

    asyncio.run(run())


async def login(client, token=OPERATOR, **headers):
    return await client.post("/v1/session", json={"token": token}, headers=headers)


def test_a_session_reads_and_nothing_else(tmp_path):
    async def body(_system, client):
        assert (await client.get("/v1/session")).json() == {"tokens": True, "admitted": False}
        assert (await client.get("/v1/fleet")).status_code == 401
        answer = await login(client)
        assert answer.status_code == 204
        cookie = answer.headers["set-cookie"]
        assert cookie.startswith(f"{COOKIE}=")
        assert all(part in cookie for part in ("HttpOnly", "SameSite=Strict", "Path=/"))
        assert OPERATOR not in cookie
        assert (await client.get("/v1/session")).json()["admitted"]
        assert (await client.get("/v1/fleet")).json()["rows"] == []
        assert (await client.get("/v1/servos")).status_code == 200
        sent = window(0)
        assert (await client.put(place(sent), content=encode(sent), headers=MSGPACK)).status_code == 401
        assert (await client.delete("/v1/session")).status_code == 204
        assert (await client.get("/v1/fleet")).status_code == 401

    with_service(tmp_path, body)


@pytest.mark.parametrize(("token", "status"), [("guess", 401), ("", 401), (TOKEN, 403)])
def test_only_an_operator_s_token_begins_a_session(tmp_path, token, status):
    async def body(_system, client):
        answer = await login(client, token)
        assert answer.status_code == status
        assert "set-cookie" not in answer.headers

    with_service(tmp_path, body)


@pytest.mark.parametrize("content", [b"", b"{}", b"[" * 3000, b'{"token": 1}', b"x" * 5000])
def test_a_login_that_cannot_be_read_is_refused(tmp_path, content):
    async def body(_system, client):
        assert (await client.post("/v1/session", content=content)).status_code in (400, 413)

    with_service(tmp_path, body)


def test_a_session_ends_with_its_token_and_its_time_and_cannot_be_made_up(tmp_path, monkeypatch):
    async def body(system, client):
        await login(client)
        good = client.cookies[COOKIE]
        name, end, code = good.split(".")

        async def status(value):
            client.cookies.clear()
            return (
                await client.get("/v1/fleet", headers={"cookie": f"{COOKIE}={value}".encode("latin-1")})
            ).status_code

        assert await status(good) == 200
        later = f"{name}.{int(end) + 1}.{code}"
        other = f"{b'you'.hex()}.{end}.{code}"
        for value in (later, other, f"{name}.{end}.{'0' * 64}", "ff.1.00", "é", "", good + "0"):
            assert await status(value) == 401
        now = system.clocks.wall()
        monkeypatch.setattr(system.operators, "_wall", lambda: now + SESSION_S + 2.0)
        assert await status(good) == 401
        monkeypatch.undo()
        assert await status(good) == 200
        system.access.replace(Verifiers({}, {"me": bytes(32)}))
        assert await status(good) == 401

    with_service(tmp_path, body)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"sec-fetch-site": "same-site", "origin": "http://twin"}, 403),
        ({"origin": "http://twin"}, 204),
        ({"sec-fetch-site": "same-origin", "origin": "https://outside.example"}, 204),  # behind a proxy
        ({}, 204),
    ],
)
def test_pages_of_other_sites_write_nothing(tmp_path, headers, status):
    async def body(_system, client):
        assert (await login(client, **headers)).status_code == status
        sent = window(0)
        answer = await client.put(place(sent), content=encode(sent), headers=MSGPACK | bearer() | headers)
        assert answer.status_code == (403 if status == 403 else 201)

    with_service(tmp_path, body)


def test_files_come_compressed_once_and_with_a_policy(tmp_path):
    async def body(_system, client):
        page = await client.get("/")
        policy = page.headers["content-security-policy"]
        assert "unsafe" not in policy
        assert "default-src 'none'" in policy
        assert "<script>" not in page.text
        assert "style=" not in page.text
        weight = 0
        for name in ("app.js", "app.css", "uPlot.iife.min.js", "uPlot.min.css", "fleet.js", "machine.js", "charts.js"):
            file = await client.get(f"/static/{name}", headers={"accept-encoding": "gzip"})
            assert file.headers["content-encoding"] == "gzip"
            weight += int(file.headers["content-length"])
            again = await client.get(f"/static/{name}", headers={"if-none-match": file.headers["etag"]})
            assert again.status_code == 304
        assert weight < 100_000
        for name in ("nothing.js", "..%2fassets.py", "uPlot-LICENSE.txt"):
            assert (await client.get(f"/static/{name}")).status_code == 404

    with_service(tmp_path, body)


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
    return FleetFeed(ChangeReader(system.pages.fleet, system.executor), system.pages.fleet._presence, 2, False)


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
    monkeypatch.setattr(http_app, "_STALL_S", 60.0 if ends else 0.01)
    monkeypatch.setattr(http_app, "_LAST_S", 0.01)

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


def test_an_edge_counts_as_connected_until_it_is_silent():
    waiting, now = ["a"], [0.0]
    presence = EdgePresence(lambda: waiting, True, lambda: now[0])
    assert (presence("a"), presence("b")) == (True, False)  # nobody has watched yet
    presence.refresh()
    waiting.clear()
    now[0] = 4.0
    assert presence("a") is True
    now[0] = 6.0
    assert presence("a") is False  # though nobody refreshed since


def test_channels_of_a_window(tmp_path):
    async def body(_system, client):
        sent = window(3)
        await client.put(place(sent), content=encode(sent), headers=MSGPACK | bearer())
        url, headers = place(sent) + "/channels", bearer(OPERATOR)
        found = (await client.get(url, headers=headers)).json()
        assert [(each["name"], each["samples"]) for each in found["channels"]] == [("position", 200), ("theta_m", 200)]
        assert len((await client.get(url + "?points=10", headers=headers)).json()["channels"][0]["values"]) <= 22
        assert (
            len((await client.get(url + "?from=0.05&to=0.06", headers=headers)).json()["channels"][0]["values"]) == 12
        )
        assert (await client.get(url + "?from=9", headers=headers)).status_code == 400
        assert (await client.get(url + "?from=1e308", headers=headers)).status_code == 400
        assert (await client.get(url + "?to=1e308", headers=headers)).status_code == 200
        assert (await client.get(url + "?from=nan", headers=headers)).status_code == 400
        text = (await client.get(url + ".csv", headers=headers)).text
        assert text.splitlines()[0] == "time_s,position_m,theta_m_rad"
        assert len(text.splitlines()) == 201
        assert (await client.get(url, headers=bearer(OTHER))).status_code == 403
        assert (await client.get("/v1/servos/ax-1/windows/b/99/channels", headers=headers)).status_code == 404

    with_service(tmp_path, body)


def test_a_fleet_comes_in_pages(tmp_path):
    async def body(system, client):
        for name in ("ax-1", "ax-2", "ax-3"):
            await asyncio.to_thread(say_hello, system.store, name, 5.0)
        headers = bearer(OPERATOR)
        first = (await client.get("/v1/fleet?limit=2", headers=headers)).json()
        assert [row["servo"] for row in first["rows"]] == ["ax-1", "ax-2"]
        assert first["rows"][0]["connected"] is False
        rest = (await client.get("/v1/fleet?limit=2&after=ax-2", headers=headers)).json()
        assert [row["servo"] for row in rest["rows"]] == ["ax-3"]
        assert (await client.get("/v1/fleet/histories?servos=ax-1,ax-9", headers=headers)).json() == {
            "ax-1": [],
            "ax-9": [],
        }
        assert (await client.get("/v1/fleet/histories?servos=a/b", headers=headers)).status_code == 400
        assert (await client.get("/v1/fleet?after=a/b", headers=headers)).status_code == 400

    with_service(tmp_path, body)


def test_a_report_is_one_file_that_runs_nothing(tmp_path):
    async def body(system, client):
        await asyncio.to_thread(say_hello, system.store, "ax-1", 5.0)
        assert (await client.get("/v1/servos/ax-1/report.html")).status_code == 401
        answer = await client.get("/v1/servos/ax-1/report.html", headers=bearer(OPERATOR))
        assert answer.status_code == 200
        assert "attachment" in answer.headers["content-disposition"]
        assert "script-src" not in answer.headers["content-security-policy"]
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "1970-01-01 00:00" in answer.text
        assert (await client.get("/v1/servos/ax-7/report.html", headers=bearer(OPERATOR))).status_code == 404

    with_service(tmp_path, body)


@pytest.mark.parametrize(("host", "status"), [
    ("localhost:8765", 200), ("127.0.0.1:8765", 200), ("[::1]:8765", 200), ("LOCALHOST.", 200), ("up.localhost", 200),
    ("twin", 200), ("evil.example:8765", 403), ("127.0.0.1.evil.example", 403), ("evil.example.", 403),
])  # fmt: skip
def test_without_tokens_a_page_whose_name_leads_here_reads_nothing(tmp_path, host, status):
    async def run():
        async with served(twin_file(tmp_path, tokens=False)) as (_system, client):
            answer = await client.get("/v1/fleet", headers={"host": host})
            assert answer.status_code == status

    asyncio.run(run())


def test_with_tokens_a_twin_answers_under_any_name(tmp_path):
    async def body(_system, client):
        headers = {**bearer(OPERATOR), "host": "twin.plant.example"}
        assert (await client.get("/v1/fleet", headers=headers)).status_code == 200

    with_service(tmp_path, body)


def test_metrics_of_machines_are_served_where_they_are_asked_for(tmp_path):
    async def body(system, client):
        await asyncio.to_thread(say_hello, system.store, "ax-1", 5.0)
        assert (await client.get("/metrics/machines")).status_code == 401
        text = (await client.get("/metrics/machines", headers=bearer(OPERATOR))).text
        assert 'servotwin_machine_last_message_seconds{servo="ax-1"} 5\n' in text
        assert 'servotwin_machine_connected{servo="ax-1"} 0\n' in text
        assert "servotwin_machine_gap_radians{" not in text
        assert "ax-1" not in (await client.get("/metrics")).text

    with_service(tmp_path, body, "machine_metrics = true")


def test_metrics_of_machines_are_off_by_default(tmp_path):
    async def body(_system, client):
        assert (await client.get("/metrics/machines", headers=bearer(OPERATOR))).status_code == 404

    with_service(tmp_path, body)


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
