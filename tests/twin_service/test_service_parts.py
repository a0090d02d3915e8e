"""Parts of the service: limits, metrics, logs and long polls."""

import asyncio
import io
import json
import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.messages import Refusal
from servotwin.runtime.prometheus import metric_lines
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import OutgoingMessage
from servotwin.twin_service.http_edge import LongPolls
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.limits import (
    MAX_SERVOS,
    STATUS,
    Disconnected,
    RateLimiter,
    RequestRejected,
    SampleTimeLimiter,
)
from servotwin.twin_service.monitoring import Counter, Gauge, Histogram, Metrics, RefusalLog, configure_logging


def refusal(act):
    with pytest.raises(RequestRejected) as refused:
        act()
    return refused.value.refusal


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def test_every_reason_has_a_status():
    assert set(STATUS) == set(Refusal)
    assert {status for reason, status in STATUS.items() if reason.temporary} == {400, 401, 404, 409, 422, 429, 503}


@given(
    speed=st.floats(0.1, 20.0),
    slack=st.floats(0.0, 100.0),
    first=st.floats(0.0, 1e6),
    later=st.lists(st.tuples(st.floats(0.0, 1e4), st.floats(-1e4, 1e6)), max_size=20),
)
def test_a_boot_s_sample_time_runs_no_faster_than_it_can(speed, slack, first, later):
    boots, now = SampleTimeLimiter(speed, slack), 1000.0
    boots.check("a", "b", first, now)
    for passed, end in later:
        now += passed
        reached = first + speed * (now - 1000.0) + slack
        if end <= reached * (1.0 - 1e-12):
            boots.check("a", "b", end, now)
        elif end > reached * (1.0 + 1e-12) + 1e-9:
            assert refusal(lambda end=end, now=now: boots.check("a", "b", end, now)) is Refusal.FUTURE
    boots.check("a", "c", 5.0, now)
    boots.check("other", "b", 7.0, now)


def test_windows_of_a_boot_that_has_ended_pass_once_the_next_one_has_said_hello():
    boots = SampleTimeLimiter(1.0, 60.0)
    boots.check("a", "ended", 1.0, 0.0)
    assert refusal(lambda: boots.check("a", "ended", 500.0, 1.0)) is Refusal.FUTURE
    boots.hello("a", "live", 1000.0, 1.0)
    boots.check("a", "ended", 500.0, 1.0)
    boots.check("a", "between", 72000.0, 1.0)
    assert refusal(lambda: boots.check("a", "live", 1500.0, 1.0)) is Refusal.FUTURE
    assert refusal(lambda: boots.check("a", "ended", 1e12, 1.0)) is Refusal.FUTURE
    boots.check("other", "ended", 1.0, 0.0)
    assert refusal(lambda: boots.check("other", "ended", 500.0, 1.0)) is Refusal.FUTURE
    for k in range(MAX_SERVOS):
        boots.hello(f"servo-{k}", "b", 0.0, 1.0)
    assert refusal(lambda: boots.check("a", "ended", 500.0, 1.0) or boots.check("a", "ended", 600.0, 1.0)) is (
        Refusal.FUTURE
    )


def test_a_hello_moves_a_boot_s_time_on_but_never_back():
    boots = SampleTimeLimiter(1.0, 0.0)
    boots.hello("a", "b", 100.0, 0.0)
    boots.hello("a", "b", 50.0, 1.0)
    boots.check("a", "b", 101.0, 1.0)
    boots.hello("a", "b", 500.0, 2.0)
    boots.check("a", "b", 500.0, 2.0)
    assert refusal(lambda: boots.hello("a", "c", 1e12, 2.0)) is Refusal.FUTURE


@given(st.floats(0.1, 100.0), st.integers(1, 50), st.lists(st.floats(0.0, 2.0), max_size=200))
def test_a_bucket_lets_no_more_through_than_its_rate_and_burst(rate, burst, pauses):
    clock, taken = Clock(), 0
    buckets = RateLimiter(rate, burst, clock)
    for pause in pauses:
        clock.now += pause
        try:
            buckets.take("a")
            taken += 1
        except RequestRejected as refused:
            assert refused.refusal is Refusal.TOO_MANY  # noqa: PT017
    assert taken <= burst + rate * clock.now + 1e-6
    assert taken >= min(len(pauses), burst)
    buckets.take("b")


def received(*parts, end=True):
    """An ASGI receive that gives these parts, and then nothing any more."""
    events = [{"type": "http.request", "body": part, "more_body": True} for part in parts]
    if end:
        events.append({"type": "http.request", "body": b"", "more_body": False})
    else:
        events.append({"type": "http.disconnect"})
    iterator = iter(events)

    async def receive():
        return next(iterator)

    return receive


@given(st.lists(st.binary(max_size=40), max_size=10), st.integers(0, 150), st.none() | st.integers(0, 300))
def test_a_body_is_read_whole_or_refused_and_nothing_stays_buffered(parts, limit, declared):
    bodies, whole = BodyReader(limit, 10.0), b"".join(parts)
    length = None if declared is None else str(declared)
    try:
        result = asyncio.run(bodies.read(length, received(*parts)))
    except RequestRejected as refused:
        assert refused.refusal is Refusal.TOO_LARGE  # noqa: PT017
        assert max(len(whole), declared or 0) > limit
    else:
        assert result == whole
        assert len(whole) <= limit
    assert bodies.buffered == 0


def test_an_incomplete_body_is_discarded_and_too_many_at_once_are_refused():
    bodies = BodyReader(100, 10.0, memory=150)
    with pytest.raises(Disconnected):
        asyncio.run(bodies.read(None, received(b"x", end=False)))
    assert bodies.buffered == 0

    async def two():
        gate = asyncio.Event()

        async def slow():
            if not gate.is_set():
                gate.set()
                return {"type": "http.request", "body": bytes(90), "more_body": True}
            await asyncio.sleep(60.0)
            return None

        first = asyncio.create_task(bodies.read(None, slow))
        await gate.wait()
        with pytest.raises(RequestRejected) as refused:
            await bodies.read(None, received(bytes(90)))
        first.cancel()
        await asyncio.gather(first, return_exceptions=True)
        return refused.value.refusal

    assert asyncio.run(two()) is Refusal.UNAVAILABLE
    assert bodies.buffered == 0


def lines_of(metric):
    head, kind, *lines = metric_lines(metric.name, metric.kind, metric.help, metric.samples())
    assert (head, kind) == (f"# HELP {metric.name} {metric.help}", f"# TYPE {metric.name} {metric.kind}")
    return lines


def test_metrics_are_prometheus_text():
    count, metrics = Counter("a_total", "How many.", "kind", "put"), Metrics()
    count.add('w"\n\\', "new", by=2)
    assert lines_of(count) == ['a_total{kind="w\\"\\n\\\\",put="new"} 2']
    assert lines_of(Gauge("g", "Now.", lambda: {"x": 1.5}, "of")) == ['g{of="x"} 1.5']
    assert lines_of(Counter("k", "Known.", "why", known=("a", "b"))) == ['k{why="a"} 0', 'k{why="b"} 0']
    histogram = Histogram("h", "Times.", (0.1, 1.0))
    for value in (0.05, 0.1, 0.5, 7.0):
        histogram.observe(value)
    lines = ['h_bucket{le="0.1"} 2', 'h_bucket{le="1"} 3', 'h_bucket{le="+Inf"} 4', "h_sum 7.65", "h_count 4"]
    assert lines_of(histogram) == lines
    metrics.add_gauge("w", "Watched.", lambda: True)
    text = metrics.text()
    assert text.endswith("# HELP w Watched.\n# TYPE w gauge\nw 1\n")
    assert len({line for line in text.splitlines() if line.startswith("# TYPE")}) == text.count("# TYPE")


@contextmanager
def logged(stream: io.StringIO) -> Iterator[None]:
    """The service's logging, into `stream`."""
    handler = configure_logging("info", stream)
    try:
        yield
    finally:
        for name in ("servotwin", "uvicorn", "asyncio"):
            logging.getLogger(name).removeHandler(handler)
            logging.getLogger(name).propagate = True
            logging.getLogger(name).setLevel(logging.NOTSET)


def test_a_log_line_is_one_json_object_whatever_it_holds():
    stream = io.StringIO()
    log = logging.getLogger("servotwin.test")
    with logged(stream):
        log.info("a\nb", extra={"servo": "x\ny", "number": math.nan, "thing": object()})
        log.debug("unseen")
        try:
            raise ValueError("it")
        except ValueError:
            log.exception("bad")
    first, second = (json.loads(line) for line in stream.getvalue().splitlines())
    assert (first["message"], first["servo"], first["level"], first["where"]) == (
        "a\nb",
        "x\ny",
        "info",
        "servotwin.test",
    )
    assert "ValueError: it" in second["exception"]


def test_a_flood_of_bytes_that_are_no_request_writes_few_lines():
    stream = io.StringIO()
    with logged(stream):
        for _ in range(5000):
            logging.getLogger("uvicorn.error").warning("Invalid HTTP request received.")
        logging.getLogger("uvicorn.error").warning("Unsupported upgrade request.")
        logging.getLogger("asyncio").warning("socket.send() raised exception.")
        logging.getLogger("servotwin.test").warning("another")
    lines = [json.loads(line)["message"] for line in stream.getvalue().splitlines()]
    assert len(lines) == 103
    assert lines[-3:] == ["Unsupported upgrade request.", "socket.send() raised exception.", "another"]


def test_a_flood_of_refusals_writes_few_lines_and_tells_how_many_it_left_out(caplog):
    caplog.set_level(logging.INFO)
    clock = [0.0]
    refusals = RefusalLog(logging.getLogger("servotwin.test"), lambda: clock[0])
    for _ in range(5000):
        refusals.write("bad_token", servo="ax-1")
    assert len(caplog.records) == 100
    refusals.write("too_many", servo="ax-1")
    assert caplog.records[-1].code == "too_many", "a flood of one code hides no other"
    clock[0] = 2.0
    for _ in range(3):
        refusals.write("bad_token", servo="ax-2")
    first, second = caplog.records[101:]
    assert (first.servo, first.omitted) == ("ax-2", 4900)
    assert not hasattr(second, "omitted")


def test_a_poll_of_a_store_that_is_away_is_refused_for_now():
    async def away(*_args):
        raise StoreUnavailable("not available now (connection refused)")

    with pytest.raises(RequestRejected) as refused:
        asyncio.run(LongPolls(away, 10).messages("ax-1", 0, 0.0))
    assert refused.value.refusal is Refusal.UNAVAILABLE


def test_polls_read_the_store_only_when_there_may_be_a_message():
    posted, read_serials = [], []

    async def read(servo, serial):
        read_serials.append(serial)
        return [each for each in posted if each.serial > serial]

    async def body():
        outgoing = LongPolls(read, 10)
        for _ in range(5):
            assert list(await outgoing.messages("a", 0, 0.0)) == []
        assert len(read_serials) == 1
        waiting = [asyncio.create_task(outgoing.messages("a", 0, 60.0)) for _ in range(3)]
        await asyncio.sleep(0.01)
        posted.append(OutgoingMessage(1, b"x"))
        outgoing.notify("b")
        await asyncio.sleep(0.01)
        assert not any(task.done() for task in waiting)
        outgoing.notify("a")
        assert [await task for task in waiting] == [posted] * 3
        assert outgoing.open == 0
        assert list(await outgoing.messages("a", 1, 0.01)) == []
        assert not outgoing._waiting

    asyncio.run(body())


def test_one_servo_cannot_hold_the_polls_of_all():
    async def read(_servo, _serial):
        return []

    async def body():
        outgoing = LongPolls(read, 10, per_servo=2)
        waiting = [asyncio.create_task(outgoing.messages("a", 0, 60.0)) for _ in range(2)]
        await asyncio.sleep(0.01)
        with pytest.raises(RequestRejected, match="2 polls of servo 'a' wait already"):
            await outgoing.messages("a", 0, 0.0)
        assert list(await outgoing.messages("b", 0, 0.0)) == []
        outgoing.close()
        await asyncio.gather(*waiting)
        assert list(await outgoing.messages("a", 0, 0.0)) == []
        assert not outgoing._open_of

    asyncio.run(body())


def test_a_message_posted_while_the_store_is_read_is_not_missed():
    posted = []

    async def body():
        begun, go_on = asyncio.Event(), asyncio.Event()

        async def read(_servo, serial):
            result = [each for each in posted if each.serial > serial]
            begun.set()
            await go_on.wait()
            return result

        outgoing = LongPolls(read, 10)
        poll = asyncio.create_task(outgoing.messages("a", 0, 60.0))
        await begun.wait()
        posted.append(OutgoingMessage(1, b"x"))
        outgoing.notify("a")
        go_on.set()
        assert await asyncio.wait_for(poll, 10.0) == posted

    asyncio.run(body())


def test_a_message_posted_by_another_process_ends_the_polls_of_its_servo():
    posted = []

    async def read(_servo, serial):
        return [each for each in posted if each.serial > serial]

    async def body():
        outgoing = LongPolls(read, 10, shared=True)
        early, late = (asyncio.create_task(outgoing.messages("a", serial, 60.0)) for serial in (0, 1))
        while outgoing.open < 2 or outgoing.waiting != ["a"]:
            await asyncio.sleep(0.01)
        outgoing.notify_serials({"a": 0, "b": 7})
        await asyncio.sleep(0.01)
        assert not early.done()
        posted.append(OutgoingMessage(1, b"x"))
        outgoing.notify_serials({"a": 1})
        assert await early == posted
        assert not late.done()
        posted.append(OutgoingMessage(2, b"y"))
        outgoing.notify_serials({"a": 2})
        assert await late == posted[1:]

    asyncio.run(body())
