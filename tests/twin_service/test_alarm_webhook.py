"""Alarms by webhook: retried, bounded, never redirected, never in clear over a network."""

import asyncio
import json
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import httpx
import msgspec
import pytest
from service_system import ENGINEER, MSGPACK, OPERATOR, bearer, place, served, twin_file, window

from servotwin.cli.alarm_test import post_test_alarm
from servotwin.errors import InvalidInput
from servotwin.messages import EdgeClaim, encode
from servotwin.store.records import Backlog, EvidenceRecord, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.store.store import open_store
from servotwin.twin_service import alarm_webhook, missing_windows, service
from servotwin.twin_service.alarm_webhook import AlarmWebhook
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin, service_of
from servotwin.twin_service.webhook import (
    WebhookAway,
    WebhookConfig,
    WebhookRefused,
    alarm_post,
    send_post,
)
from servotwin.twin_service.worker_pool import WorkerPool

WORKER = (sys.executable, str(Path(__file__).parents[1] / "support" / "scripted_worker.py"))
POST = alarm_post("ax-1", "alarm", "the gap grows faster than is assumed", 0.0)


@contextmanager
def receiver(status, location=""):
    """A webhook that answers with a status, and what it received."""
    received = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            received.append((self.path, self.headers.get("Authorization"), json.loads(body)))
            self.send_response(status)
            if location:
                self.send_header("Location", location)
            self.end_headers()

        def log_message(self, *_args):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/hook?a=1", received
        finally:
            server.shutdown()
            thread.join()


def with_webhook(folder: Path, url: str, secret: str | None = "s3cret", mode: int = 0o600) -> Path:
    table = f'[service.webhook]\nurl = "{url}"\n'
    if secret is not None:
        (folder / "secret").write_text(secret + "\n")
        (folder / "secret").chmod(mode)
        table += 'secret_file = "secret"\n'
    return twin_file(folder, table)


def test_a_test_alarm_arrives_with_the_secret(tmp_path, capsys):
    with receiver(204) as (url, received):
        post_test_alarm(with_webhook(tmp_path, url))
        [(path, secret, body)] = received
    assert path == "/hook?a=1"
    assert secret == "Bearer s3cret"
    assert body["servo"] == "test"
    assert "took the test (status 204)" in capsys.readouterr().out


@pytest.mark.parametrize(("status", "error"), [
    (200, None), (302, WebhookRefused), (307, WebhookRefused), (404, WebhookRefused), (401, WebhookRefused),
    (429, WebhookAway), (500, WebhookAway), (503, WebhookAway),
])  # fmt: skip
def test_what_a_status_means(status, error):
    with receiver(status, "http://127.0.0.1:1/elsewhere") as (url, received):
        if error is None:
            assert send_post(WebhookConfig(url), POST) == status
        else:
            with pytest.raises(error, match=str(status)):
                send_post(WebhookConfig(url), POST)
        assert len(received) == 1


def test_a_webhook_that_is_not_there_is_away():
    with pytest.raises(WebhookAway, match=r"127\.0\.0\.1: Connection refused"):
        send_post(WebhookConfig("http://127.0.0.1:1/hidden"), POST)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("http://plant.example/hidden", "give https://"),
        ("ftp://plant.example/hidden", "must be a URL"),
        ("https://me:hidden@plant.example/", "without a user"),
        ("https://plant.example:x/hidden", "must be a URL"),
        ("https://plant.example/a b/hidden", "must be a URL"),
    ],
)
def test_an_address_that_is_not_allowed_is_refused_and_not_repeated(tmp_path, url, said):
    with pytest.raises(InvalidInput, match=said) as refused:
        service_of(with_webhook(tmp_path, url))
    assert "service.webhook.url" in str(refused.value)
    assert "hidden" not in str(refused.value)


def test_a_secret_that_others_may_read_or_that_breaks_a_header_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="mode 0644"):
        service_of(with_webhook(tmp_path, "https://plant.example/", mode=0o644))
    with pytest.raises(InvalidInput, match="one line of printable ASCII"):
        service_of(with_webhook(tmp_path, "https://plant.example/", secret="a\nB: c"))


def test_without_a_webhook_a_test_says_so(tmp_path):
    with pytest.raises(InvalidInput, match=r"has no \[service\.webhook\]"):
        post_test_alarm(twin_file(tmp_path))


def test_a_repr_shows_neither_path_nor_secret():
    assert "hidden" not in repr(WebhookConfig("https://plant.example/hidden", "hidden"))


LEASE = Lease("ax-1", b"", 1, (StoredMessage(7, MessageKind.LETTER, b"", "", 86400.0),))


def result(*evidence, servo="ax-1"):
    return WorkResult(servo, 1, b"", None, (), tuple(evidence))


def alarm(sentence, kind="alarm"):
    return EvidenceRecord(kind, 0, b"", status=sentence)


class Clock:
    """A clock that sleeping moves."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        real = asyncio.sleep

        async def sleep(seconds):
            self.now += seconds
            await real(0)

        monkeypatch.setattr(alarm_webhook.asyncio, "sleep", sleep)

    def __call__(self):
        return self.now


async def until_quiet(webhook):
    """Let the webhook post all that waits."""
    running = asyncio.create_task(webhook.run())
    while webhook.waiting:
        await asyncio.wait([running], timeout=0.005)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def run_webhook(monkeypatch, answers, results, repeat=3600.0):
    """Sentences that were posted, the counts, and the clock in the end; an answer is an exception or None."""
    clock, posted, metrics = Clock(monkeypatch), [], Metrics()

    def send(_config, post):
        posted.append(post.sentence)
        answer = answers.pop(0) if answers else None
        if answer is not None:
            raise answer
        return 200

    async def body():
        webhook = AlarmWebhook(WebhookConfig("https://a/", repeat=repeat), metrics.webhook, clock, clock, send)
        for each in results:
            webhook.note(LEASE, each)
        await until_quiet(webhook)

    asyncio.run(body())
    return posted, {name: count for (name,), count in metrics.webhook.values.items()}, clock.now


def test_only_alarms_are_posted_each_once_an_hour(monkeypatch):
    results = [
        result(alarm("fine", "estimate"), alarm("one")),
        result(alarm("one"), alarm("left", "fallback")),
        result(alarm("one"), servo="ax-2"),
        result(alarm("failed: not understood", "window")),
    ]
    posted, counts, _ = run_webhook(monkeypatch, [], results)
    assert posted == ["one", "left", "one", "failed: not understood"]
    assert counts == {"taken": 4, "refused": 0, "dropped": 0}


def test_an_alarm_waits_for_a_webhook_that_is_away_and_the_others_behind_it(monkeypatch, caplog):
    caplog.set_level("INFO")
    away = [WebhookAway("a"), WebhookAway("a"), WebhookAway("a")]
    posted, counts, now = run_webhook(monkeypatch, away, [result(alarm("one"), alarm("two"))])
    assert posted == ["one", "one", "one", "one", "two"]
    assert counts["taken"] == 2
    assert now == 2.0 + 4.0 + 8.0
    assert {"webhook away", "webhook answers again"} <= set(caplog.messages)


def test_a_refused_alarm_is_not_posted_again(monkeypatch, caplog):
    posted, counts, _ = run_webhook(monkeypatch, [WebhookRefused("no")], [result(alarm("one"), alarm("two"))])
    assert posted == ["one", "two"]
    assert counts == {"taken": 1, "refused": 1, "dropped": 0}
    assert "webhook refused an alarm" in caplog.messages


def test_after_a_day_an_alarm_is_dropped(monkeypatch):
    posted, counts, now = run_webhook(monkeypatch, [WebhookAway("a")] * 400, [result(alarm("one"))])
    assert counts == {"taken": 0, "refused": 0, "dropped": 1}
    assert 86400.0 <= now <= 86700.0
    assert len(posted) < 310


def test_a_flood_drops_the_oldest(monkeypatch):
    posted, counts, _ = run_webhook(monkeypatch, [], [result(*(alarm(str(number)) for number in range(1005)))])
    assert posted == [str(number) for number in range(5, 1005)]
    assert counts == {"taken": 1000, "refused": 0, "dropped": 5}


def test_an_alarm_says_when_it_was_raised_and_when_the_message_came_that_led_to_it(monkeypatch):
    posted = []

    async def body():
        def send(_config, post):
            posted.append(post)

        webhook = AlarmWebhook(
            WebhookConfig("https://a/"), Metrics().webhook, lambda: 90000.0, Clock(monkeypatch), send
        )
        webhook.note(LEASE, result(alarm("one")._replace(message=7), alarm("two")))
        webhook.announce("updates lag", "late")
        await until_quiet(webhook)

    asyncio.run(body())
    assert [post.time for post in posted] == ["1970-01-02T01:00:00Z"] * 3
    assert [post.received for post in posted] == ["1970-01-02T00:00:00Z", None, None]


@pytest.mark.slow
def test_damage_of_the_store_and_a_lag_are_posted_once(tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    posted = []

    async def body():
        twin = read_twin(with_webhook(tmp_path, "http://127.0.0.1:9/hook"))
        store = open_store(twin.service.store)
        system = TwinService(twin, store, pool=WorkerPool(0, twin.start, 30.0))
        monkeypatch.setattr(system.webhook, "_send", lambda _config, post: posted.append((post.servo, post.text)))
        late = [Backlog(3, 0, 99.0, lag) for lag in (99.0, 0.0, 98.0)]
        monkeypatch.setattr(store, "backlog", lambda _now: late.pop(0) if len(late) > 1 else late[0])
        monkeypatch.setattr(service, "_WATCH_S", 0.01)
        monkeypatch.setattr(service, "_REFRESH_S", 0.01)
        try:
            async with system.http_app().lifespan(), asyncio.timeout(60.0):
                while len(late) > 1 or len(posted) < 1:
                    await asyncio.sleep(0.01)
                system.watch.fault = "page 7 is damaged"
                while len(posted) < 2:
                    await asyncio.sleep(0.01)
        finally:
            store.close()

    asyncio.run(body())
    assert posted == [
        ("twin", "twin: lag: new messages of a servo wait for longer than lag_limit_s = 30 s"),
        ("twin", "twin: store damaged: it is not written any more: page 7 is damaged"),
    ]
    assert {"updates lag", "updates lag no longer"} <= set(caplog.messages)


def test_a_second_edge_missing_windows_and_a_store_that_lost_messages_are_posted(tmp_path, monkeypatch):
    monkeypatch.setattr(missing_windows, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(missing_windows, "_LOOK_S", 1e9)
    (tmp_path / "twin.db-newest").write_text("9\n")

    async def body(url):
        async with served(with_webhook(tmp_path, url)) as (system, client):
            for sequence in (0, 3):
                await client.put(place(window(sequence)), content=encode(window(sequence)), headers=bearer())
            await system._missing.look()
            for claim in (EdgeClaim("ax-1", "one", 0, 1), EdgeClaim("ax-1", "two", 0, 2), *2 * [older]):
                await client.post("/v1/servos/ax-1/claim", content=encode(claim), headers={**bearer(), **MSGPACK})
            assert system.metrics.evidence.values["alarm",] == 1
            async with asyncio.timeout(60.0):
                while system.metrics.webhook.values["taken",] < 3:
                    await asyncio.sleep(0.02)

    older = EdgeClaim("ax-1", "one", 1)
    with receiver(200) as (url, received):
        asyncio.run(body(url))
    assert sorted(post["text"] for _, _, post in received) == [
        "ax-1: conflict: two edges of this servo run, one and two; the newer one counts",
        "ax-1: windows missing: windows 1 to 2 of boot b did not come, although later ones did",
        "twin: the store has lost messages: its newest message is number 0, and it once had number 9",
    ]


def test_what_a_twin_could_not_process_is_posted(tmp_path):
    async def body(url):
        twin = read_twin(with_webhook(tmp_path, url))
        store = open_store(twin.service.store)
        system = TwinService(twin, store, pool=WorkerPool(1, twin.start, 30.0, WORKER))
        app = system.http_app()
        try:
            async with app.lifespan(), httpx.AsyncClient(transport=httpx.ASGITransport(app)) as client:
                sent = msgspec.structs.replace(window(0), reason="raise")
                await client.put(f"http://twin{place(sent)}", content=encode(sent), headers=bearer())
                async with asyncio.timeout(60.0):
                    while not system.metrics.webhook.values["taken",]:
                        await asyncio.sleep(0.02)
        finally:
            store.close()

    with receiver(200) as (url, received):
        asyncio.run(body(url))
    [(_, secret, post)] = received
    assert secret == "Bearer s3cret"
    assert (post["servo"], post["kind"]) == ("ax-1", "failed")
    assert post["text"] == "ax-1: failed: given up"


def test_an_engineer_tests_the_webhook_and_an_operator_only_sees_its_host(tmp_path):
    async def body(url, received):
        async with served(with_webhook(tmp_path, url)) as (system, client):
            shown = await client.get("/v1/webhook", headers=bearer(OPERATOR))
            assert shown.json() == {"host": system.config.webhook.host, "may_test": False}
            assert (await client.get("/v1/webhook", headers=bearer(ENGINEER))).json()["may_test"]
            assert (await client.post("/v1/webhook/test", headers=bearer(OPERATOR))).status_code == 403
            assert (await client.post("/v1/webhook/test", headers=bearer())).status_code == 403
            assert received == []
            answers = [await client.post("/v1/webhook/test", headers=bearer(ENGINEER)) for _ in range(4)]
            assert [answer.status_code for answer in answers] == [200, 200, 200, 429]
            assert received[0][2]["text"] == "test: alarm: this is a test of the webhook by eva"

    with receiver(200) as (url, received):
        asyncio.run(body(url, received))


@pytest.mark.parametrize("status", [404, 500])
def test_a_webhook_that_does_not_take_the_test_is_one_sentence(tmp_path, status):
    async def body(url):
        async with served(with_webhook(tmp_path, url)) as (_, client):
            answer = await client.post("/v1/webhook/test", headers=bearer(ENGINEER))
            assert answer.status_code == 503
            assert f"did not take the test: 127.0.0.1 answers with status {status}" in answer.json()["detail"]

    with receiver(status) as (url, _):
        asyncio.run(body(url))


def test_without_a_webhook_there_is_nothing_to_test(tmp_path):
    async def body():
        async with served(twin_file(tmp_path)) as (_, client):
            assert (await client.get("/v1/webhook", headers=bearer(ENGINEER))).json() == {
                "host": None,
                "may_test": False,
            }
            assert (await client.post("/v1/webhook/test", headers=bearer(ENGINEER))).status_code == 404

    asyncio.run(body())
