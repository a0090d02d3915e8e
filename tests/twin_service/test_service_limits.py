"""What a servo and a stranger may send, hold and ask for: beyond that the HTTP API refuses, at once or slowly."""

import asyncio
import threading
import time
import zlib

import httpx
import pytest
from service_requests import code, put
from service_system import OTHER, TOKEN, bearer, hello, place, unpacked, window

from servotwin.messages import encode
from servotwin.messages.codec import compress
from servotwin.store.engine import StoreUnavailable
from servotwin.twin_service import http_edge
from servotwin.twin_service.limits import RateLimiter


@pytest.mark.usefixtures("no_pause_for_refused")
def test_a_stranger_who_knocks_in_a_loop_does_not_fill_the_log(serving, caplog):
    caplog.set_level("INFO")

    async def body(system, client):
        for _ in range(300):
            assert code(await client.put(place(window()), content=b"x")) == (401, "bad_token")
        assert system.metrics.rejected.values[("bad_token",)] == 300

    serving(body)
    assert 100 <= caplog.messages.count("refused") < 200


def test_a_body_that_is_too_large_is_refused_however_it_is_sent(serving):
    async def pieces():
        for _ in range(100):
            yield bytes(1000)

    async def body(system, client):
        path = place(window())
        assert code(await put(client, bytes(20_001), to=path)) == (413, "too_large")
        streamed = await client.put(path, content=pieces(), headers=bearer())
        assert code(streamed) == (413, "too_large")
        bomb = zlib.compress(bytes(10_000_000))
        assert len(bomb) < 20_000
        assert code(await put(client, bomb, to=path, content_encoding="deflate")) == (413, "too_large")
        bomb = compress(bytes(50_000_000), "zstd")
        assert code(await put(client, bomb, to=path, content_encoding="zstd")) == (413, "too_large")
        assert code(await put(client, window(), content_length="9" * 30)) == (413, "too_large")

    serving(body, "max_body_bytes = 20000")


def test_a_body_that_does_not_arrive_in_time_is_refused(serving):
    async def slowly():
        yield b"x"
        await asyncio.sleep(30.0)

    async def body(_system, client):
        answer = await client.put(place(window()), content=slowly(), headers=bearer())
        assert code(answer) == (503, "unavailable")
        assert answer.headers["connection"] == "close"

    serving(body, "body_timeout_s = 0.2")


def test_a_window_from_the_future_is_refused_until_that_is_the_present(serving):
    async def body(_system, client):
        assert (await put(client, window(0))).status_code == 201
        assert code(await put(client, window(1, start=1000.0))) == (422, "future")
        letters = "/v1/servos/ax-1/letters"
        assert (await client.post(letters, content=hello(time=1001.0), headers=bearer())).status_code == 202
        assert (await put(client, window(1, start=1000.0))).status_code == 201
        assert code(await put(client, window(2, boot="c", start=1e12))) == (422, "future")

    serving(body, "future_slack_s = 10.0")


def test_a_servo_that_sends_too_much_waits(serving):
    async def body(_system, client):
        answers = [await put(client, window(sequence)) for sequence in range(4)]
        assert [answer.status_code for answer in answers[:3]] == [201, 201, 201]
        assert code(answers[3]) == (429, "too_many")
        assert answers[3].headers["retry-after"]
        assert (await put(client, window(0, "ax-2"), OTHER)).status_code == 201

    serving(body, "rate_limit_per_s = 0.001\nrate_burst = 3.0")


def test_a_servo_that_fills_the_disk_waits_and_what_is_known_already_costs_nothing(serving):
    size = len(encode(window(0)))

    async def body(system, client):
        times = iter((0.0,) * 100)
        disk = RateLimiter(size / 3600.0, 3.5 * size, lambda: next(times), "bytes to be stored")
        system.ingest._disk = disk
        for sequence in (0, 0, 0, 1, 1, 2):
            assert (await put(client, window(sequence))).status_code in (200, 201)
        answer = await put(client, window(3))
        assert code(answer) == (429, "too_many")
        assert "bytes to be stored" in answer.json()["detail"]
        times = iter((1900.0,) * 100)  # half an hour later there is room again
        assert (await put(client, window(3))).status_code == 201
        assert code(await put(client, window(4))) == (429, "too_many")

    serving(body)


def test_a_window_of_too_many_samples_is_refused_before_a_worker_gets_it(serving):
    async def body(system, client):
        assert (await put(client, window(0, samples=200))).status_code == 201
        answer = await put(client, window(1, samples=201))
        assert code(answer) == (413, "too_large")
        assert "201 samples; at most 200" in answer.json()["detail"]

    serving(body, "samples_per_window = 200")


def test_a_full_queue_and_a_store_that_cannot_write_are_temporary_refusals(serving):
    async def body(system, client):
        writing, held, write = threading.Event(), threading.Event(), system.store.write

        def slow(*what):
            writing.set()
            assert held.wait(30.0)
            return write(*what)

        system.store.write = slow
        sent = [asyncio.create_task(put(client, window(0)))]
        # From here on the first one is in a transaction of its own, so that two may wait and three may not.
        assert await asyncio.to_thread(writing.wait, 30.0)
        sent += [asyncio.create_task(put(client, window(sequence))) for sequence in range(1, 6)]
        done: set[asyncio.Task[httpx.Response]] = set()
        async with asyncio.timeout(30.0):
            while len(done) < 3:
                done, _ = await asyncio.wait(sent, timeout=0.05)
        assert [code(task.result()) for task in done] == [(503, "unavailable")] * 3
        held.set()
        assert {(await task).status_code for task in set(sent) - done} == {201}

        def full(*_what):
            raise StoreUnavailable("the disk is full")

        system.store.write = full
        assert code(await put(client, window(9))) == (503, "unavailable")
        system.store.write = write
        assert (await put(client, window(9))).status_code == 201
        assert system.store.servo("ax-1").windows == 4

    serving(body, "queue = 2")


@pytest.mark.slow
def test_whoever_polls_in_a_loop_is_refused_slowly_and_others_are_not(serving, monkeypatch):
    monkeypatch.setattr(http_edge, "REFUSED_POLL_S", 0.5)

    async def body(_system, client):
        path = "/v1/servos/ax-1/outgoing"
        assert (await client.get(path, headers=bearer())).status_code == 200
        begun = time.monotonic()
        refused = [asyncio.create_task(client.get(path, headers=bearer(token))) for token in (TOKEN, "guess")]
        other = await client.get("/v1/servos/ax-2/outgoing", headers=bearer(OTHER))
        assert other.status_code == 200
        assert not any(each.done() for each in refused)
        assert [code(await each) for each in refused] == [(429, "too_many"), (401, "bad_token")]
        assert time.monotonic() - begun >= 0.5

    serving(body, "rate_limit_per_s = 0.001\nrate_burst = 1")


def test_the_number_of_waiting_polls_is_limited(serving):
    async def body(system, client):
        path = "/v1/servos/ax-1/outgoing?wait=20"
        first = asyncio.create_task(client.get(path, headers=bearer()))
        while not system.polls.open:
            await asyncio.sleep(0.01)
        assert code(await client.get(path, headers=bearer())) == (429, "too_many")
        system.polls.close()
        assert unpacked((await first).content) == []

    serving(body, "long_polls = 1")
