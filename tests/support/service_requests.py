"""Requests to a service in this process, and what it answers."""

import httpx
from service_system import MSGPACK, TOKEN, bearer, place

from servotwin.messages import encode


async def put(client: httpx.AsyncClient, sent, token=TOKEN, to=None, **headers) -> httpx.Response:
    body = sent if isinstance(sent, bytes) else encode(sent)
    named = {**bearer(token), **MSGPACK, **{key.replace("_", "-"): value for key, value in headers.items()}}
    return await client.put(to or place(sent), content=body, headers=named)


def code(answer: httpx.Response) -> tuple[int, str]:
    content = answer.json()
    assert set(content) - {"mark"} == {"code", "detail"}
    assert content["detail"].strip()
    return answer.status_code, content["code"]
