"""HTTP API of the dashboard: sessions, pages of other sites, files, events."""

import asyncio

import pytest
from dashboard_fleet import say_hello
from service_system import MSGPACK, OPERATOR, OTHER, TOKEN, bearer, place, served, twin_file, window, with_service

from servotwin.messages import encode
from servotwin.twin_service.auth import Verifiers
from servotwin.twin_service.fleet_reader import EdgePresence
from servotwin.twin_service.sessions import COOKIE, SESSION_S


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
        # No estimate has told the machine's units yet.
        assert text.splitlines()[0] == "time_s,position,theta_m_rad"
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
