"""The service notices a damaged store, messages that are gone, and windows that never came."""

import asyncio
import os
import shutil
import sqlite3
from contextlib import closing, suppress

import pytest
from service_system import OPERATOR, bearer, twin_file
from store_cases import postgresql_addresses
from watched_store import posted, send, serve, until

from servotwin.messages import Resend, decode, encode
from servotwin.store.engine import StoreDamaged
from servotwin.store.integrity import IntegrityReport
from servotwin.store.store import open_store
from servotwin.twin_service import store_watch
from servotwin.twin_service.twin_file import service_of

pytest_plugins = ("store_fixtures",)

PAGE = 8192
_LOST = "the twin's store has lost messages"


@pytest.mark.slow
def test_a_damaged_store_is_noticed_at_the_start_and_not_written(tmp_path, caplog):
    path = twin_file(tmp_path)

    async def fill(_system, client):
        assert set(await send(client, *range(40))) == {201}

    serve(path, fill)
    file = tmp_path / "twin.db"
    pages = file.stat().st_size // PAGE
    with file.open("r+b") as opened:
        opened.seek((pages - 20) * PAGE)
        opened.write(os.urandom(18 * PAGE))

    async def look(system, client):
        health = await client.get("/healthz")
        assert health.status_code == 503
        assert health.json()["store"] is False
        assert health.json()["damage"]
        assert await send(client, 100) == [503]
        assert "servotwin_store_damaged 1\n" in (await client.get("/metrics")).text

    serve(path, look)
    assert "store damaged: it is not written any more" in caplog.messages


def test_a_store_that_a_newer_servotwin_migrates_while_the_twin_runs_is_said_once(tmp_path, caplog, monkeypatch):
    """As by a reading command of the newer one; this twin wrote on, and nobody knew until its next start failed."""
    monkeypatch.setattr(store_watch, "_MARK_S", 0.02)
    monkeypatch.setattr(store_watch, "_TELL_S", 0.02)
    path, said = twin_file(tmp_path), []

    async def look(system, client):
        telling = asyncio.create_task(system.watch.tell(lambda *about: said.append(about)))
        with closing(sqlite3.connect(tmp_path / "twin.db")) as opened:
            opened.execute("UPDATE servotwin_version SET version_num = '9000'")
            opened.commit()
        await until(lambda: said)
        assert (await client.get("/healthz")).json()["degraded"] == [said[0][1]]
        assert await send(client, 0) == [201]
        await asyncio.sleep(0.2)
        telling.cancel()

    serve(path, look)
    ((kind, sentence),) = said
    assert kind == "store of a newer servotwin"
    assert sentence.startswith("a newer servotwin has migrated the store to schema 9000 while this twin, which knows ")
    assert sentence.endswith(" runs: end this twin, and install the newer servotwin")
    assert caplog.messages.count("store of a newer servotwin") == 1


@pytest.mark.slow
@pytest.mark.parametrize("passes", [True, False])
def test_a_store_is_written_again_once_all_of_it_can_be_read(tmp_path, caplog, monkeypatch, passes):
    """As where a disk does not give pages for a while: SQLite calls that damage."""
    monkeypatch.setattr(store_watch, "_TELL_S", 0.01)
    monkeypatch.setattr(store_watch, "_RECHECK_S", 0.01)
    monkeypatch.setattr(store_watch, "_LONGEST_RECHECK_S", 0.02)
    path, file, said = twin_file(tmp_path), tmp_path / "twin.db", []

    async def fill(_system, client):
        assert set(await send(client, *range(40))) == {201}

    async def body(system, client):
        sound = file.read_bytes()
        with file.open("r+b") as opened:
            opened.seek(8 * PAGE)
            opened.write(os.urandom(len(sound) - 10 * PAGE))
        telling = asyncio.create_task(system.watch.tell(lambda *about: said.append(about)))
        system.watch._check_some(0)
        assert await send(client, 100) == [503]
        await asyncio.sleep(0.3)
        assert await send(client, 100) == [503]  # checked many times meanwhile
        if passes:
            with file.open("r+b") as opened:
                opened.write(sound)
            await until(lambda: not system.watch.fault)
            assert await send(client, 100) == [201]
            assert (await client.get("/healthz")).json()["damage"] == ""
            assert system.dispatching
        telling.cancel()

    serve(path, fill)
    serve(path, body)
    assert caplog.messages.count("store sound again: it is written") == passes
    assert [kind for kind, _sentence in said] == ["store damaged"]


def test_a_disk_that_does_not_give_the_store_is_named_and_a_passing_error_ends(tmp_path, caplog, monkeypatch):
    errors = ["Input/output error, in twin.db", "Input/output error, in twin.db", ""]
    monkeypatch.setattr(store_watch, "read_error", lambda _store: errors.pop(0))

    async def body(system, client):
        system.watch._found(IntegrityReport(("database disk image is malformed",), False))
        for _ in range(2):
            await system.watch.recheck()
            assert (await client.get("/healthz")).json()["damage"] == (
                "the disk does not give it: Input/output error, in twin.db"
            )
        await system.watch.recheck()
        assert await send(client, 0) == [201]

    monkeypatch.setattr(store_watch, "_TELL_S", 1e9)  # the service itself does not check
    serve(twin_file(tmp_path), body)
    assert caplog.messages.count("the disk does not give the store") == 1


def test_damage_that_comes_later_is_noticed_by_the_digest_of_a_body(tmp_path):
    async def body(system, client):
        assert await send(client, 0, 1, 2) == [201, 201, 201]
        assert (await client.get("/healthz")).json()["damage"] == ""
        assert system.watch._check_some(0) == 0
        with system.store.engines.writer.begin() as connection:
            connection.exec_driver_sql("UPDATE bodies SET body = x'00' WHERE message = 2")
        system.watch._check_some(0)
        assert "message 2 of servo 'ax-1'" in (await client.get("/healthz")).json()["damage"]
        assert await send(client, 3) == [503]
        assert system.watch.rounds >= 1

    serve(twin_file(tmp_path), body)


@pytest.mark.slow
def test_a_value_of_another_type_that_is_read_is_damage_until_it_is_gone(tmp_path, monkeypatch):
    """Nothing noticed it but those who read: it ended workers and tasks of the service."""
    monkeypatch.setattr(store_watch, "_TELL_S", 0.01)
    monkeypatch.setattr(store_watch, "_RECHECK_S", 0.01)

    async def body(system, client):
        assert await send(client, 0) == [201]
        change(system, "UPDATE twins SET gap = 'abc'")
        answer = await client.get("/v1/servos", headers=bearer(OPERATOR))
        assert answer.status_code == 503
        await until(lambda: system.watch.fault)
        damage = (await client.get("/healthz")).json()["damage"]
        assert "column twins.gap holds a text where a number belongs" in damage
        assert await send(client, 1) == [503]
        change(system, "UPDATE twins SET gap = NULL")
        await until(lambda: not system.watch.fault)
        assert await send(client, 1) == [201]

    serve(twin_file(tmp_path), body)


@pytest.mark.parametrize(
    ("change_", "clause"),
    [
        ("twins SET serial = 9223372036854775807", "twins.serial holds 9223372036854775807 where a count up to 2**53"),
        ("messages SET kind = '{'", "messages.kind holds '{' where one of window, letter, act, verification"),
    ],
)
def test_damage_that_a_reader_finds_is_told_with_its_row(tmp_path, monkeypatch, change_, clause):
    """A kind that there is not ended the dispatcher, and with it all work."""
    monkeypatch.setattr(store_watch, "_TELL_S", 0.01)
    monkeypatch.setattr(store_watch, "_RECHECK_S", 0.01)

    async def body(system, client):
        assert await send(client, 0) == [201]
        change(system, f"UPDATE {change_}")
        with pytest.raises(StoreDamaged, match="is damaged"):
            await system.executor.run(lambda: system.store.lease("me", 1, 30.0, 1e10))
        await until(lambda: "in the row of" in system.watch.fault)
        damage = (await client.get("/healthz")).json()["damage"]
        row = "servo 'ax-1'" if "twins" in change_ else "id 1"
        assert damage == f"column {clause} belongs, in the row of {row}"
        assert system.dispatching

    serve(twin_file(tmp_path), body)


def change(system, statement):
    with system.store.engines.writer.begin() as connection:
        connection.exec_driver_sql(statement)


def test_a_store_that_lost_acknowledged_messages_says_so_and_asks_for_them(tmp_path, caplog):
    path = twin_file(tmp_path)

    async def fill(_system, client):
        await send(client, *range(5))

    serve(path, fill)
    assert (tmp_path / "twin.db-newest").read_text() == "5\n"
    store = open_store(f"sqlite:///{tmp_path}/twin.db")
    with store.engines.writer.begin() as connection:  # as where the second half of its log is gone
        connection.exec_driver_sql("DELETE FROM bodies WHERE message > 2")
        connection.exec_driver_sql("DELETE FROM messages WHERE id > 2")
    store.close()

    async def look(system, _client):
        assert posted(system) == [Resend("ax-1", reason="the twin's store has lost messages")]
        (alarm,) = system.store.events("ax-1")
        assert alarm.status.startswith("the store has lost messages: its newest message is number 2, and it once had")
        assert "the edge's answers to them, are missing" in alarm.status

    serve(path, look)
    (line,) = (record for record in caplog.records if record.message == "the store has lost messages")
    assert (line.had, line.has) == (5, 2)


@pytest.mark.slow
def test_a_database_that_was_put_back_to_an_earlier_dump_is_noticed_at_the_start(tmp_path, postgres_server):
    path = twin_file(tmp_path, f'store = "{postgresql_addresses(postgres_server)()}"')

    async def fill(_system, client):
        assert set(await send(client, *range(5))) == {201}

    async def look(system, _client):
        assert posted(system) == [Resend("ax-1", reason="the twin's store has lost messages")]
        assert system.watch.lost == "its newest message is number 2, and it once had number 5"

    serve(path, fill)
    assert (tmp_path / "twin.toml-newest").read_text() == "5\n"
    with closing(open_store(service_of(path).store)) as store:
        lose(store, 2)
    serve(path, look)


def lose(store, last):
    """Delete all messages after one, as in a dump that was made then."""
    with store.engines.writer.begin() as connection:
        connection.exec_driver_sql(f"DELETE FROM bodies WHERE message > {last}")
        connection.exec_driver_sql(f"DELETE FROM messages WHERE id > {last}")


@pytest.mark.slow
def test_a_database_that_was_put_back_while_the_twin_runs_is_noticed(tmp_path, postgres_server, caplog):
    async def body(system, client):
        assert set(await send(client, *range(5))) == {201}
        system.watch.mark()
        lose(system.store, 2)
        system.watch.mark()
        assert posted(system) == [Resend("ax-1", reason="the twin's store has lost messages")]
        said = []
        with suppress(TimeoutError):
            await asyncio.wait_for(system.watch.tell(lambda *about: said.append(about)), 0.1)
        assert said == [("the store has lost messages", "its newest message is number 2, and it once had number 5")]

    serve(twin_file(tmp_path, f'store = "{postgresql_addresses(postgres_server)()}"'), body)
    assert caplog.messages.count("the store has lost messages") == 1


@pytest.mark.parametrize("name", ["twin.db", "twin.db-wal"])
@pytest.mark.parametrize("replaced", [False, True])
def test_windows_are_not_acknowledged_into_a_file_that_is_gone(tmp_path, name, replaced):
    async def body(system, client):
        assert await send(client, 0) == [201]
        (tmp_path / name).rename(tmp_path / "moved")
        if replaced:
            shutil.copy(tmp_path / "moved", tmp_path / name)
        assert await send(client, 1) == [503]
        health = await client.get("/healthz")
        assert health.status_code == 503
        assert f"({name}: deleted, moved or replaced while the store was open)" in health.json()["damage"]

    serve(twin_file(tmp_path), body)


def test_a_file_that_is_gone_is_noticed_without_a_window(tmp_path):
    async def body(system, client):
        assert await send(client, 0) == [201]
        system.watch._check_some(0)
        assert system.watch.fault == ""
        (tmp_path / "twin.db").unlink()
        system.watch._check_some(0)
        assert "twin.db: deleted" in system.watch.fault

    serve(twin_file(tmp_path), body)


@pytest.mark.slow
def test_a_store_that_lost_everything_asks_each_edge_once_it_has_come(tmp_path, monkeypatch):
    path = twin_file(tmp_path)

    async def fill(_system, client):
        assert await send(client, 0) == [201]

    serve(path, fill)
    (tmp_path / "twin.db").unlink()
    monkeypatch.setattr(store_watch, "_NEW_S", 0.01)

    async def look(system, client):
        assert system.watch.lost
        waiting = asyncio.create_task(system.polls.messages("ax-1", 0, 30.0))
        assert await send(client, 7) == [201]
        (message,) = await waiting  # its poll ends, whatever the twin sends or does not send for the window
        assert decode(message.body) == Resend("ax-1", reason="the twin's store has lost messages")
        for _ in range(2):
            assert system.watch._ask_for_windows() == set()

    serve(path, look)


def test_what_a_store_that_lost_messages_asks_has_a_serial_that_no_edge_has_yet(tmp_path):
    async def body(system, client):
        assert await send(client, 0) == [201]
        system.store.post({"ax-1": encode(Resend("ax-1"))}, 1.0)
        (before,) = system.store.outgoing("ax-1", 0)
        with system.store.engines.writer.begin() as connection:  # as where this message, and its serial, were lost
            connection.exec_driver_sql("UPDATE twins SET posted = 0")
            connection.exec_driver_sql("DELETE FROM outgoing")
        system.watch._ask_for_windows()
        assert len(system.store.outgoing("ax-1", before.serial)) == 1

    serve(twin_file(tmp_path), body)


@pytest.mark.parametrize("known", [True, False])
def test_an_edge_that_has_had_more_than_the_store_posted_is_asked_for_its_windows_and_it_is_said(
    tmp_path, caplog, known
):
    """As where a whole folder was put back, the number of its newest message too, or an edge came from elsewhere."""

    async def body(system, client):
        if known:
            assert await send(client, 0) == [201]
        (message,) = await system.polls.messages("ax-1", 900, 0.0)
        assert message.serial > 900
        assert decode(message.body) == Resend("ax-1", reason=_LOST)
        assert not await system.polls.messages("ax-1", message.serial, 0.0)
        assert not await system.polls.messages("ax-2", 0, 0.0)
        assert not await system.polls.messages("ax-2", 2**53, 0.0)  # no serial is left above that
        (alarm,) = system.store.events("ax-1")
        assert "has had message 900" in alarm.status
        # In turns, as of two twins behind one address: said once in a while; the next message is above all the same.
        ahead = message.serial + 7
        assert not await system.polls.messages("ax-1", ahead, 0.0)
        assert (len(system.store.events("ax-1")), system.store.posted(["ax-1"])) == (1, {"ax-1": ahead})

    serve(twin_file(tmp_path), body)
    (line,) = [one for one in caplog.records if one.message == "the store has lost messages"]
    assert (line.servo, line.had, line.has) == ("ax-1", 900, 0)


def test_a_damaged_store_asks_for_nothing(tmp_path):
    async def body(system, client):
        assert await send(client, 0) == [201]
        system.watch.fault, system.store.damaged = "pages are gone", True
        assert not await system.polls.messages("ax-1", 900, 0.0)
        assert system.store.posted(["ax-1"]) == {"ax-1": 0}  # nor is the next serial raised

    serve(twin_file(tmp_path), body)
