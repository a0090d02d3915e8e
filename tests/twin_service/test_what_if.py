"""Simulated steps over HTTP: a process of their own, limits of each client."""

import asyncio

import msgspec
import pytest
from service_system import OPERATOR, TOKEN, bearer, served, twin_file

from servotwin.twin_service import what_if_process
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.what_if_process import WhatIfProcess, WhatIfReply

PATH = "/v1/servos/ax-1/what-if"
ASKED = {"gap": 0.1, "k_dz": 1.0}


@pytest.mark.slow
def test_an_operator_s_token_simulates_in_a_process_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(what_if_process, "_ANSWER_S", 60.0)  # however busy the machine

    async def body():
        async with served(twin_file(tmp_path)) as (system, client):
            assert (await client.post(PATH, json=ASKED)).status_code == 401
            assert (await client.post(PATH, json=ASKED, headers=bearer(TOKEN))).status_code == 403
            assert system.pages.what_if.pid is None
            headers = bearer(OPERATOR)
            first = await client.post(PATH, json=ASKED, headers=headers)
            assert first.status_code == 200
            assert first.json()["tolerance"] > 0.0
            process = system.pages.what_if.pid
            file = await client.get("/v1/servos/ax-1/gaps.parquet", headers=headers)
            assert file.content[:4] == b"PAR1"
            missing = await client.get("/v1/servos/ax-1/windows/b/7/residual", headers=headers)
            assert missing.status_code == 404
            refused = await client.post(PATH, json={"gap": -1}, headers=headers)
            assert refused.status_code == 400
            assert "negative" in refused.json()["detail"]
            other = await client.post(PATH.replace("ax-1", "zz"), json=ASKED, headers=headers)
            assert other.status_code == 400
            assert "has no model" in other.json()["detail"]
            assert (await client.post(PATH, content=b"x" * 5000, headers=headers)).status_code == 413
            assert system.pages.what_if.pid == process
            # All at once: however slow the machine, more than are allowed in the time that they take.
            asked = [client.post(PATH, json=ASKED, headers=headers) for _ in range(60)]
            statuses = {answer.status_code for answer in await asyncio.gather(*asked)}
            assert 429 in statuses
            assert 500 not in statuses
        assert system.pages.what_if.pid is None

    asyncio.run(body())


class Answering:
    """A process that answers when it is told to."""

    def __init__(self, *_args):
        self.pid, self.go, self.killed = 1, asyncio.Event(), False

    async def start(self):
        pass

    async def ask(self, question):
        await self.go.wait()
        return msgspec.msgpack.encode(WhatIfReply(question, ""))

    async def kill(self):
        self.killed, self.pid = True, None


def test_questions_wait_in_a_line_of_limited_length_and_a_broken_one_ends_the_process(monkeypatch):
    made = []
    monkeypatch.setattr(what_if_process, "WorkerProcess", lambda *_: made.append(Answering()) or made[-1])

    async def body():
        process = WhatIfProcess(None, lambda: 0.0)
        waiting = [asyncio.create_task(process.answer("ax-1", b"%d" % number)) for number in range(9)]
        await asyncio.sleep(0)
        with pytest.raises(RequestRejected, match="too many simulations"):
            await process.answer("ax-1", b"")
        waiting[0].cancel()
        await asyncio.sleep(0)
        await asyncio.gather(waiting[0], return_exceptions=True)
        assert made[0].killed
        while len(made) < 2:
            await asyncio.sleep(0)
        made[1].go.set()
        answers = await asyncio.gather(*waiting[1:])
        assert [msgspec.msgpack.decode(each)[1] for each in answers] == [b"%d" % number for number in range(1, 9)]

    asyncio.run(body())


def test_an_unused_process_ends(monkeypatch):
    monkeypatch.setattr(what_if_process, "WorkerProcess", Answering)
    monkeypatch.setattr(what_if_process, "_LOOK_S", 0.0)
    now = 0.0

    async def body():
        nonlocal now
        process = WhatIfProcess(None, lambda: now)
        asked = asyncio.create_task(process.answer("ax-1", b""))
        await asyncio.sleep(0)
        process._process.go.set()
        await asked
        ending = asyncio.create_task(process.run())
        for _ in range(5):
            await asyncio.sleep(0)
        assert process.pid == 1
        now = 301.0
        while process.pid is not None:
            await asyncio.sleep(0)
        ending.cancel()

    asyncio.run(body())
