"""A twin goes on without a servo of which rows are damaged, says so, and takes it back once they are right."""

import asyncio
import signal
from collections.abc import Awaitable, Callable
from contextlib import closing

import httpx
import pytest
import sqlalchemy as sa
from service_system import OPERATOR, OTHER, TOKEN, bearer, place, process, twin_file, window
from store_cases import SYSTEMS, postgresql_addresses
from waiting import until as wait_until
from watched_store import send, serve, until

from servotwin.messages import encode
from servotwin.store.engine import StoreDamaged
from servotwin.store.schema import twins
from servotwin.store.store import open_store
from servotwin.twin_service import store_watch
from servotwin.twin_service.store_watch import StoreWatch
from servotwin.twin_service.twin_file import service_of

pytest_plugins = ("store_fixtures",)

BAD = "column twins.serial holds -7 where a count up to 2**53 belongs, in the row of servo 'ax-1'"
REFUSED = (
    "the twin's record of servo 'ax-1' is damaged and set aside: its edge keeps its windows until that is put right"
)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The service looks often."""
    for name in ("_TELL_S", "_RECHECK_S"):
        monkeypatch.setattr(store_watch, name, 0.01)


@pytest.fixture(params=SYSTEMS)
def path(request: pytest.FixtureRequest, tmp_path):
    """A twin's file, with its store in each system."""
    if request.param == "sqlite":
        return twin_file(tmp_path)
    address = postgresql_addresses(request.getfixturevalue("postgres_server"))()
    return twin_file(tmp_path, f'store = "{address}"')


def change(system, statement: str) -> None:
    with system.store.engines.writer.begin() as connection:
        connection.exec_driver_sql(statement)


async def of_other(client, sequence: int) -> int:
    one = window(sequence, "ax-2")
    return (await client.put(place(one), content=encode(one), headers=bearer(OTHER))).status_code


Look = Callable[..., Awaitable[None]]


def with_two(path, look: Look) -> None:
    async def body(system, client):
        assert await send(client, 0, 1) == [201, 201]
        assert await of_other(client, 0) == 201
        await look(system, client)

    serve(path, body)


@pytest.mark.slow
def test_a_wrong_value_of_one_servo_stops_that_servo_until_it_is_right_again(path, caplog, monkeypatch):
    said = []

    async def look(system, client):
        telling = asyncio.create_task(system.watch.tell(lambda *about: said.append(about)))
        monkeypatch.setattr(system.watch, "_check_some", lambda after: after)  # whoever reads meets it first
        change(system, "UPDATE twins SET serial = -7 WHERE servo = 'ax-1'")
        assert (await client.get("/v1/servos", headers=bearer(OPERATOR))).status_code == 503
        await until(lambda: system.watch.aside)
        await until(lambda: not system.watch.fault)
        assert await of_other(client, 1) == 201
        one = window(2)
        refused = await client.put(place(one), content=encode(one), headers=bearer())
        assert (refused.status_code, refused.json()["code"], refused.json()["detail"]) == (503, "unavailable", REFUSED)
        polled = await client.get("/v1/servos/ax-1/outgoing", params={"after": 1}, headers=bearer())
        assert (polled.status_code, polled.json()["detail"]) == (503, REFUSED)
        health = await client.get("/healthz")
        assert (health.json()["damage"], health.json()["store"]) == ("", True)
        assert health.json()["set_aside"] == {"ax-1": BAD}
        assert any("'ax-1' is set aside" in sentence and BAD in sentence for sentence in health.json()["degraded"])
        assert "servotwin_servos_set_aside 1\n" in (await client.get("/metrics")).text
        for address in ("/v1/servos", "/v1/fleet"):
            listed = (await client.get(address, headers=bearer(OPERATOR))).json()
            rows = listed["rows"] if isinstance(listed, dict) else listed
            assert [row["servo"] for row in rows] == ["ax-2"], address
        for of_servo in ("", "/audit", "/events", "/gaps", "/acts", "/report.html", "/windows/b/0"):
            asked = await client.get(f"/v1/servos/ax-1{of_servo}", headers=bearer(OPERATOR))
            assert (asked.status_code, asked.json()["detail"]) == (503, REFUSED), of_servo
        StoreWatch._check_some(system.watch, 0)  # finds the same again
        assert await of_other(client, 2) == 201
        await until(lambda: said)
        change(system, "UPDATE twins SET serial = 0 WHERE servo = 'ax-1'")
        await until(lambda: not system.watch.aside)
        assert await send(client, 2) == [201]
        assert (await client.get("/healthz")).json()["set_aside"] == {}
        telling.cancel()

    with_two(path, look)
    assert ("servo set aside", f"the servo {store_watch._ASIDE}: {BAD}; {store_watch._REMEDY}", "ax-1") in said
    assert [line for line in caplog.messages if line.startswith("servo s")] == ["servo set aside", "servo sound again"]
    assert "store written again, but for servos that are set aside" in caplog.messages
    assert "store sound again: it is written" not in caplog.messages


@pytest.mark.slow
def test_a_body_that_changed_stops_its_servo_also_after_a_restart(path):
    changed = "decode('00', 'hex')" if "postgresql" in path.read_text() else "x'00'"

    async def look(system, client):
        change(system, f"UPDATE bodies SET body = {changed} WHERE message = 2")
        system.watch._check_some(0)
        assert await of_other(client, 1) == 503  # until all of the store is checked
        await until(lambda: system.watch.aside and not system.watch.fault)
        assert await of_other(client, 1) == 201
        assert await send(client, 2) == [503]

    async def again(system, client):
        system.watch._check_some(0)
        await until(lambda: system.watch.aside and not system.watch.fault)
        assert system.watch.aside == {"ax-1": "message 2 of servo 'ax-1': its body differs from its digest"}
        change(system, "DELETE FROM bodies WHERE message = 2")
        await until(lambda: not system.watch.aside)
        assert await send(client, 2) == [201]

    with_two(path, look)
    serve(path, again)


@pytest.mark.slow
def test_wrong_values_of_half_the_servos_and_more_stop_all(path):
    async def look(system, client):
        change(system, "UPDATE twins SET serial = -7")
        system.watch._check_some(0)
        await asyncio.sleep(0.5)
        assert system.watch.fault
        assert not system.watch.aside
        assert await of_other(client, 1) == 503
        change(system, "UPDATE twins SET serial = 0 WHERE servo = 'ax-2'")
        await until(lambda: not system.watch.fault)
        assert await of_other(client, 1) == 201

    with_two(path, look)


@pytest.mark.slow
def test_rows_that_are_read_although_they_are_set_aside_stop_all(path, monkeypatch):
    """As of a query that would not leave them out; once may be a reader that began before."""

    async def look(system, client):
        change(system, "UPDATE twins SET serial = -7 WHERE servo = 'ax-1'")
        system.watch._check_some(0)
        await until(lambda: system.watch.aside and not system.watch.fault)
        monkeypatch.setattr(system.watch, "_check_some", lambda after: after)  # no round of checks ends

        async def read_on():
            with pytest.raises(StoreDamaged, match="is damaged"):
                await system.executor.run(lambda: system.store.reading(read_serials))
            await until(lambda: system.watch.fault)

        await read_on()
        await until(lambda: not system.watch.fault)
        await read_on()
        for _ in range(2):
            await system.watch.recheck()
        assert system.watch.fault
        change(system, "UPDATE twins SET serial = 0")
        await until(lambda: not system.watch.fault and not system.watch.aside)
        assert await of_other(client, 1) == 201

    with_two(path, look)


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_a_twin_that_ended_while_a_servo_was_set_aside_serves_all_others_at_once(path, end):
    """As a process; the body of an old window is met by no check at the start."""
    changed = "decode('00', 'hex')" if "postgresql" in path.read_text() else "x'00'"

    def sent(url: str, one, token: str) -> int:
        return httpx.put(url + place(one), content=encode(one), headers=bearer(token)).status_code

    with process(path) as (twin, url):
        assert [sent(url, window(n), TOKEN) for n in range(2)] == [201, 201]
        assert sent(url, window(0, "ax-2"), OTHER) == 201
        with closing(open_store(service_of(path).store)) as store, store.engines.writer.begin() as connection:
            connection.exec_driver_sql(f"UPDATE bodies SET body = {changed} WHERE message = 2")
        wait_until(lambda: httpx.get(f"{url}/healthz").json()["set_aside"])
        twin.send_signal(end)
        twin.wait(30.0)
    with process(path) as (_, url):
        assert sent(url, window(2), TOKEN) == 503
        assert sent(url, window(1, "ax-2"), OTHER) == 201
        health = httpx.get(f"{url}/healthz").json()
        assert (list(health["set_aside"]), health["damage"]) == (["ax-1"], "")
        with closing(open_store(service_of(path).store)) as store, store.engines.writer.begin() as connection:
            connection.exec_driver_sql("DELETE FROM bodies WHERE message = 2")
        wait_until(lambda: not httpx.get(f"{url}/healthz").json()["set_aside"])
        assert sent(url, window(2), TOKEN) == 201


def read_serials(connection):
    return connection.scalars(sa.select(twins.c.serial)).all()


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["UPDATE twins SET serial = -7 WHERE servo = 'ax-1'", "body"])
def test_a_servo_that_is_set_aside_stays_so_over_a_restart_from_the_first_second(path, damage):
    body = "decode('00', 'hex')" if "postgresql" in path.read_text() else "x'00'"
    statement = f"UPDATE bodies SET body = {body} WHERE message = 2" if damage == "body" else damage

    async def look(system, _client):
        change(system, statement)
        system.watch._check_some(0)
        await until(lambda: system.watch.aside and not system.watch.fault)

    async def again(system, client):
        assert set(system.watch.aside) == {"ax-1"}
        assert not system.watch.fault
        assert await send(client, 2) == [503]
        assert await of_other(client, 1) == 201
        assert [lease.servo for lease in system.store.lease("me", 9, 10.0, system.clocks.wall())] == ["ax-2"]
        change(system, "DELETE FROM bodies WHERE message = 2")
        change(system, "UPDATE twins SET serial = 0 WHERE servo = 'ax-1'")
        await until(lambda: not system.watch.aside)
        assert await send(client, 2) == [201]

    async def sound(system, client):
        assert not system.watch.aside
        assert await send(client, 3) == [201]

    with_two(path, look)
    serve(path, again)
    serve(path, sound)
