"""Live views at the twin: who watches, what the edge is told, what the page is shown, and the bounds on all of it."""

import asyncio

import pytest
from service_system import MSGPACK, OPERATOR, OTHER, TOKEN, bearer, with_service

from servotwin.messages.live import MAX_LIVE_COLUMNS, LiveColumns, Watched, decode_watched, encode_live
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.live_views import WATCHED_S, LiveViews

COLUMN = 0.0, 1.0, -1.0, 1.0, None, None
PATH = "/v1/servos/ax-1/live"


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def views(watched=10, waiting=10, connected=False):
    clock = Clock()
    return LiveViews(clock, lambda _: connected, watched, waiting), clock


def sent(first=0, count=3, boot=1):
    return LiveColumns("ax-1", boot, first, 0.1, (COLUMN,) * count)


def test_columns_are_kept_only_while_somebody_watches():
    live, clock = views()
    assert not live.take("ax-1", sent())
    assert live.look("ax-1", 0, 0)["columns"] == []
    assert live.take("ax-1", sent())
    shown = live.look("ax-1", 0, 0)
    assert (shown["boot"], shown["first"], shown["columns"]) == (1, 0, [COLUMN] * 3)
    assert live.take("ax-1", sent(3, 2))
    assert [live.look("ax-1", 1, after)["first"] for after in (2, 3, 4)] == [3, 4, 5]
    assert live.look("ax-1", 1, 4)["columns"] == []
    assert live.look("ax-1", 2, 4)["first"] == 0  # the page knows another boot
    clock.now += WATCHED_S
    assert not live.take("ax-1", sent(5))
    assert live.look("ax-1", 1, 4)["columns"] == []


def test_a_short_gap_stays_a_gap_and_a_long_one_and_a_new_boot_begin_anew():
    live, _ = views()
    live.look("ax-1", 0, 0)
    live.take("ax-1", sent(0, 3))
    live.take("ax-1", sent(5, 2))
    shown = live.look("ax-1", 1, 1)
    assert (shown["first"], shown["columns"]) == (2, [COLUMN, (None,) * 6, (None,) * 6, COLUMN, COLUMN])
    live.take("ax-1", sent(5000, 2))
    assert live.look("ax-1", 1, 6)["first"] == 5000
    live.take("ax-1", sent(0, 1, boot=2))
    assert live.look("ax-1", 1, 8)["first"] == 0


def test_columns_that_come_again_over_a_broker_leave_the_view_as_it_is():
    live, _ = views()
    live.look("ax-1", 0, 0)
    chunks = [LiveColumns("ax-1", 1, first, 0.1, ((float(first), *COLUMN[1:]),) * 2) for first in (0, 2, 4)]
    for chunk in (*chunks[:2], chunks[1], chunks[0], chunks[2], chunks[2]):
        assert live.take("ax-1", chunk)
    shown = live.look("ax-1", 0, 0)
    assert (shown["first"], [column[0] for column in shown["columns"]]) == (0, [0.0, 0.0, 2.0, 2.0, 4.0, 4.0])
    # Other columns with the same numbers are those of another run of the edge.
    other = ((9.0, *COLUMN[1:]),) * 2
    live.take("ax-1", LiveColumns("ax-1", 1, 0, 0.1, other))
    assert live.look("ax-1", 0, 0)["columns"] == list(other)


def test_a_page_is_told_in_a_word_why_it_sees_nothing():
    for connected, word in ((False, "away"), (True, "off"), (None, "off")):
        live, clock = views(connected=connected)
        assert live.look("ax-1", 0, 0)["state"] == word
    live.take("ax-1", LiveColumns("ax-1"))
    assert live.look("ax-1", 0, 0)["state"] == "waiting"
    live.take("ax-1", sent())
    assert live.look("ax-1", 0, 0)["state"] == "live"
    clock.now += 3.5
    stale = live.look("ax-1", 0, 0)
    assert (stale["state"], stale["age"]) == ("stale", 3.5)


def test_few_machines_are_watched_and_few_edges_wait():
    async def body():
        live, clock = views(watched=1, waiting=1)
        live.look("ax-1", 0, 0)
        with pytest.raises(RequestRejected, match="1 machines are watched live already"):
            live.look("ax-2", 0, 0)
        clock.now += WATCHED_S
        live.look("ax-2", 0, 0)
        waiting = asyncio.create_task(live.wait("ax-1", 30.0))
        await asyncio.sleep(0)
        with pytest.raises(RequestRejected, match="too many edges wait"):
            await live.wait("ax-3", 30.0)
        live.close()
        assert await waiting is False

    asyncio.run(body())


def test_an_edge_waits_until_a_page_looks_and_then_streams(tmp_path):
    async def body(_system, client):
        async def post(columns, wait="", token=TOKEN):
            return await client.post(PATH + wait, content=encode_live(columns), headers=MSGPACK | bearer(token))

        asked = asyncio.create_task(post(LiveColumns("ax-1"), "?wait=20"))
        await asyncio.sleep(0.05)
        shown = (await client.get(PATH, headers=bearer(OPERATOR))).json()
        assert shown["state"] == "waiting"
        assert decode_watched((await asked).content) == Watched(True)
        assert decode_watched((await post(sent())).content) == Watched(True)
        shown = (await client.get(f"{PATH}?boot=1&after=0", headers=bearer(OPERATOR))).json()
        assert (shown["state"], shown["first"], len(shown["columns"])) == ("live", 1, 2)
        assert (await client.get(PATH, headers=bearer(TOKEN))).status_code == 403
        assert (await post(sent(), token=OTHER)).status_code in (401, 403)
        for broken in (b"", b"x" * 20_000, encode_live(Watched(True)), encode_live(sent(count=MAX_LIVE_COLUMNS + 1))):
            refused = await client.post(PATH, content=broken, headers=MSGPACK | bearer())
            assert refused.status_code in (400, 413)
            assert refused.json()["detail"]
        other = await post(LiveColumns("ax-2"))
        assert other.json()["code"] == "other_name"

    with_service(tmp_path, body)


def test_an_edge_that_sends_too_often_is_refused(tmp_path):
    async def body(_system, client):
        answers = [
            (await client.post(PATH, content=encode_live(sent()), headers=MSGPACK | bearer())).status_code
            for _ in range(20)
        ]
        assert answers[:10] == [200] * 10
        assert 429 in answers

    with_service(tmp_path, body)
