"""Several twins on one PostgreSQL: a servo that one of them sets aside is served by none, until all take it back."""

import asyncio
from contextlib import AsyncExitStack

import pytest
from service_system import OTHER, bearer, place, served, twin_file, window
from store_cases import postgresql_addresses
from watched_store import send, until

from servotwin.messages import encode
from servotwin.twin_service import store_watch

pytest_plugins = ("store_fixtures",)

HIT = {
    "value": "UPDATE twins SET serial = -7 WHERE servo = 'ax-1'",
    "body": "UPDATE bodies SET body = decode('00', 'hex') WHERE message = 2",
}
RIGHT = ("UPDATE twins SET serial = 0 WHERE servo = 'ax-1'", "DELETE FROM bodies WHERE message = 2")


@pytest.mark.slow
@pytest.mark.parametrize("hit", HIT)
def test_a_servo_that_one_twin_sets_aside_is_served_by_none(tmp_path, postgres_server, monkeypatch, hit):
    for name in ("_TELL_S", "_RECHECK_S"):
        monkeypatch.setattr(store_watch, name, 0.01)
    path = twin_file(tmp_path, f'store = "{postgresql_addresses(postgres_server)()}"')

    async def of_other(client, sequence: int) -> int:
        one = window(sequence, "ax-2")
        return (await client.put(place(one), content=encode(one), headers=bearer(OTHER))).status_code

    async def body() -> None:
        async with AsyncExitStack() as stack:
            twins = [await stack.enter_async_context(served(path)) for _ in range(3)]
            first, second, _ = twins
            assert await send(first[1], 0, 1) == [201, 201]
            assert await of_other(second[1], 0) == 201
            with first[0].store.engines.writer.begin() as connection:
                connection.exec_driver_sql(HIT[hit])
            first[0].watch._check_some(0)
            await until(lambda: first[0].watch.aside and not first[0].watch.fault)
            for system, client in twins:
                await until(lambda system=system: not system.watch.fault)
                assert await send(client, 2) == [503]
                assert await of_other(client, 1) in (200, 201)
                assert [lease.servo for lease in system.store.lease("me", 9, 10.0, 0.0)] in ([], ["ax-2"])
                assert set(system.watch.aside) == {"ax-1"}
            with first[0].store.engines.writer.begin() as connection:
                for statement in RIGHT:
                    connection.exec_driver_sql(statement)
            for n, (system, client) in enumerate(twins):
                await until(lambda system=system: not system.watch.aside)
                assert await send(client, 3 + n) == [201]
                assert system.dispatching
                assert not system.watch.fault

    asyncio.run(body())
